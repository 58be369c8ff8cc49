"""The interface of the benchmark's methods: training from a system and a budget gives a causal observer."""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from torch import nn

from kkl_gym.system import System
from observers import storage
from observers.estimator import Estimator
from training.evaluation.levels import Level
from training.progress import progress_bars
from training.run import Loss, Stage, optimise
from training.seeds import Stream, generator
from training.trajectories.equations import describe
from training.trajectories.motions import Motions, recording_ages

_KEY = "kkl-gym-method"

Trained = TypeVar("Trained")
Configuration = Mapping[str, Any]
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Budget:
    """The data, network size and CPU time of each training."""

    name: str
    trajectories: int
    duration: float
    samples: int
    cpu_seconds: float
    width: int = 128
    depth: int = 3
    activation: str = "tanh"
    dt: float = 0.01
    steps: int = 10**9


@dataclass(frozen=True)
class Data:
    """Noise-free training trajectories: y at all samples, and x at the samples ``ages``.

    Shapes: ``ages`` (m,), ``x`` (m, n, nx), ``y`` (steps + 1, n, ny).
    """

    ages: np.ndarray
    x: np.ndarray
    y: np.ndarray


@lru_cache(maxsize=1)
def simulated(system: System, n: int, *, duration: float, samples: int, dt: float, seed: int) -> Data:
    """Simulate the training data of a system; the same for every method."""
    rng = generator(Stream.TRAINING, seed)
    steps = max(1, round(duration / dt))
    ages = recording_ages(steps, samples)
    xs, ys = [], []
    for x, *_ in Motions(system, dt, steps).chunks(n, rng):
        xs.append(x[ages])
        ys.append(system.output(x).astype(np.float32))
    return Data(ages, np.concatenate(xs, 1), np.concatenate(ys, 1))


@dataclass(frozen=True)
class Task:
    """One training of a method: its system, budget, folder and seed."""

    system: System
    budget: Budget
    folder: Path
    seed: int = 0

    @cached_property
    def data(self) -> Data:
        """The training trajectories, which are simulated at the first call."""
        budget = self.budget
        return simulated(
            self.system,
            budget.trajectories,
            duration=budget.duration,
            samples=budget.samples,
            dt=budget.dt,
            seed=self.seed,
        )

    @property
    def rng(self) -> np.random.Generator:
        """A new generator with the same seed at every call."""
        return generator(Stream.TRAINING, self.seed, 1)

    def fit(self, name: str, module: nn.Module, loss: Loss, learning_rate: float, share: float = 1.0) -> None:
        """Minimise a loss by Adam within a share of the CPU time; resumes from a checkpoint if there is one."""
        self.folder.mkdir(parents=True, exist_ok=True)
        identity = json.dumps([describe(self.system), asdict(self.budget), self.seed], sort_keys=True)
        limits: dict[str, Any] = {"steps": self.budget.steps, "cpu_seconds": self.budget.cpu_seconds * share}
        where: dict[str, Any] = {"folder": self.folder, "fingerprint": identity, "seed": self.seed}
        stage = Stage(name=name, learning_rate=learning_rate, **limits, **where)
        with progress_bars(None) as progress:
            optimise(stage, module, loss, progress, resume=True)


class Method(ABC, Generic[Trained]):
    """A method of training observers; docs/results/benchmark.md shows how to add one."""

    name: ClassVar[str]
    label: ClassVar[str]
    tuned_for: ClassVar[tuple[float, ...] | None] = None

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Propose one to three configurations; the benchmark takes the best of them on validation trajectories."""
        return ({},)

    @abstractmethod
    def train(self, task: Task, configuration: Configuration) -> Trained:
        """Train for a task; the result is passed to :meth:`observer` and :meth:`save` as ``trained``."""

    @abstractmethod
    def observer(self, trained: Trained, system: System, dt: float, measurement_noise: Level, /) -> Estimator[Any]:
        """Make an observer. The arguments are positional, so that a class may choose their names.

        ``measurement_noise`` is one level for all outputs, or a tuple with one for each.
        """

    def save(self, trained: Trained, path: Path) -> None:
        """Write the result of a training atomically; by default it is a dictionary of arrays."""
        if not isinstance(trained, dict):
            raise TypeError(f"{type(self).__name__} trains a {type(trained).__name__}: override save and load")
        storage.save(path, trained, key=_KEY, described={"method": self.name})

    def load(self, path: Path) -> Trained:
        """Read what :meth:`save` wrote."""
        try:
            arrays, described = storage.read(path, key=_KEY, error=ValueError, what="a trained method")
        except ValueError as error:
            raise ValueError(f"{error}; remove it to train again") from error
        if described.get("method") != self.name:
            raise ValueError(f"{path} was written by method {described.get('method')!r}, not {self.name!r}")
        return arrays  # type: ignore[return-value]
