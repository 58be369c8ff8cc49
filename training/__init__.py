"""Learning KKL observers offline: data, forward and inverse maps, evaluation. Needs the extra ``train``."""

try:
    from training.calibration import calibrate
    from training.certificates import Certificate, certify
    from training.config import Config, preset
    from training.evaluate import errors, unseen_runs
    from training.metrics import smape
    from training.pipeline import Result, train
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
    "unseen_runs",
]
