"""Learning KKL observers offline: data, forward and inverse maps, evaluation. Needs the extra ``train``."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from training.config import Config
    from training.diagnosis import Observability, observability
    from training.evaluation.errors import errors, unseen_trajectories
    from training.evaluation.metrics import nrmse, smape
    from training.guided import GuidedKalmanFilter
    from training.identification.learning import adapt, identify
    from training.pipeline import Result, train
    from training.presets import preset
    from training.rollouts import learn
    from training.rollouts.callback import KKLTrainingCallback
    from training.teaching.monitor import calibrate

__all__ = [
    "Config",
    "GuidedKalmanFilter",
    "KKLTrainingCallback",
    "Observability",
    "Result",
    "adapt",
    "calibrate",
    "errors",
    "identify",
    "learn",
    "nrmse",
    "observability",
    "preset",
    "smape",
    "train",
    "unseen_trajectories",
]

_MODULES = {
    "Config": "config",
    "GuidedKalmanFilter": "guided",
    "KKLTrainingCallback": "rollouts.callback",
    "Observability": "diagnosis",
    "Result": "pipeline",
    "adapt": "identification.learning",
    "calibrate": "teaching.monitor",
    "errors": "evaluation.errors",
    "identify": "identification.learning",
    "learn": "rollouts",
    "nrmse": "evaluation.metrics",
    "observability": "diagnosis",
    "preset": "presets",
    "smape": "evaluation.metrics",
    "train": "pipeline",
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
