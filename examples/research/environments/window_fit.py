"""Fitting the network that estimates hidden signals from stacked observations."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from examples.research.environments.window import WindowEstimator, show_window
from observers import MLP
from training.agents.any_environment.observing import KEPT, OBSERVER, SETTINGS, Estimation, oldest_first
from training.agents.any_environment.task import HiddenTask
from training.maps.inverse import InverseProblem
from training.maps.networks import Network
from training.maps.optimise import optimise_at_once
from training.maps.samplers import Batch
from training.progress import ProgressBars
from training.recorded.config import RecordedConfig
from training.records import Record
from training.rollouts.callback import rehearsed

DEFAULT = RecordedConfig(eigenvalues=(-1.0,), dt=1.0, measurement_noise_max=1.0)  # as large a network as an observer's


def learn_window(
    task: HiddenTask, records: Sequence[Record], folder: Path, *, seed: int, progress: ProgressBars
) -> Path:
    """Fit an estimator on stacked observations to an agent's first steps, by what an observer is fitted with.

    That is the same number of batches of the same size, the same optimiser and the same loss, and a network of the same
    width and depth. Noise of the task's level is added to the outputs, in each batch anew.
    """
    torch.manual_seed(seed)
    stacks = Stacks(task, records)
    width, depth, activation = DEFAULT.width, DEFAULT.depth, DEFAULT.activation
    network = Network(len(stacks.mean), len(stacks.x_mean), width=width, depth=depth, activation=activation)
    sampler: Any = stacks  # of batches as those of observers are
    problem = InverseProblem(network, sampler, torch.device("cpu"))
    optimise_at_once(
        f"estimates from {task.frames} observations",
        problem,
        problem.loss,
        progress,
        steps=SETTINGS["inverse_steps"],
        learning_rate=DEFAULT.learning_rate,
        seed=seed,
    )
    path = folder / OBSERVER
    found = stacks.in_units(network.export())
    WindowEstimator(found, stacks.mean, stacks.scale, WindowEstimator.made_for(task)).save(path)
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
            if noise:  # what is measured is among the states, as it was before any noise
                estimated = task.estimated_entries(record.x.shape[1])  # which are all, where the task names none
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
        stack = torch.maximum(rows[:, None] - self._back, begins[:, None])  # before an episode there was its first row
        seen = self._table[stack]
        if self._noise.any():
            noise = torch.randn(seen.shape, generator=generator)
            for i in reversed(range(self.cells - 1)):  # an episode's first output has one noise wherever it stands
                noise[:, i] = torch.where((stack[:, i] == stack[:, i + 1])[:, None], noise[:, i + 1], noise[:, i])
            seen = seen + self._noise * noise
        cell = torch.clamp(rows - begins, max=self.cells - 1)
        return Batch(seen.flatten(1), self._x[rows], torch.ones(len(rows)), cell)

    def in_units(self, network: MLP) -> MLP:
        """A network of scaled signals, in units of these."""
        (*weights, weight), (*biases, bias) = network.weights, network.biases
        scale = self.x_scale
        return MLP([*weights, weight * scale[:, None]], [*biases, bias * scale + self.x_mean], network.activation)


class WindowRefits(BaseCallback):
    """Fits an estimator again to an agent's own episodes, as :class:`training.KKLTrainingCallback` fits an observer.

    Nothing is held out, and no fit is refused.
    """

    def __init__(
        self, learn: Callable[[Sequence[Record]], Path], every: int, rehearsal: int, records: Sequence[Record] = ()
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
            pass  # the environments keep what happens
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
    """Of signals that never change, one."""
    return np.where(scale > 1e-9, scale, 1.0)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


__all__ = ["STACKED", "Stacks", "WindowRefits", "learn_window"]
