"""Faulty sensors, and how soon an observer's monitor notices them."""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
import pandas as pd

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.evaluation.levels import Level
from training.presets import profile
from training.seeds import Stream, generator
from training.sources.simulated import sound_motions
from training.trajectories.policies import Controller

Fault = Literal["none", "bias", "drop-out", "freeze"]
FAULTS: tuple[Fault, ...] = get_args(Fault)
BIAS = 0.2  # of the output's range
PARTS = 1 + len(FAULTS)  # of the work: simulating, and each fault


def deadline(system: System, duration: float) -> float:
    """Seconds within which a fault should be noticed: what the system's profile says, else a fifth of the duration."""
    return profile(system).fault_deadline or duration / 5


def simulate_faults(
    artifact: Artifact,
    system: System,
    *,
    trajectories: int,
    duration: float,
    measurement_noise: Level,
    seed: int,
    policy: Controller | None = None,
    report: Callable[[int], object] = lambda done: None,
) -> pd.DataFrame:
    """Simulate sensors that fail in the middle of a trajectory, under the eyes of an observer's monitor."""
    allowed = deadline(system, duration)
    if not allowed <= duration / 2:
        raise ValueError(
            f"a fault in the middle of {duration} s leaves less than the {allowed:g} s within which it is to be noticed"
        )
    dt, rng = artifact.filter.dt, generator(Stream.FAULTS, seed)
    steps = round(duration / dt)
    x, u, _ = sound_motions(
        system, n=trajectories, steps=steps, dt=dt, rng=rng, driven=bool(artifact.nu), policy=policy
    )
    clean = system.output(x)
    y = clean + np.asarray(measurement_noise) * rng.standard_normal(clean.shape)
    counted = slice(None) if policy else ~u.any((0, 2))  # random inputs would widen it
    width = np.ptp(clean[len(clean) // 2 :, counted], axis=(0, 1))
    at, within = len(y) // 2, round(allowed / dt)
    observer = KKLObserver(artifact, measurement_noise, monitor=True, process_noise=system.process_noise)
    frames = []
    for done, fault in enumerate(FAULTS, 1):
        report(done)
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
                    "deadline": allowed,
                    "trajectory": np.arange(trajectories),
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
