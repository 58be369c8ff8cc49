"""Certificates: how far an observer is to be trusted, and why."""

from examples.research.certificates.certificate import Certificate, certify

__all__ = ["Certificate", "certify"]
