"""What every observer of the benchmark is measured on."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from kkl_gym.system import System
from training.evaluation.errors import TRANSIENT, Domain, UnseenTrajectories, starts, unseen_trajectories
from training.evaluation.metrics import component_smape, rmse, settling_time, smape
from training.methods import CausalObserver, Method
from training.seeds import Stream

LOST = 50.0  # % of SMAPE after the transient, above which a trajectory counts as lost


@dataclass(frozen=True)
class Protocol:
    """Trajectories to test on.

    domains : where they start: in X, or in a multiple of X without X.
    noise : standard deviations of the measurement noise.
    trajectories : number for each domain; each is taken at every noise level.
    duration : their length in seconds.
    seed : of starts and noise.
    """

    domains: tuple[Domain, ...] = ("X", "1.5X", "2X")
    noise: tuple[float, ...] = (0.0, 0.5)
    trajectories: int = 100
    duration: float = 50.0
    seed: int = 0


def run(observer: CausalObserver, y: np.ndarray) -> np.ndarray:
    """Estimates (steps + 1, n, nx) of a causal observer that is given one sample at a time of y, (steps + 1, n, ny)."""
    first = observer.reset(y[0])
    out = np.empty((len(y), *first.shape))
    out[0] = first
    for k in range(1, len(y)):
        out[k] = observer.step(y[k])
    return out


def with_shared_noise(
    system: System, runs: UnseenTrajectories, *, noise: float, n: int, seed: tuple[int, ...]
) -> np.ndarray:
    """Outputs with noise on every sample, (steps + 1, trajectories, ny).

    The noise is drawn for ``n`` trajectories, of which ``runs`` may be the first few: it is the same for every method.
    """
    unit = np.random.default_rng(seed).standard_normal((n, len(runs.x), system.ny))
    y: np.ndarray = system.output(runs.x) + noise * unit[: len(runs.inside)][runs.inside].swapaxes(0, 1)
    return y


def measure(method: Method[Any], trained: Any, system: System, *, dt: float, protocol: Protocol) -> pd.DataFrame:
    """One row for each test trajectory, noise level and domain.

    Columns: starts, noise, trajectory, escaped, smape (all steps), smape_late, component_late, rmse_late (after the
    first fifth), rmse, settling (seconds), lost. A trajectory that leaves the system's declared bounds is marked as
    escaped and has no errors.
    """
    n = min(protocol.trajectories, method.trajectories or protocol.trajectories)
    frames = []
    for i, domain in enumerate(protocol.domains):
        seed = (Stream.EVALUATION, protocol.seed, 1, i)
        runs = unseen_trajectories(
            system, dt, n=protocol.trajectories, duration=protocol.duration, seed=protocol.seed, domain=domain
        ).first(n)
        skip = round(TRANSIENT * len(runs.x))
        for noise in protocol.noise:
            y = with_shared_noise(system, runs, noise=noise, n=protocol.trajectories, seed=seed)
            x_hat = run(method.observer(trained, system, dt, noise), y)
            late = smape(runs.x, x_hat, skip)
            errors = pd.DataFrame(
                {
                    "trajectory": np.flatnonzero(runs.inside),
                    "smape": smape(runs.x, x_hat),
                    "smape_late": late,
                    "component_late": component_smape(runs.x, x_hat, skip),
                    "rmse": rmse(runs.x, x_hat),
                    "rmse_late": rmse(runs.x, x_hat, skip),
                    "settling": settling_time(runs.x, x_hat, dt),
                    "lost": ((late > LOST) | ~np.isfinite(x_hat).all((0, 2))).astype(float),
                }
            )
            frame = pd.DataFrame({"starts": domain, "noise": noise, "trajectory": range(n)})
            frame["escaped"] = (~runs.inside).astype(int)
            frames.append(frame.merge(errors, how="left", on="trajectory"))
    return pd.concat(frames, ignore_index=True)


def validate(method: Method[Any], trained: Any, system: System, *, dt: float, protocol: Protocol) -> float:
    """How well a configuration does on validation trajectories from X: smaller is better.

    The geometric mean over the noise levels that it is tuned for of the median SMAPE over all steps, in percent.
    """
    n = min(protocol.trajectories, method.trajectories or protocol.trajectories)
    everyone = unseen_trajectories(
        system,
        dt,
        n=protocol.trajectories,
        duration=protocol.duration,
        seed=protocol.seed,
        domain="X",
        stream=Stream.VALIDATION,
    )
    runs = everyone.first(n)
    if not runs.inside.any():
        raise ValueError(f"every validation trajectory of {system.name} left its bounds; widen them or shrink X")
    seed = (Stream.VALIDATION, protocol.seed, 1)
    medians = []
    for noise in method.tuned_for or protocol.noise:
        y = with_shared_noise(system, runs, noise=noise, n=protocol.trajectories, seed=seed)
        x_hat = run(method.observer(trained, system, dt, noise), y)
        medians.append(np.median(smape(runs.x, x_hat)))
    return float(np.exp(np.mean(np.log(np.maximum(medians, 1e-6)))))


def step_time(
    method: Method[Any], trained: Any, *, system: System, dt: float, batch: int, seconds: float = 0.3
) -> float:
    """Microseconds of CPU time for one step of a whole batch: the least of five rounds."""
    observer = method.observer(trained, system, dt, 0.5)
    y = system.output(starts(system, "X", batch, np.random.default_rng(0)))
    observer.reset(y)
    best = np.inf
    for _ in range(5):
        steps, began = 0, time.process_time()
        while not steps or time.process_time() - began < seconds / 5:
            observer.step(y)
            steps += 1
        best = min(best, (time.process_time() - began) / steps)
    return 1e6 * best
