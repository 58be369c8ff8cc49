"""Tasks that time steps of environments, observers and Kalman filters in CPU seconds."""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from examples.research.derivatives import jacobian
from kkl_gym.simulate import advance, simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.estimator import Running
from observers.machine import available
from training.kalman import ExtendedKalmanFilter, measurement_covariance, process_intensity
from training.sources.simulated import unknown_start

BATCHES = 10  # number of steps of Kalman filters on a batch of rows; few, because these filters are slow
FEWER = 10  # divides the number of samples on which single steps in Python are timed


Name = TypeVar("Name", bound=Hashable)


def in_turns(
    tasks: Mapping[Name, Callable[[], float]], turns: int, report: Callable[[int], object] = lambda done: None
) -> dict[Name, list[float]]:
    """Run tasks in turns, because a shared machine's speed drifts; the first turn does not count."""
    seconds: dict[Name, list[float]] = {name: [] for name in tasks}
    for turn in range(turns + 1):
        for i, (name, task) in enumerate(tasks.items(), 1):
            elapsed = task()
            if turn:
                seconds[name].append(elapsed)
            report(turn * len(tasks) + i)
    return seconds


def seconds_of(task: Callable[[], object], count: int) -> float:
    """Run a task, and return its CPU seconds divided by ``count``, its number of steps."""
    began = time.process_time()
    task()
    return (time.process_time() - began) / count


def environment_task(env: Any, actions: Sequence[np.ndarray]) -> Callable[[], float]:
    """Return a task that times an environment's steps; vector environments reset by themselves."""
    single = isinstance(env, gym.Env)

    def steps() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if single and (terminated or truncated):
                env.reset()

    def task() -> float:
        env.reset(seed=0)
        return seconds_of(steps, len(actions))

    return task


