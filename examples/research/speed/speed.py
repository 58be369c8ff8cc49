"""How fast the environments step, as a ratio to well-known ones measured in the same run."""

import dataclasses
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
from examples.research.speed.observers import in_turns, limit, observer_tasks, table_rows
from kkl_gym.compiled import batch_step
from observers import Artifact, KKLObserver
from observers import shipped as shipped_maps
from observers.names import resolve
from training.commands.options import OneObserver, OneSystem, Shown, shown
from training.presets import SMALL
from training.progress import ProgressBars, progress_bars

REFERENCE = "Pendulum-v1"
VECTOR_REFERENCE = "CartPole-v1"
OTHERS = (SMALL, "static")  # kinds of maps that ship beside the default ones


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
        """Measure and print."""
        for name in ("steps", "turns", "num_envs", "vector_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        environments = shown(self.system, self.observer)
        with progress_bars(console) as progress:
            ratios = self._single(environments, progress) | self._vector(environments, progress)
            self._observers(environments, progress)
            if self.system is None:
                self._memory(progress)
        return ratios

    def _single(self, environments: Sequence[Shown], progress: ProgressBars) -> dict[str, float]:
        envs = {REFERENCE: gym.make(REFERENCE)}
        for one in environments:
            envs[one.label] = gym.make(one.env_id, **one.options)
            if one.observed:
                made = gym.make(one.env_id, **one.options)
                envs[f"{one.label}, x_hat"] = kkl_gym.KKLObservation(made, one.observer)
            if _has_error_bars(one):
                made = gym.make(one.env_id, **one.options)
                envs[f"{one.label}, x_hat, error bars"] = kkl_gym.KKLObservation(made, one.observer, uncertainty=True)
            for kind, name in _others(one).items():
                made = gym.make(one.env_id, **one.options)
                envs[f"{one.label}, x_hat, {kind}"] = kkl_gym.KKLObservation(made, name)
        actions = {name: _drawn(env.action_space, self.steps) for name, env in envs.items()}
        tasks = {name: lambda name=name, env=env: timed(env, actions[name]) for name, env in envs.items()}
        seconds = self._in_turns(tasks, progress.bar("timing single environments", self._runs(tasks)))
        ratios = _ratios(seconds, REFERENCE)
        table = Table(Column("environment", no_wrap=True), "µs per step", f"speed relative to {REFERENCE}")
        for name, ratio in ratios.items():
            table.add_row(name, f"{1e6 * np.median(seconds[name]) / self.steps:.1f}", f"{ratio:.2f}")
        progress.console.print(table)
        return ratios

    def _vector(self, environments: Sequence[Shown], progress: ProgressBars) -> dict[str, float]:
        """Whole steps, and how long their parts take by themselves on what the environment then holds."""

        def make(env_id: str, **options: Any) -> gym.vector.VectorEnv:
            return gym.make_vec(env_id, num_envs=self.num_envs, vectorization_mode="vector_entry_point", **options)

        envs = {VECTOR_REFERENCE: make(VECTOR_REFERENCE)}
        parts: dict[str, dict[str, str]] = {}
        for one in environments:
            envs[one.label] = make(one.env_id, **one.options)
            if one.observed:
                inner = [make(one.env_id, **one.options) for _ in range(2)]
                envs[f"{one.label}, z"] = kkl_gym.KKLVectorObservation(inner[0], one.observer, estimate="z")
                envs[f"{one.label}, x_hat"] = kkl_gym.KKLVectorObservation(inner[1], one.observer)
            if _has_error_bars(one):
                made = make(one.env_id, **one.options)
                wrapped = kkl_gym.KKLVectorObservation(made, one.observer, uncertainty=True)
                envs[f"{one.label}, x_hat, error bars"] = wrapped
            for kind, name in _others(one).items():
                made = make(one.env_id, **one.options)
                envs[f"{one.label}, x_hat, {kind}"] = kkl_gym.KKLVectorObservation(made, name)
        actions = {name: _drawn(env.action_space, self.vector_steps) for name, env in envs.items()}
        tasks = {name: lambda name=name, env=env: timed_vector(env, actions[name]) for name, env in envs.items()}
        report = progress.bar(f"timing {self.num_envs} environments at once", self._runs(tasks))
        seconds = self._in_turns(tasks, report)
        for name, env in envs.items():
            info = env.step(actions[name][0])[-1]
            parts[name] = _parts(env, info, np.median(seconds[name]) / self.vector_steps)
        ratios = _ratios(seconds, VECTOR_REFERENCE)
        title = f"{self.num_envs} rows"
        first = Column(title, no_wrap=True)
        table = Table(first, "µs per step", "simulation", "network", f"speed relative to {VECTOR_REFERENCE}")
        for name, ratio in ratios.items():
            whole = f"{1e6 * np.median(seconds[name]) / self.vector_steps:.0f}"
            table.add_row(name, whole, parts[name]["simulation"], parts[name]["network"], f"{ratio:.2f}")
        progress.console.print(table)
        return {f"{name}, {self.num_envs} rows": ratio for name, ratio in ratios.items()}

    def _observers(self, environments: Sequence[Shown], progress: ProgressBars) -> None:
        """Observers without environments, beside Kalman filters."""
        n, vector_steps = self.num_envs, -(-self.vector_steps // 10)
        title = Column("observers alone", no_wrap=True)
        table = Table(title, "µs per step", f"µs per step, {n} rows", "GFLOP/s", "GFLOP/s of its products", "share")
        observed = [one for one in environments if one.observed]
        for one in observed:
            for name in (one.observer or one.system.name, *_others(one).values()):
                artifact = Artifact.read(resolve(name))
                tasks = observer_tasks(artifact, one.system, rows=None, steps=self.steps)
                batch = observer_tasks(artifact, one.system, rows=n, steps=vector_steps)
                many = KKLObserver(dataclasses.replace(artifact, flow=None))  # for its network, T_inv
                many.reset(np.zeros((n, artifact.ny)))
                many.step(np.zeros((n, artifact.ny)), np.full((n, artifact.nu), 1e-3))
                products, operations = limit(artifact.inverse, n)
                tasks |= {f"{n}, {key}": task for key, task in batch.items()}
                tasks |= {"network": partial(_repeated, many.decode), "products": products}
                report = progress.bar(f"timing {name} alone", self._runs(tasks))
                seconds = {key: float(np.median(of)) for key, of in self._in_turns(tasks, report).items()}
                rows = table_rows(
                    {key: value for key, value in seconds.items() if key.startswith(("KKL", "EKF"))},
                    {key: seconds[f"{n}, {key}"] for key in batch},
                    network=seconds["network"],
                    products=seconds["products"],
                    operations=operations,
                )
                for first, *others in rows:
                    table.add_row(f"{name}, {first}", *others)
        if observed:
            progress.console.print(table)

    def _memory(self, progress: ProgressBars) -> None:
        """What a memory takes, around environments that take next to nothing."""
        envs = {"bare": Still(), "with memory": kkl_gym.KKLMemory(Still())}
        actions = _drawn(envs["bare"].action_space, self.steps)
        tasks = {f"1, {name}": lambda env=env: timed(env, actions) for name, env in envs.items()}
        n = self.num_envs
        vectors = {"bare": StillVector(n), "with memory": kkl_gym.KKLVectorMemory(StillVector(n))}
        drawn = _drawn(vectors["bare"].action_space, self.vector_steps)
        tasks |= {f"{n}, {name}": lambda env=env: timed_vector(env, drawn) for name, env in vectors.items()}
        seconds = self._in_turns(tasks, progress.bar("timing the memory", self._runs(tasks)))
        title = Column("rows of 8 outputs and 2 inputs", no_wrap=True)
        table = Table(title, "bare, µs per step", "with memory, µs per step", "µs more per row")
        for rows, steps in ((1, self.steps), (n, self.vector_steps)):
            # Of the fastest turns, for what others took of the machine is no part of the difference.
            bare, remembering = (1e6 / steps * min(seconds[f"{rows}, {name}"]) for name in envs)
            table.add_row(f"{rows}", f"{bare:.1f}", f"{remembering:.1f}", f"{(remembering - bare) / rows:.2f}")
        progress.console.print(table)

    def _runs(self, tasks: Mapping[str, Any]) -> int:
        return len(tasks) * (self.turns + 1)

    def _in_turns(
        self, tasks: Mapping[str, Callable[[], float]], report: Callable[[int], object] = lambda done: None
    ) -> dict[str, list[float]]:
        return in_turns(tasks, self.turns, report)


class Still(gym.Env[np.ndarray, np.ndarray]):
    """Eight outputs that rest and two inputs that do nothing."""

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


def timed(env: gym.Env, actions: list[np.ndarray]) -> float:
    """Time an environment."""
    env.reset(seed=0)
    started = time.process_time()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return time.process_time() - started


def timed_vector(env: gym.vector.VectorEnv, actions: list[np.ndarray]) -> float:
    """Time a vector environment that resets by itself."""
    env.reset(seed=0)
    started = time.process_time()
    for action in actions:
        env.step(action)
    return time.process_time() - started


def _parts(env: gym.vector.VectorEnv, info: Mapping[str, Any], step: float) -> dict[str, str]:
    """Shares of a step's seconds, from the states that the last one reported."""
    base = env.unwrapped
    shares = {"simulation": "", "network": ""}
    if isinstance(base, kkl_gym.KKLVectorEnv):
        system, x = base.plant.system, info["x"].T.copy()
        u, w, advance = np.zeros((system.nu, x.shape[1])), np.zeros_like(x), batch_step(system)
        shares["simulation"] = _share(lambda: advance(x, u, w, base.plant.dt), step)
    if isinstance(env, kkl_gym.KKLVectorObservation) and env.estimate == "x" and env.observer.artifact.flow is None:
        shares["network"] = _share(lambda: _decoded(env.observer, error_bars="x_cov" in info), step)
    return shares


def _decoded(observer: KKLObserver, *, error_bars: bool) -> None:
    observer.decode()
    if error_bars:
        observer.decode_covariance()


def _has_error_bars(one: Shown) -> bool:
    """Whether there is a map for a system that says covariances."""
    return one.observed and Artifact.read(resolve(one.observer or one.system.name)).inverse.spread is not None


def _others(one: Shown) -> dict[str, str]:
    """What ships for a system beside its default, by kind: the small map, and T_inv alone."""
    names = {kind: f"{one.system.name}-{kind}" for kind in OTHERS}
    there = shipped_maps() if one.observer is None and one.observed else {}
    return {kind: name for kind, name in names.items() if name in there}


def _repeated(task: Callable[[], object]) -> float:
    """CPU seconds that a task takes, the mean of ten."""
    began = time.process_time()
    for _ in range(10):
        task()
    return (time.process_time() - began) / 10


def _share(task: Callable[[], object], whole: float) -> str:
    times = []
    for _ in range(50):
        started = time.process_time()
        task()
        times.append(time.process_time() - started)
    return f"{100 * np.median(times) / whole:.0f} %"


def _drawn(space: gym.Space[Any], steps: int) -> list[np.ndarray]:
    space.seed(0)
    return [space.sample() for _ in range(steps)]


def _ratios(seconds: Mapping[str, list[float]], reference: str) -> dict[str, float]:
    base = np.array(seconds[reference])
    return {name: float(np.median(base / np.array(times))) for name, times in seconds.items()}
