"""The rival of observers: a network that estimates hidden signals from stacked observations.

It learns from the same steps as an observer does, with as many batches, the same loss and as large a network. What an
observer's filter is worth is the difference between the two.
"""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from kkl_gym.wrappers.vector import VectorEnv
from observers import MLP, storage
from training.agents.environments import single, vector
from training.agents.history import stacked
from training.agents.information import FeatureObservation, Information, Values, outputs
from training.agents.observing import (
    KEPT,
    OBSERVER,
    SETTINGS,
    Estimation,
    estimated_entries,
    latest,
    oldest_first,
    signals,
)
from training.agents.tasks import Task
from training.config import Config
from training.maps.inverse import Batch, InverseProblem
from training.maps.networks import Network
from training.progress import ProgressBars
from training.records import Record
from training.rollouts.callback import rehearsed
from training.rollouts.playing import Recorder
from training.run import Stage, optimise
from training.sources.recorded import RECORDED

KEY = "kkl-gym-window"
DEFAULT = Config("input-aware", eigenvalues=(-1.0,), dt=1.0, **RECORDED)  # for the size of its network


def save(path: Path, network: MLP) -> None:
    """Write a network from stacks to hidden signals."""
    tensors: dict[str, np.ndarray] = {}
    storage.put_mlp(tensors, "", network)
    storage.save(path, tensors, key=KEY, described={"activation": network.activation})


def read(path: Path | str) -> MLP:
    """Read such a network."""
    tensors, described = storage.read(path, key=KEY, error=ValueError, what="an estimator on stacked observations")
    with storage.explained(path, ValueError):
        return storage.get_mlp(tensors, "", described["activation"])


