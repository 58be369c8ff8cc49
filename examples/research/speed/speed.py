"""``python -m examples.research speed``."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from rich.console import Console
from rich.table import Column, Table

import kkl_gym
from examples.research.speed.observers import in_turns, limit, observer_tasks, record_tasks, table_rows
from kkl_gym.compiled import batch_step
from observers import Artifact, KKLObserver
from observers import shipped as shipped_maps
from observers.names import resolve
from training.commands.options import OneObserver, OneSystem, Shown, shown
from training.progress import ProgressBars, progress_bars

REFERENCE = "Pendulum-v1"
VECTOR_REFERENCE = "CartPole-v1"
OTHERS = ("large",)  # kinds of maps that ship beside the default ones


@dataclass(frozen=True)
class Speed:
    """Time environments, bare and with an observer, against Gymnasium's Pendulum-v1 and batched CartPole-v1.

    Actions are drawn beforehand. The environments take turns, several times over, and each ratio is the median of
    those to the reference in the same turn, because a shared machine's speed drifts. A system of yours has rows with an
    observer if one is named; without one, what `kkl_gym.KKLMemory` takes is timed too.

    Times are this process's CPU time, in which others on the machine take no part: run it with one thread. The third
    table has observers without any environment, beside extended Kalman filters on the same samples. Its last columns
    are the additions and multiplications of the batch's network per second, those that its matrix products reach by
    themselves, and the one as a share of the other.
    """

    system: OneSystem = None
    observer: OneObserver = None
    steps: int = 5000
    """Steps of each single environment in a turn."""
    turns: int = 7
    """Number of turns."""
    num_envs: int = 1024
    """Rows of the vector environments."""
    vector_steps: int = 1000
    """Steps of each vector environment in a turn, from starts in the training box on."""

    def run(self, console: Console) -> dict[str, float]:
        """Measure and print; returns the ratios."""
        for name in ("steps", "turns", "num_envs", "vector_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        environments = shown(self.system, self.observer)
        with progress_bars(console) as progress:
            ratios = self._single(environments, progress) | self._vector(environments, progress)
            self._observers(environments, progress)
            self._records(environments, progress)
            if self.system is None:
                self._memory(progress)
        return ratios

    def _single(self, environments: Sequence[Shown], progress: ProgressBars) -> dict[str, float]:
        envs: dict[str, Any] = {REFERENCE: gym.make(REFERENCE)}
        for one in environments:
            envs |= variants(one, partial(gym.make, one.env_id, **one.options), kkl_gym.KKLObservation)
        seconds = self._timed("timing single environments", envs, self.steps, progress)
        ratios = _ratios(seconds, REFERENCE)
        table = Table(Column("environment", no_wrap=True), "µs per step", f"speed relative to {REFERENCE}")
        for name, ratio in ratios.items():
            table.add_row(name, f"{1e6 * np.median(seconds[name]) / self.steps:.1f}", f"{ratio:.2f}")
        progress.console.print(table)
        return ratios

    def _vector(self, environments: Sequence[Shown], progress: ProgressBars) -> dict[str, float]:
        """Time whole steps, and their parts on the states after the last one."""
        make = partial(gym.make_vec, num_envs=self.num_envs, vectorization_mode="vector_entry_point")
        envs: dict[str, Any] = {VECTOR_REFERENCE: make(VECTOR_REFERENCE)}
        for one in environments:
            envs |= variants(one, partial(make, one.env_id, **one.options), kkl_gym.KKLVectorObservation, with_z=True)
        seconds = self._timed(f"timing {self.num_envs} environments at once", envs, self.vector_steps, progress)
        ratios = _ratios(seconds, VECTOR_REFERENCE)
        first = Column(f"{self.num_envs} rows", no_wrap=True)
        table = Table(first, "µs per step", "simulation", "network", f"speed relative to {VECTOR_REFERENCE}")
        for name, ratio in ratios.items():
            step = float(np.median(seconds[name])) / self.vector_steps
            table.add_row(name, f"{1e6 * step:.0f}", *_parts(envs[name], step), f"{ratio:.2f}")
        progress.console.print(table)
        return {f"{name}, {self.num_envs} rows": ratio for name, ratio in ratios.items()}

    def _observers(self, environments: Sequence[Shown], progress: ProgressBars) -> None:
        """Time observers without environments, beside Kalman filters."""
        n, vector_steps = self.num_envs, -(-self.vector_steps // 10)
        title = Column("observers alone", no_wrap=True)
        table = Table(title, "µs per step", f"µs per step, {n} rows", "GFLOP/s", "GFLOP/s of its products", "share")
        for one in environments:
            for name in (one.observer or one.system.name, *_others(one).values()) if one.observed else ():
                artifact = Artifact.read(resolve(name))
                tasks = observer_tasks(artifact, one.system, rows=None, steps=self.steps)
                batch = observer_tasks(artifact, one.system, rows=n, steps=vector_steps)
                many = KKLObserver(artifact, tracking=False)  # for its network, T_inv
                many.reset(np.zeros((n, artifact.ny)))
                many.step(np.zeros((n, artifact.ny)), np.full((n, artifact.nu), 1e-3))
                products, operations = limit(artifact.inverse, n)
                tasks |= {f"{n}, {key}": task for key, task in batch.items()}
                tasks |= {"network": partial(_seconds, many.decode, 10), "products": products}
                report = progress.bar(f"timing {name} alone", len(tasks) * (self.turns + 1))
                seconds = {key: float(np.median(of)) for key, of in in_turns(tasks, self.turns, report).items()}
                rows = table_rows(
                    {key: value for key, value in seconds.items() if key.startswith(("KKL", "EKF"))},
                    {key: seconds[f"{n}, {key}"] for key in batch},
                    network=seconds["network"],
                    products=seconds["products"],
                    operations=operations,
                )
                for first, *others in rows:
                    table.add_row(f"{name}, {first}", *others)
        if table.row_count:
            progress.console.print(table)

    def _records(self, environments: Sequence[Shown], progress: ProgressBars) -> None:
        """Time `estimate` along whole records: of one observer, an hour at 100 Hz by default, and of many."""
        steps, n = 72 * self.steps, self.num_envs
        title = Column("records", no_wrap=True)
        sizes = {1: steps, n: steps // n}
        table = Table(title, *(f"µs a sample, {rows} of {count:,} samples" for rows, count in sizes.items()))
        for one in filter(lambda one: one.observed, environments):
            artifact = Artifact.read(resolve(one.observer or one.system.name))
            medians: list[dict[str, float]] = []
            for rows, count in sizes.items():
                tasks = record_tasks(artifact, one.system, rows=rows, steps=count)
                report = progress.bar(f"timing records of {rows}", len(tasks) * 4)
                seconds = in_turns(tasks, 3, report)
                medians.append({name: 1e6 * float(np.median(times)) for name, times in seconds.items()})
            for name in medians[0]:
                table.add_row(f"{one.label}, {name}", *(f"{each[name]:.2f}" for each in medians))
        if table.row_count:
            progress.console.print(table)

    def _memory(self, progress: ProgressBars) -> None:
        """Time a memory around environments that take next to no time themselves."""
        n = self.num_envs
        title = Column("rows of 8 outputs and 2 inputs", no_wrap=True)
        table = Table(title, "bare, µs per step", "with memory, µs per step", "µs more per row")
        for rows, steps, envs in (
            (1, self.steps, {"bare": Still(), "memory": kkl_gym.KKLMemory(Still())}),
            (n, self.vector_steps, {"bare": StillVector(n), "memory": kkl_gym.KKLVectorMemory(StillVector(n))}),
        ):
            seconds = self._timed(f"timing the memory of {rows} rows", envs, steps, progress)
            # The fastest turns: in a difference of medians other programs would count.
            bare, memory = (1e6 / steps * min(seconds[name]) for name in envs)
            table.add_row(f"{rows}", f"{bare:.1f}", f"{memory:.1f}", f"{(memory - bare) / rows:.2f}")
        progress.console.print(table)

    def _timed(
        self, description: str, envs: Mapping[str, Any], steps: int, progress: ProgressBars
    ) -> dict[str, list[float]]:
        """CPU seconds of each environment in each turn."""
        tasks = {}
        for name, env in envs.items():
            env.action_space.seed(0)
            tasks[name] = partial(timed, env, [env.action_space.sample() for _ in range(steps)])
        return in_turns(tasks, self.turns, progress.bar(description, len(tasks) * (self.turns + 1)))


def variants(
    one: Shown, make: Callable[[], Any], observe: Callable[..., Any], *, with_z: bool = False
) -> dict[str, Any]:
    """A system's environment by name: bare, and with each observer that there is."""
    wrapped: dict[str, dict[str, Any]] = {}
    if one.observed:
        artifact = Artifact.read(resolve(one.observer or one.system.name))
        default = {"observer": one.observer, "ignore_input": not artifact.nu}  # estimates are not judged here
        if with_z:
            wrapped["z"] = {**default, "estimate": "z"}
        wrapped["x_hat"] = default
        if artifact.inverse.error_covariance is not None:
            wrapped["x_hat, error bars"] = {**default, "uncertainty": True}
        wrapped |= {f"x_hat, {kind}": {"observer": name} for kind, name in _others(one).items()}
    envs = {f"{one.label}, {what}": observe(make(), **options) for what, options in wrapped.items()}
    return {one.label: make(), **envs}


