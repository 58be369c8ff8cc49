"""Parameters of a plant, and an observer for it, from records of outputs; no state is ever seen.

The steps, each in a module of its own: :mod:`consistency` trains a network from the filter's state to the state, and
rough parameters, on outputs and equations alone. :mod:`shooting` refines both over windows, which :mod:`windows` makes
longer. :mod:`identifiability` says what outputs cannot tell. :mod:`identify` puts them together, and :mod:`learning`
trains the observer on the plant that was identified.
"""

from training.identification.identify import Identified, Product, estimate_parameters
from training.identification.learning import Learned, adapt, identify

__all__ = ["Identified", "Learned", "Product", "adapt", "estimate_parameters", "identify"]