class WindowObservation(FeatureObservation):
    """Shows y and the estimates from stacked observations, under noise the estimates alone, and records the steps."""

    def __init__(self, task: Task, rows: int, network: MLP) -> None:
        self.network, self.recorders = network, list[Recorder]()
        entries: list[int] = []
        low = high = np.empty(0)

        def each() -> gym.Env[Any, Any]:
            nonlocal entries, low, high
            env = single(task)
            space: Any = env.observation_space
            entries = list(estimated_entries(task, len(space.low)))
            low, high = space.low[entries], space.high[entries]
            self.recorders.append(Recorder(env, **signals(task, env), keep=max(1, KEPT // rows)))
            return self.recorders[-1]

        env = stacked(outputs(task, vector(task, rows, each=each)), task.frames)
        ny, width = len(task.measured), gym.spaces.flatdim(env.single_observation_space)
        latest_y = slice(width - width // task.frames, width - width // task.frames + ny)

        def feature(at: Values) -> np.ndarray:
            estimates = self.network(at["obs"])
            if task.measurement_noise:
                return estimates
            return np.concatenate([at["obs"][:, latest_y], np.clip(estimates, low, high)], axis=1)

        super().__init__(env, feature, len(entries) + (0 if task.measurement_noise else ny))


def learn_window(task: Task, records: Sequence[Record], folder: Path, *, seed: int, progress: ProgressBars) -> Path:
    """Fit a network to an agent's first steps; each batch draws noise of the task's level on the outputs."""
    torch.manual_seed(seed)
    stacks = Stacks(task, records)
    width, depth, activation = DEFAULT.width, DEFAULT.depth, DEFAULT.activation
    network = Network(len(stacks.mean), len(stacks.x_mean), width=width, depth=depth, activation=activation)
    sampler: Any = stacks
    problem = InverseProblem(network, sampler, torch.device("cpu"))
    with tempfile.TemporaryDirectory() as checkpoints:
        stage = Stage(
            name=f"estimates from {task.frames} observations",
            steps=SETTINGS["inverse_steps"],
            learning_rate=DEFAULT.learning_rate,
            folder=Path(checkpoints),
            fingerprint="",
            seed=seed,
            optimiser="soap",
        )
        optimise(stage, problem, problem.loss, progress, resume=False)
    save(folder / OBSERVER, stacks.in_units(network.export()))
    return folder / OBSERVER


class Stacks:
    """Batches of stacked observations and hidden signals, both scaled, in cells by how full stacks are.

    Shapes: ``mean``, ``scale`` (inputs,), ``x_mean``, ``x_scale`` (outputs,).
    """

    parameters = 0

    def __init__(self, task: Task, records: Sequence[Record]) -> None:
        entries, states, begins = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        noise, ny, first = task.measurement_noise, len(task.measured), 0
        for record in records:
            assert record.u is not None
            assert record.x is not None
            y = record.y
            if noise:  # the measured signals are among the states, without noise
                estimated = estimated_entries(task, record.x.shape[1])
                y = record.x[:, [estimated.index(entry) for entry in task.measured]]
            acted = np.concatenate([np.zeros_like(record.u[:1]), record.u[:-1]])  # before each output
            entries.append(np.concatenate([y, acted], axis=1))
            states.append(record.x)
            begins.append(np.full(len(y), first))
            first += len(y)
        table, x = np.concatenate(entries), np.concatenate(states)
        known = np.isfinite(x).all(1) & np.isfinite(table).all(1)
        noisy = np.where(np.arange(table.shape[1]) < ny, noise, 0.0)
        mean, scale = table[known].mean(0), _or_one(np.sqrt(table[known].var(0) + noisy**2))
        self.mean, self.scale = np.tile(mean, task.frames), np.tile(scale, task.frames)
        self.x_mean, self.x_scale = x[known].mean(0), _or_one(x[known].std(0))
        self.cells = task.frames
        self._table, self._noise = _tensor((table - mean) / scale), _tensor(noisy / scale)
        self._x = _tensor((x - self.x_mean) / self.x_scale)
        self._begins, self._known = torch.as_tensor(np.concatenate(begins)), torch.as_tensor(np.flatnonzero(known))
        self._back = torch.arange(task.frames - 1, -1, -1)

    def __call__(self, generator: torch.Generator) -> Batch:
        """Draw a batch."""
        rows = self._known[torch.randint(len(self._known), (DEFAULT.batch,), generator=generator)]
        begins = self._begins[rows]
        stack = torch.maximum(rows[:, None] - self._back, begins[:, None])  # an episode's first row stands before it
        seen = self._table[stack]
        if self._noise.any():
            noise = torch.randn(seen.shape, generator=generator)
            for i in reversed(range(self.cells - 1)):  # an episode's first output has one noise wherever it stands
                noise[:, i] = torch.where((stack[:, i] == stack[:, i + 1])[:, None], noise[:, i + 1], noise[:, i])
            seen = seen + self._noise * noise
        cell = torch.clamp(rows - begins, max=self.cells - 1)
        return Batch(seen.flatten(1), self._x[rows], torch.ones(len(rows)), cell)

    def in_units(self, network: MLP) -> MLP:
        """A network between scaled signals as one between signals in their units."""
        weights, biases = [w.astype(float) for w in network.weights], [b.astype(float) for b in network.biases]
        weights[0] = weights[0] / self.scale
        biases[0] = biases[0] - weights[0] @ self.mean
        weights[-1] = weights[-1] * self.x_scale[:, None]
        biases[-1] = biases[-1] * self.x_scale + self.x_mean
        return MLP(weights, biases, network.activation)


class WindowRefits(BaseCallback):
    """Fits the network again to an agent's own episodes, as :class:`training.KKLTrainingCallback` fits an observer.

    Nothing is held out, and every fit is taken.
    """

    def __init__(
        self, learn: Callable[[Sequence[Record]], Path], every: int, rehearsal: int, records: Sequence[Record]
    ) -> None:
        super().__init__()
        self._learn, self._every, self._rehearsal, self._records = learn, every, rehearsal, list(records)
        self._steps, self._next = 0, every

    def _on_step(self) -> bool:
        self._steps += self.training_env.num_envs
        return True

    def _on_rollout_start(self) -> None:
        if self._steps >= self._next:
            self._next = self._steps + self._every
            self._refit()

    def _on_training_end(self) -> None:
        for _ in rehearsed(self.model, self._rehearsal):
            pass  # the environments record the steps
        self._refit()

    def _refit(self) -> None:
        bridge: Any = self.training_env.unwrapped
        window: WindowObservation = bridge.env
        rows = [recorder.rollouts(going_on=True).records() for recorder in window.recorders]
        with torch.random.fork_rng():  # the agent's random numbers stay its own
            window.network = read(self._learn(latest([*self._records, *oldest_first(rows)])))


def _show(task: Task, information: Information, rows: int, path: str | None) -> VectorEnv:
    return WindowObservation(task, rows, read(str(path)))


def _refits(
    task: Task, learn: Callable[[Sequence[Record]], Path], every: int, rehearsal: int, path: Path, records: Any
) -> BaseCallback:
    return WindowRefits(learn, every, rehearsal, records)


STACKED = Estimation(_show, learn_window, _refits)


def _or_one(scale: np.ndarray) -> np.ndarray:
    """Standard deviations as scales: 1 where nothing varies."""
    return np.where(scale > 1e-9, scale, 1.0)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)
