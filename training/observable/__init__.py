"""What outputs and inputs tell of hidden signals, over which window and under how much noise, before any training."""

from training.observable.environments import observability
from training.observable.found import Judgement, Observability
from training.observable.recorded import of_records
from training.observable.systems import of_system

__all__ = ["Judgement", "Observability", "observability", "of_records", "of_system"]
