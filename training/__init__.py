"""Learning KKL observers offline: data, forward and inverse maps, evaluation. Needs the extra ``train``."""

try:
    from training.config import Config
    from training.evaluation.calibration import calibrate
    from training.evaluation.certificates import Certificate, certify
    from training.evaluation.errors import errors, unseen_trajectories
    from training.evaluation.metrics import smape
    from training.pipeline import Result, train
    from training.presets import preset
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f'{error}: training and the kkl-gym command need pip install "kkl-gym[train]"', name=error.name
    ) from None

__all__ = [
    "Certificate",
    "Config",
    "Result",
    "calibrate",
    "certify",
    "errors",
    "preset",
    "smape",
    "train",
    "unseen_trajectories",
]
