"""Offline training, calibration and evaluation of KKL observers; needs the extra ``train``."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from training.calibration import calibrate as calibrate
    from training.config import Config as Config
    from training.diagnosis import Observability as Observability
    from training.diagnosis import observability as observability
    from training.evaluation.errors import errors as errors
    from training.evaluation.errors import noise_limit as noise_limit
    from training.evaluation.errors import unseen_trajectories as unseen_trajectories
    from training.evaluation.metrics import nrmse as nrmse
    from training.evaluation.metrics import smape as smape
    from training.export.torch_memory import TorchMemory as TorchMemory
    from training.export.torch_observer import TorchObserver as TorchObserver
    from training.identification.learning import adapt as adapt
    from training.identification.learning import identify as identify
    from training.lessons import Maps as Maps
    from training.lessons import Result as Result
    from training.lessons import learn_flow as learn_flow
    from training.lessons import learn_map as learn_map
    from training.lessons import train as train
    from training.presets import preset as preset
    from training.rollouts import learn as learn
    from training.rollouts.callback import KKLTrainingCallback as KKLTrainingCallback
    from training.run import Run as Run
    from training.sources import Source as Source
    from training.sources.recorded import RecordedSource as RecordedSource
    from training.sources.recorded import recorded_preset as recorded_preset
    from training.sources.simulated import SimulatedSource as SimulatedSource

_NAMES = {
    "calibration": "calibrate",
    "config": "Config",
    "diagnosis": "Observability observability",
    "evaluation.errors": "errors noise_limit unseen_trajectories",
    "evaluation.metrics": "nrmse smape",
    "export.torch_memory": "TorchMemory",
    "export.torch_observer": "TorchObserver",
    "identification.learning": "adapt identify",
    "lessons": "Maps Result learn_flow learn_map train",
    "presets": "preset",
    "rollouts": "learn",
    "rollouts.callback": "KKLTrainingCallback",
    "run": "Run",
    "sources.recorded": "RecordedSource recorded_preset",
    "sources.simulated": "SimulatedSource",
    "sources": "Source",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use: torch takes seconds to import, and parts of the package do not need it."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"training.{_MODULES[name]}"), name)
    except ModuleNotFoundError as error:
        extra = "agents" if (error.name or "").startswith("stable_baselines3") else "train"
        raise ModuleNotFoundError(
            f'{error}: training.{name} needs pip install "kkl-gym[{extra}]"', name=error.name
        ) from None
