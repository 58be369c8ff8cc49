"""Learning KKL observers offline: data, forward and inverse maps, evaluation. Needs the extra ``train``."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from training.config import Config
    from training.diagnosis import Observability, observability
    from training.evaluation.errors import errors, noise_limit, unseen_trajectories
    from training.evaluation.metrics import nrmse, smape
    from training.export.torch_memory import TorchMemory
    from training.export.torch_observer import TorchObserver
    from training.identification.learning import adapt, identify
    from training.lessons.calibrate import calibrate
    from training.lessons.flow import learn_flow
    from training.lessons.map import Maps, learn_map
    from training.lessons.run import Run
    from training.presets import preset
    from training.rollouts import learn
    from training.rollouts.callback import KKLTrainingCallback
    from training.sources.recorded import RecordedSource, recorded_preset
    from training.sources.simulated import SimulatedSource
    from training.sources.source import Source
    from training.train_observer import Result, train

__all__ = [
    "Config",
    "KKLTrainingCallback",
    "Maps",
    "Observability",
    "RecordedSource",
    "Result",
    "Run",
    "SimulatedSource",
    "Source",
    "TorchMemory",
    "TorchObserver",
    "adapt",
    "calibrate",
    "errors",
    "identify",
    "learn",
    "learn_flow",
    "learn_map",
    "noise_limit",
    "nrmse",
    "observability",
    "preset",
    "recorded_preset",
    "smape",
    "train",
    "unseen_trajectories",
]

_MODULES = {
    "Config": "config",
    "KKLTrainingCallback": "rollouts.callback",
    "Maps": "lessons.map",
    "Observability": "diagnosis",
    "RecordedSource": "sources.recorded",
    "Result": "train_observer",
    "Run": "lessons.run",
    "SimulatedSource": "sources.simulated",
    "Source": "sources.source",
    "TorchMemory": "export.torch_memory",
    "TorchObserver": "export.torch_observer",
    "adapt": "identification.learning",
    "calibrate": "lessons.calibrate",
    "errors": "evaluation.errors",
    "identify": "identification.learning",
    "learn": "rollouts",
    "learn_flow": "lessons.flow",
    "learn_map": "lessons.map",
    "noise_limit": "evaluation.errors",
    "nrmse": "evaluation.metrics",
    "observability": "diagnosis",
    "preset": "presets",
    "recorded_preset": "sources.recorded",
    "smape": "evaluation.metrics",
    "train": "train_observer",
    "unseen_trajectories": "evaluation.errors",
}


def __getattr__(name: str) -> Any:
    """What is public, imported when it is asked for: torch takes seconds, and parts of the package need none."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"training.{_MODULES[name]}"), name)
    except ModuleNotFoundError as error:
        extra = "agents" if (error.name or "").startswith("stable_baselines3") else "train"
        raise ModuleNotFoundError(
            f'{error}: training.{name} needs pip install "kkl-gym[{extra}]"', name=error.name
        ) from None
