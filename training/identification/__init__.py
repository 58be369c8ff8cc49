"""Identification of a plant by multiple shooting from records of its outputs, and training of its observer.

:mod:`motions` simulates windows of the records, :mod:`shooting` fits parameters on windows of one length, and
:mod:`windows` lengthens the windows. :mod:`identifiability` finds parameters, and signs of states, that the outputs do
not determine. :mod:`identify` combines these steps, and :mod:`learning` trains the observer.
"""

from training.identification.identify import Identified, Product, estimate_parameters
from training.identification.learning import Learned, adapt, identify

__all__ = ["Identified", "Learned", "Product", "adapt", "estimate_parameters", "identify"]
