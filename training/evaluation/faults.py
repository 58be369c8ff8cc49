"""Simulated sensor faults, and the delay after which an observer's monitor detects them."""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
import pandas as pd

from kkl_gym.simulate import check_duration
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.evaluation.levels import Level
from training.presets import profile
from training.seeds import Stream, generator
from training.sources.simulated import SOUND
from training.trajectories.motions import Controller, Motions

Fault = Literal["none", "bias", "drop-out", "freeze"]
FAULTS: tuple[Fault, ...] = get_args(Fault)
BIAS = 0.2  # size of a bias, in multiples of the output's range


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
    """Simulate sensors that fail in the middle of a trajectory; return the scores and delays of the monitor."""
    check_duration(duration, dt := artifact.filter.dt)
    if trajectories < (least := 1 + bool(artifact.nu and not policy)):
        raise ValueError(f"trajectories must be at least {least}, got {trajectories}")
    deadline = profile(system).fault_deadline or duration / 5
    if not deadline <= duration / 2:
        raise ValueError(f"duration must be at least {2 * deadline:g} s to simulate faults, got {duration:g} s")
    rng, noise = generator(Stream.FAULTS, seed), (system.process_noise,)
    motions = Motions(system, dt, round(duration / dt), **SOUND, levels=noise, policy=policy)
    x, u, *_ = motions.with_inputs(artifact.nu).drawn(trajectories, rng)
    clean = system.output(x)
    y = clean + np.asarray(measurement_noise) * rng.standard_normal(clean.shape)
    # The bias is a share of the output's range: along free motions, as random inputs widen it, or under a policy.
    free = slice(None) if policy else ~u.any((0, 2))
    half, within = len(y) // 2, round(deadline / dt)
    bias = BIAS * np.ptp(clean[half:, free], axis=(0, 1))
    faulty = {"none": y[half:], "bias": y[half:] + bias, "drop-out": 0.0, "freeze": y[half]}
    observer = KKLObserver(artifact, measurement_noise, monitor=True, process_noise=system.process_noise)
    frames = []
    for done, (fault, late) in enumerate(faulty.items(), 1):
        report(done)
        seen, score = y.copy(), np.zeros(y.shape[:2])
        seen[half:] = late
        observer.reset(seen[0])
        for k in range(1, len(y)):
            observer.advance(seen[k], u[k - 1] if artifact.nu else None)
            score[k] = observer.score
        first = 0 if fault == "none" else half
        alarms, judged = score[first:] > 1, score[first : None if fault == "none" else half + within]
        columns = {"system": system.name, "fault": fault, "deadline": deadline, "trajectory": np.arange(trajectories)}
        delay = np.where(alarms.any(0), alarms.argmax(0) * dt, np.inf)
        frames.append(pd.DataFrame(columns | {"score": judged.max(0), "delay": delay}))
    return pd.concat(frames, ignore_index=True)
