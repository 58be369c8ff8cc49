"""The evaluation of the benchmark's observers."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from examples.research.methods import Method
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers.estimator import Running
from training.evaluation.errors import TRANSIENT, Domain, UnseenTrajectories, starts, unseen_trajectories
from training.evaluation.levels import Level, as_cell, multiple
from training.evaluation.metrics import by_state, nrmse, smape
from training.seeds import Stream, generator

UNTIMED, TIMED = 100, 400  # samples in a round of step_time: first UNTIMED, for convergence, then at most TIMED
LOST = 50.0  # a trajectory with a larger SMAPE in % after the transient counts as lost


@dataclass(frozen=True)
class Protocol:
    """The test trajectories."""

    domains: tuple[Domain, ...] = ("X", "1.5X", "2X")
    measurement_noise: tuple[Level, ...] = (0.0, 0.5)
    trajectories: int = 100
    duration: float = 50.0
    seed: int = 0


def with_shared_noise(
    system: System, runs: UnseenTrajectories, *, measurement_noise: Level, n: int, seed: tuple[Stream, *tuple[int, ...]]
) -> np.ndarray:
    """Return outputs with noise on every sample, the same noise for every method.

    ``measurement_noise`` is one level, or one for each output. Returns (steps + 1, trajectories inside bounds, ny).
    """
    unit = generator(*seed).standard_normal((n, len(runs.x), system.ny))
    v = np.asarray(measurement_noise) * unit[: len(runs.inside)][runs.inside].swapaxes(0, 1)
    y: np.ndarray = system.output(runs.x) + v
    return y


def component_smape(x: np.ndarray, x_hat: np.ndarray, skip: int = 0) -> np.ndarray:
    """Return the mean of the components' SMAPEs, (n,); the paper's notebooks print it for the last 80 % of steps."""
    return np.mean([smape(x[..., [i]], x_hat[..., [i]], skip) for i in range(x.shape[-1])], axis=0)


def measure(method: Method[Any], trained: Any, system: System, *, dt: float, protocol: Protocol) -> pd.DataFrame:
    """Evaluate an observer on test trajectories. Returns a row for each domain, noise level and trajectory."""
    n, frames = protocol.trajectories, []
    for i, domain in enumerate(protocol.domains):
        seed = (Stream.EVALUATION, protocol.seed, 1, i)
        runs = unseen_trajectories(system, dt, n=n, duration=protocol.duration, seed=protocol.seed, domain=domain)
        skip = round(TRANSIENT * len(runs.x))
        for noise in protocol.measurement_noise:
            y = with_shared_noise(system, runs, measurement_noise=noise, n=n, seed=seed)
            x_hat = Running(method.observer(trained, system, dt, noise)).along(y)
            late = smape(runs.x, x_hat, skip)
            errors = pd.DataFrame(
                {
                    "trajectory": np.flatnonzero(runs.inside),
                    "smape": smape(runs.x, x_hat),
                    "smape_late": late,
                    "component_late": component_smape(runs.x, x_hat, skip),
                    "lost": ((late > LOST) | ~np.isfinite(x_hat).all((0, 2))).astype(float),
                    **by_state(nrmse(runs.x, x_hat, skip)),
                }
            )
            frame = pd.DataFrame({"starts": domain, "noise": as_cell(noise), "trajectory": range(n)})
            frame["escaped"] = (~runs.inside).astype(int)
            frames.append(frame.merge(errors, how="left", on="trajectory"))
    return pd.concat(frames, ignore_index=True)


def tuned_for(method: Method[Any], system: System) -> tuple[Level, ...] | None:
    """Return noise levels for the comparison of a method's configurations; None stands for the test's levels."""
    return None if method.tuned_for is None else tuple(multiple(system, factor) for factor in method.tuned_for)


def validate(method: Method[Any], trained: Any, system: System, *, dt: float, protocol: Protocol) -> float:
    """Return the geometric mean, over noise levels, of the median SMAPE in % on validation trajectories from X."""
    n = protocol.trajectories
    runs = unseen_trajectories(
        system,
        dt,
        n=n,
        duration=protocol.duration,
        seed=protocol.seed,
        domain="X",
        stream=Stream.VALIDATION,
    )
    if not runs.inside.any():
        raise ValueError(f"every validation trajectory of {system.name} left its bounds; widen them or shrink X")
    seed = (Stream.VALIDATION, protocol.seed, 1)
    medians = []
    for noise in tuned_for(method, system) or protocol.measurement_noise:
        y = with_shared_noise(system, runs, measurement_noise=noise, n=n, seed=seed)
        x_hat = Running(method.observer(trained, system, dt, noise)).along(y)
        medians.append(np.median(smape(runs.x, x_hat)))
    return float(np.exp(np.mean(np.log(np.maximum(medians, 1e-6)))))


def step_time(
    method: Method[Any], trained: Any, *, system: System, dt: float, batch: int, seconds: float = 0.3
) -> float:
    """Return the CPU time in µs of a batch's step after the transient: the mean in the fastest of five rounds."""
    observer = Running(method.observer(trained, system, dt, system.measurement_noise))
    x = simulate(system, starts(system, "X", batch, np.random.default_rng(0)), UNTIMED + TIMED, dt)
    y = np.nan_to_num(system.output(x))
    best = np.inf
    for _ in range(5):
        observer.reset(y[0])
        for sample in y[1 : UNTIMED + 1]:
            observer.step(sample)
        steps, began = 0, time.process_time()
        for sample in y[UNTIMED + 1 :]:
            observer.step(sample)
            steps += 1
            if (spent := time.process_time() - began) >= seconds / 5:
                break
        best = min(best, spent / steps)
    return 1e6 * best
