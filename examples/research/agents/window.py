"""The rival of observers: a network that estimates hidden signals from stacked observations.

It learns from the same steps as an observer does, with as many batches, the same loss and as large a network. What an
observer's filter is worth is the difference between the two.
"""

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from observers import MLP, storage
from training.agents.any_environment.information import Stacked, part_of
from training.agents.any_environment.observing import KEPT, OBSERVER, SETTINGS, Estimation, oldest_first
from training.agents.any_environment.task import HiddenTask
from training.config import Config
from training.lessons.run import Stage, optimise
from training.maps.inverse import Batch, InverseProblem
from training.maps.networks import Network
from training.progress import ProgressBars
from training.records import Record
from training.rollouts.callback import rehearsed
from training.rollouts.playing import Recorder
from training.sources.recorded import RECORDED

KEY = "kkl-gym-window"
DEFAULT = Config("input-aware", eigenvalues=(-1.0,), dt=1.0, **RECORDED)  # for the size of its network


@dataclass(frozen=True)
class WindowEstimator:
    """A network from the last outputs, each with the input before it, to hidden signals.

    Shapes: ``mean``, ``scale`` (inputs,).
    """

    network: MLP
    mean: np.ndarray
    scale: np.ndarray

    def __call__(self, stack: np.ndarray) -> np.ndarray:
        """Estimate.

        Shapes: ``stack`` (..., inputs); returns (..., outputs).
        """
        return self.network((stack - self.mean) / self.scale)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to one safetensors file, whole or not at all."""
        tensors: dict[str, np.ndarray] = {"mean": self.mean, "scale": self.scale}
        storage.put_mlp(tensors, "", self.network)
        storage.save(path, tensors, key=KEY, described={"activation": self.network.activation})

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "WindowEstimator":
        """Read what :meth:`save` wrote."""
        tensors, described = storage.read(path, key=KEY, error=ValueError, what="an estimator on stacked observations")
        with storage.explained(path, ValueError):
            network = storage.get_mlp(tensors, "", described["activation"])
            return cls(network, tensors["mean"], tensors["scale"])


class WindowObservation(gym.ObservationWrapper[np.ndarray, Any, np.ndarray]):
    """Shows y and the estimates from stacked observations; under noise the estimates alone."""

    def __init__(self, env: gym.Env[np.ndarray, Any], task: HiddenTask, estimator: WindowEstimator) -> None:
        super().__init__(env)
        self._estimator = estimator
        stacked = gym.spaces.flatdim(env.observation_space)
        latest = stacked - stacked // task.frames
        self._outputs = slice(latest, latest if task.measurement_noise else latest + len(task.measured))

    def replace_estimator(self, estimator: WindowEstimator) -> None:
        """Go on with another estimator for the same task."""
        self._estimator = estimator

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Show the latest outputs of a stack, and estimates."""
        shown = np.concatenate([observation[self._outputs], self._estimator(observation)])
        space: Any = self.observation_space
        return np.clip(shown, space.low, space.high, dtype=np.float32)


def show_window(task: HiddenTask, path: str | os.PathLike[str], *, keep: int | None = None) -> gym.Env[np.ndarray, Any]:
    """Make a task's environment with the estimator of a file; ``keep`` records so many of the last steps."""
    env = task.make()
    whole: Any = env.observation_space
    size = whole.shape[0]
    entries = list(task.estimated_entries(size) if task.measurement_noise else task.told(size))
    low, high = whole.low[entries], whole.high[entries]
    if task.measurement_noise:  # estimates are not clipped, as those of observers are not
        low, high = np.full_like(low, -np.inf), np.full_like(high, np.inf)
    if keep is not None:
        env = Recorder(env, **task.signals(size), keep=keep)
    stacked = Stacked(part_of(env, task.measured), task.frames)
    shown = WindowObservation(stacked, task, WindowEstimator.read(path))
    shown.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
    return shown


def learn_window(
    task: HiddenTask, records: Sequence[Record], folder: Path, *, seed: int, progress: ProgressBars
) -> Path:
    """Fit an estimator to an agent's first steps; each batch draws noise of the task's level on the outputs."""
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
    path = folder / OBSERVER
    WindowEstimator(stacks.in_units(network.export()), stacks.mean, stacks.scale).save(path)
    return path


class Stacks:
    """Batches of stacked observations and hidden signals, both scaled, in cells by how full stacks are.

    Shapes: ``mean``, ``scale`` (inputs,), ``x_mean``, ``x_scale`` (outputs,).
    """

    parameters = 0

    def __init__(self, task: HiddenTask, records: Sequence[Record]) -> None:
        entries, states, begins = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        noise, ny, first = task.measurement_noise, len(task.measured), 0
        for record in records:
            assert record.u is not None
            assert record.x is not None
            y = record.y
            if noise:  # the measured signals are among the states, without noise
                estimated = task.estimated_entries(record.x.shape[1])
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
        """A network whose outputs are scaled signals, with outputs in their units."""
        (*weights, weight), (*biases, bias) = network.weights, network.biases
        scale = self.x_scale
        return MLP([*weights, weight * scale[:, None]], [*biases, bias * scale + self.x_mean], network.activation)


class WindowRefits(BaseCallback):
    """Fits an estimator again to an agent's own episodes, as :class:`training.KKLTrainingCallback` fits an observer.

    Nothing is held out, and no fit is refused.
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
        played = self.training_env.env_method("rollouts", going_on=True)
        records = [*self._records, *oldest_first([one.records() for one in played])]
        left = sum(len(record.t) - 1 for record in records)
        while left - (oldest := len(records[0].t) - 1) >= KEPT:
            left -= oldest
            del records[0]
        with torch.random.fork_rng():  # the agent's random numbers stay its own
            estimator = WindowEstimator.read(self._learn(records))
        self.training_env.env_method("replace_estimator", estimator)


def _show(task: HiddenTask, path: str, keep: int | None) -> gym.Env[np.ndarray, Any]:
    return show_window(task, path, keep=keep)


def _refits(
    task: HiddenTask, learn: Callable[[Sequence[Record]], Path], every: int, rehearsal: int, path: Path, records: Any
) -> BaseCallback:
    return WindowRefits(learn, every, rehearsal, records)


STACKED = Estimation(learn_window, _show, _refits)


def _or_one(scale: np.ndarray) -> np.ndarray:
    """Standard deviations as scales: 1 where nothing varies."""
    return np.where(scale > 1e-9, scale, 1.0)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)
