"""Faulty sensors, and how soon an observer's monitor notices them."""

from typing import Literal, get_args

import numpy as np
import pandas as pd

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.evaluation.calibration import sound_trajectories
from training.seeds import Stream, generator
from training.systems import profile

Fault = Literal["none", "bias", "drop-out", "freeze"]


FAULTS: tuple[Fault, ...] = get_args(Fault)


BIAS = 0.2  # of the output's range


def deadline(system: System, duration: float) -> float:
    """Seconds within which a fault should be noticed in runs of this length."""
    return profile(system).fault_deadline or duration / 5


def simulate_faults(
    artifact: Artifact, system: System, *, runs: int, duration: float, measurement_noise: float, seed: int
) -> pd.DataFrame:
    """One row for each run and fault: amplitude, the highest score, and the delay until it exceeded 1.

    ``score`` is the highest of the whole run where nothing is at fault, and within the deadline after the fault
    elsewhere. ``delay`` is in seconds, infinite where the score never exceeds 1 within the run. ``amplitude`` is the
    largest sound |y| after the middle of the run.
    """
    dt, rng = artifact.filter.dt, generator(Stream.FAULTS, seed)
    x, u = sound_trajectories(artifact, system, n=runs, duration=duration, rng=rng)
    clean = system.output(x)
    y = clean + measurement_noise * rng.standard_normal(clean.shape)
    undriven = clean[len(clean) // 2 :, ~u.any((0, 2))]
    width = np.ptp(undriven, axis=(0, 1))
    at, within = len(y) // 2, round(deadline(system, duration) / dt)
    observer = KKLObserver(artifact, measurement_noise, monitor=True, process_noise=system.process_noise)
    frames = []
    for fault in FAULTS:
        seen = y.copy()
        if fault == "bias":
            seen[at:] += BIAS * width
        elif fault == "drop-out":
            seen[at:] = 0.0
        elif fault == "freeze":
            seen[at:] = seen[at]
        score = _scores(observer, seen, u if artifact.nu else None)
        judged = score if fault == "none" else score[at : at + within]
        late = score if fault == "none" else score[at:]
        alarmed = (late > 1).any(0)
        frames.append(
            pd.DataFrame(
                {
                    "system": system.name,
                    "fault": fault,
                    "run": np.arange(runs),
                    "amplitude": np.abs(clean[at:]).max((0, 2)),
                    "score": judged.max(0),
                    "delay": np.where(alarmed, (late > 1).argmax(0) * dt, np.inf),
                }
            )
        )
    return pd.concat(frames, ignore_index=True)


def _scores(observer: KKLObserver, y: np.ndarray, u: np.ndarray | None) -> np.ndarray:
    """The monitor's score at every sample, (steps + 1, n)."""
    observer.reset(y[0])
    out = np.zeros(y.shape[:2])
    for k in range(1, len(y)):
        observer.advance(y[k], None if u is None else u[k - 1])
        out[k] = observer.score
    return out
