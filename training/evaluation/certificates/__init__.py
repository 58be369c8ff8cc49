"""Certificates: how far an observer is to be trusted, and why."""

from training.evaluation.certificates.certificate import Certificate, certify

__all__ = ["Certificate", "certify"]
