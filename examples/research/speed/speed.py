"""``python -m examples.research speed``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Column, Table

import kkl_gym
from examples.research.speed.observers import environment_task, in_turns, observer_tasks, record_tasks
from kkl_gym.system import System
from observers import Artifact
from observers import shipped as shipped_maps
from observers.names import resolve
from training.commands.options import OneObserver, OneSystem, Shown, shown
from training.progress import ProgressBars, progress_bars

REFERENCE = "Pendulum-v1"
VECTOR_REFERENCE = "CartPole-v1"
OTHERS = ("large",)  # kinds of shipped maps besides the default ones
# A timed record, or all records of a batch together, has HOUR times Speed.steps samples: by default, an hour at 100 Hz.
HOUR = 72

Tasks = Mapping[str, Callable[[], float]]


@dataclass(frozen=True)
class Speed:
    """Compare the speed of environments, bare and with an observer, to Gymnasium's Pendulum-v1 and batched CartPole-v1.

    Actions are drawn before the timing. The environments run in turns, because a shared machine's speed drifts: each
    ratio is the median over turns of the ratio to the reference in the same turn. An observer for your own system
    is timed if you name its file. The references are also timed with the memory of `kkl_gym.KKLMemory`.

    Times are CPU times, which other processes hardly affect. They add up over threads: use one thread. Further tables
    compare observers alone, without an environment, to extended Kalman filters on the same samples.
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
    """Steps of each vector environment in a turn; its rows start in the training box."""

    def run(self, console: Console) -> dict[str, float]:
        """Measure the times, print tables and return the ratios."""
        for name in ("steps", "turns", "num_envs", "vector_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        environments, n = shown(self.system, self.observer), self.num_envs
        observed = [one for one in environments if one.observed]
        names = {name: one.system for one in observed for name in (_default(one), *_others(one).values())}
        steps = {1: self.steps, n: -(-self.vector_steps // 10)}
        lengths = {1: HOUR * self.steps, n: -(-HOUR * self.steps // n)}
        vector = partial(gym.make_vec, num_envs=n, vectorization_mode="vector_entry_point")
        with progress_bars(console) as progress:
            memory: Any = kkl_gym.KKLMemory
            envs = {REFERENCE: gym.make(REFERENCE), f"{REFERENCE}, memory": memory(gym.make(REFERENCE))}
            for one in environments:
                envs |= variants(one, partial(gym.make, one.env_id, **one.options), kkl_gym.KKLObservation)
            ratios = self._environments(envs, self.steps, progress)
            memory, title = kkl_gym.KKLVectorMemory, f"{VECTOR_REFERENCE}, {n} rows"
            envs = {title: vector(VECTOR_REFERENCE), f"{title}, memory": memory(vector(VECTOR_REFERENCE))}
            for one in environments:
                make = partial(vector, one.env_id, **one.options)
                made = variants(one, make, kkl_gym.KKLVectorObservation, with_z=True)
                envs |= {f"{name}, {n} rows": env for name, env in made.items()}
            ratios |= self._environments(envs, self.vector_steps, progress)
            self._observers("observers alone, µs per step", observer_tasks, names, steps, progress)
            defaults = {_default(one): one.system for one in observed}
            self._observers("records, µs a sample", record_tasks, defaults, lengths, progress)
        return ratios

    def _environments(self, envs: Mapping[str, Any], steps: int, progress: ProgressBars) -> dict[str, float]:
        """Measure each environment's time per step; the first environment is the reference."""
        tasks = {}
        for name, env in envs.items():
            env.action_space.seed(0)
            tasks[name] = environment_task(env, [env.action_space.sample() for _ in range(steps)])
        with progress.phase("timing environments", len(tasks) * (self.turns + 1)) as report:
            seconds = in_turns(tasks, self.turns, report)
        base = np.array(seconds[next(iter(envs))])
        ratios = {name: float(np.median(base / np.array(times))) for name, times in seconds.items()}
        rows = [(name, f"{1e6 * np.median(seconds[name]):,.1f}", f"{ratio:.2f}") for name, ratio in ratios.items()]
        _print(["environment", "µs per step", f"speed relative to {next(iter(envs))}"], rows, progress)
        return ratios

    def _observers(
        self,
        title: str,
        tasks_of: Callable[..., Tasks],
        systems: Mapping[str, System],
        counts: Mapping[int, int],
        progress: ProgressBars,
    ) -> None:
        """Time observers and filters without environments; ``counts`` maps numbers of rows to samples per row."""
        lines = []
        for name, system in systems.items():
            artifact = Artifact.read(resolve(name))
            tasks = {
                (what, rows): task
                for rows, count in counts.items()
                for what, task in tasks_of(artifact, system, rows=rows, steps=count).items()
            }
            with progress.phase(f"timing {name} alone", len(tasks) * (self.turns + 1)) as report:
                seconds = in_turns(tasks, self.turns, report)
            medians = {key: f"{1e6 * np.median(of):,.2f}" for key, of in seconds.items()}
            kinds = dict.fromkeys(what for what, _ in tasks)
            lines += [(f"{name}, {what}", *(medians.get((what, rows), "") for rows in counts)) for what in kinds]
        if lines:
            _print([title, *(f"{rows} rows, {count:,} samples" for rows, count in counts.items())], lines, progress)


def _print(titles: Sequence[str], rows: Sequence[Sequence[str]], progress: ProgressBars) -> None:
    table = Table(Column(titles[0], no_wrap=True), *titles[1:])
    for row in rows:
        table.add_row(*row)
    progress.console.print(table)


def variants(
    one: Shown, make: Callable[[], Any], observe: Callable[..., Any], *, with_z: bool = False
) -> dict[str, Any]:
    """Make variants of a system's environment by name: bare, and with each available observer."""
    wrapped: dict[str, dict[str, Any]] = {}
    if one.observed:
        artifact = Artifact.read(resolve(_default(one)))
        default = {"observer": one.observer, "ignore_input": not artifact.nu}  # x_hat may be wrong: only times matter
        if with_z:
            wrapped["z"] = {**default, "estimate": "z"}
        wrapped["x_hat"] = default
        if artifact.inverse.error_covariance is not None:
            wrapped["x_hat, error bars"] = {**default, "uncertainty": True}
        wrapped |= {f"x_hat, {kind}": {"observer": name} for kind, name in _others(one).items()}
    envs = {f"{one.label}, {what}": observe(make(), **options) for what, options in wrapped.items()}
    return {one.label: make(), **envs}


def _default(one: Shown) -> str:
    return one.observer or one.system.name


def _others(one: Shown) -> dict[str, str]:
    """Return the shipped maps of a system besides its default, by kind."""
    names = {kind: f"{one.system.name}-{kind}" for kind in OTHERS}
    there = shipped_maps() if one.observer is None and one.observed else {}
    return {kind: name for kind, name in names.items() if name in there}