def observer_tasks(artifact: Artifact, system: System, *, rows: int, steps: int) -> dict[str, Callable[[], float]]:
    """Return tasks that time an observer and extended Kalman filters, on the same samples of motions from X.

    The first half of an observer's steps is not timed, because a tracker may evaluate T_inv at each early sample.
    Single steps in Python, by far the slowest, are timed on fewer samples.
    """
    u = np.array(system.u_max) * np.random.default_rng(1).uniform(-1, 1, (steps + 1, rows, system.nu))
    y = noisy_samples(artifact, system, rows, steps, u=u[1:])
    known = u[..., : artifact.nu]
    samples = (y, known) if rows > 1 else (y[:, 0], known[:, 0])
    few = -(-steps // FEWER)
    ways = {", NumPy": (False, few), "": (True, steps)} if rows == 1 and available() else {"": (None, steps)}
    tasks = {}
    for way, (compiled, count) in ways.items():
        taken = tuple(each[: count + 1] for each in samples)
        tasks[f"KKL{way}"] = _stepping(KKLObserver(artifact, compiled=compiled), *taken)
        if artifact.inverse.error_covariance is not None:
            observer = KKLObserver(artifact, compiled=compiled)
            tasks[f"KKL, error bars{way}"] = _stepping(observer, *taken, error_bars=True)
    R = measurement_covariance(system, artifact.measurement_noise)
    Q = process_intensity(system, system.process_noise, artifact.filter.dt)
    ekf = Running(ExtendedKalmanFilter(system, artifact.filter.dt, Q=Q, R=R))
    tasks["EKF"] = _stepping(ekf, y[: (BATCHES if rows > 1 else few) + 1], u)
    with suppress(ImportError):
        from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF

        each = [_Filterpy(FilterpyEKF, system, artifact.filter.dt, Q=Q, R=R) for _ in range(rows)]
        count = min(BATCHES, steps) if rows > 1 else few

        def filterpy() -> None:
            for k in range(count):
                for row, one in enumerate(each):
                    one.step(y[k, row], u[k, row])

        tasks["EKF of filterpy"] = partial(seconds_of, filterpy, count)
    return tasks


def record_tasks(artifact: Artifact, system: System, *, rows: int, steps: int) -> dict[str, Callable[[], float]]:
    """Return tasks that time estimates along records, by the observer and, if dynamax is installed, by dynamax's EKF.

    dynamax's EKF uses the differential equations of the observer's tracker, and is left out if the tracker has none.
    """
    y, motion, observer = noisy_samples(artifact, system, rows, steps), artifact.motion, KKLObserver(artifact)
    taken = y if rows > 1 else y[:, 0]
    estimates: dict[str, Callable[[], object]] = {"KKL": lambda: observer.estimate(taken)}
    if motion is not None and motion.equations is not None and motion.equations.substeps:
        with suppress(ImportError):
            of_dynamax = _dynamax(artifact)
            estimates["EKF of dynamax"] = lambda: of_dynamax(y.swapaxes(0, 1) if rows > 1 else taken)
    return {name: partial(seconds_of, estimate, y.shape[0] * rows) for name, estimate in estimates.items()}


def noisy_samples(artifact: Artifact, system: System, rows: int, steps: int, u: np.ndarray | None = None) -> np.ndarray:
    """Return noisy samples of motions from X, (steps + 1, rows, ny)."""
    rng = np.random.default_rng(0)
    low, high = np.transpose(system.X)
    starts = rng.uniform(low, high, (rows, system.nx))
    y = np.nan_to_num(system.output(simulate(system, starts, steps, artifact.filter.dt, u=u)))
    return np.asarray(y + np.asarray(artifact.measurement_noise) * rng.standard_normal(y.shape))


def _dynamax(artifact: Artifact) -> Callable[[np.ndarray], np.ndarray]:
    """Wrap dynamax's compiled EKF as a function from one or several records (steps, ny) to estimates."""
    import jax
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    jax.config.update("jax_enable_x64", True)
    jnp, motion, space = jax.numpy, artifact.require_motion(), dict[str, Any]()
    equations = motion.equations
    assert equations is not None
    exec(equations.field.python("f", artifact.nx, artifact.nu), {"np": jnp}, space)
    if artifact.h is not None:
        exec(artifact.h.python("h", artifact.nx, 0), {"np": jnp}, space)
    u, substeps = [0.0] * artifact.nu, equations.substeps
    h = artifact.filter.dt / substeps

    def f(x: Any) -> Any:
        return jnp.stack(space["f"](*x, *u))

    def move(x: Any) -> Any:
        for _ in range(substeps):
            k1 = f(x)
            k2 = f(x + h / 2 * k1)
            k3 = f(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + f(x + h * k3))
        return x

    def measure(x: Any) -> Any:
        return jnp.array(artifact.C) @ x if artifact.h is None else jnp.stack(space["h"](*x))

    q, r = motion.variances(artifact.measurement_noise, artifact.process_noise_max or 0.0)
    Q = np.diag(q * motion.x_scale**2)
    params = ParamsNLGSSM(motion.mean, motion.covariance, move, Q, measure, np.diag(r))

    def along(y: Any) -> Any:
        return extended_kalman_filter(params, y, output_fields=["filtered_means"]).filtered_means

    one, several = jax.jit(along), jax.jit(jax.vmap(along))
    return lambda y: np.asarray((several if y.ndim == 3 else one)(y))


def _stepping(observer: Any, y: np.ndarray, u: np.ndarray, *, error_bars: bool = False) -> Callable[[], float]:
    half, last = len(y) // 2, len(y) - 1

    def task() -> float:
        observer.reset(y[0])
        for k in range(1, last + 1):
            if k == half:
                began = time.process_time()
            observer.step(y[k], u[k])
            if error_bars:
                observer.decode_covariance()
        return (time.process_time() - began) / (last + 1 - half)

    return task


class _Filterpy:
    """filterpy's EKF as users would set it up; this repository's functions integrate and linearise the equations."""

    def __init__(self, kind: Any, system: System, dt: float, *, Q: np.ndarray, R: np.ndarray) -> None:
        self._system, self._dt = system, dt
        self._filter = kind(dim_x=system.nx, dim_z=system.ny)
        self._start = unknown_start(system)
        self._filter.x, self._filter.P = (np.array(each) for each in self._start)
        self._filter.Q, self._filter.R = Q * dt, R
        self._low, self._high = np.array(system.bounds).T
        self._f, self._h = jacobian(system.f, system.nx), jacobian(system.h, system.nx)
        self._w = [0.0] * system.nx

    def step(self, y: np.ndarray, u: np.ndarray) -> None:
        found, system = self._filter, self._system
        state = found.x.tolist()
        found.F = np.eye(system.nx) + self._dt * self._matrix(self._f, state)
        found.P = found.F @ found.P @ found.F.T + found.Q
        found.x = np.array(advance(system, state, u.tolist(), self._w, self._dt))
        found.update(y, lambda x: self._matrix(self._h, x.tolist()), lambda x: np.array(system.h(x)))
        if not ((self._low <= found.x) & (found.x <= self._high)).all():  # the estimate has diverged
            found.x, found.P = (np.array(each) for each in self._start)

    def _matrix(self, rows: Any, x: list[float]) -> np.ndarray:
        return np.array([[row[j](*x) if j in row else 0.0 for j in range(self._system.nx)] for row in rows])
