"""Certificates: how far an observer is to be trusted, and why."""

from training.certificates.certify import Certificate, certify

__all__ = ["Certificate", "certify"]
