"""Choosing the spectrum of an observer before training it."""

from training.tuning.probe import Choice, Probe, Spectrum

__all__ = ["Choice", "Probe", "Spectrum"]
