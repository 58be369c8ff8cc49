"""Choosing the spectrum of an observer before training it."""

from training.spectrum import Spectrum
from training.tuning.probe import Choice, Probe

__all__ = ["Choice", "Probe", "Spectrum"]