def _others(one: Shown) -> dict[str, str]:
    """Maps that ship for a system beside its default, by kind."""
    names = {kind: f"{one.system.name}-{kind}" for kind in OTHERS}
    there = shipped_maps() if one.observer is None and one.observed else {}
    return {kind: name for kind, name in names.items() if name in there}


class Still(gym.Env[np.ndarray, np.ndarray]):
    """Eight outputs that rest and two inputs without effect."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (8,))
    action_space = gym.spaces.Box(-1.0, 1.0, (2,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin."""
        return np.zeros(8, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Stay."""
        return np.zeros(8, np.float32), 0.0, False, False, {}


class StillVector(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many :class:`Still`."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs, self.metadata = num_envs, {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space, self.single_action_space = Still.observation_space, Still.action_space
        self.observation_space = batch_space(Still.observation_space, num_envs)
        self.action_space = batch_space(Still.action_space, num_envs)
        self._never = np.zeros(num_envs, dtype=bool)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin."""
        return np.zeros((self.num_envs, 8), np.float32), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Stay."""
        never = self._never
        return np.zeros((self.num_envs, 8), np.float32), never.astype(float), never, never, {}


def timed(env: Any, actions: Sequence[np.ndarray]) -> float:
    """CPU seconds of an environment's steps; vector environments reset by themselves."""
    single = isinstance(env, gym.Env)
    env.reset(seed=0)
    started = time.process_time()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if single and (terminated or truncated):
            env.reset()
    return time.process_time() - started


def _parts(env: Any, step: float) -> tuple[str, str]:
    """Shares of simulation and network in a step's seconds, empty where there is no such part."""
    info = env.step(env.action_space.sample())[-1]
    simulation, network, base = "", "", env.unwrapped
    if isinstance(base, kkl_gym.KKLVectorEnv):
        system, x = base.plant.system, info["x"].T.copy()
        u, w, advance = np.zeros((system.nu, x.shape[1])), np.zeros_like(x), batch_step(system)
        simulation = _share(lambda: advance(x, u, w, base.plant.dt), step)
    if isinstance(env, kkl_gym.KKLVectorObservation) and env.estimate == "x" and not env.observer.tracking:
        network = _share(partial(_decoded, env.observer, error_bars="x_cov" in info), step)
    return simulation, network


def _decoded(observer: KKLObserver, *, error_bars: bool) -> None:
    observer.decode()
    if error_bars:
        observer.decode_covariance()


def _share(task: Callable[[], object], whole: float) -> str:
    return f"{100 * np.median([_seconds(task, 1) for _ in range(50)]) / whole:.0f} %"


def _seconds(task: Callable[[], object], repetitions: int) -> float:
    """CPU seconds of a task, the mean of some repetitions."""
    began = time.process_time()
    for _ in range(repetitions):
        task()
    return (time.process_time() - began) / repetitions


def _ratios(seconds: Mapping[str, list[float]], reference: str) -> dict[str, float]:
    base = np.array(seconds[reference])
    return {name: float(np.median(base / np.array(times))) for name, times in seconds.items()}
