"""Fitting the network that estimates hidden signals from stacked observations."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from observers import MLP
from training.agents.any_environment.observing import OBSERVER, SETTINGS
from training.agents.any_environment.task import HiddenTask
from training.agents.any_environment.window import WindowEstimator
from training.maps.networks import Network
from training.maps.optimise import optimise_at_once
from training.progress import ProgressBars
from training.recorded.config import RecordedConfig
from training.records import Record, Rollouts
from training.rollouts.callback import rehearsed

DEFAULT = RecordedConfig(eigenvalues=(-1.0,), dt=1.0, measurement_noise_max=1.0)  # as large a network as an observer's


def learn_window(
    task: HiddenTask, records: Sequence[Record], folder: Path, *, seed: int, progress: ProgressBars
) -> Path:
    """Fit an estimator on stacked observations to an agent's first steps, by what an observer is fitted with.

    That is the same number of batches of the same size, the same optimiser, and a network of the same width and depth.
    Noise of the task's level is added to the outputs, in each batch anew.

    Parameters
    ----------
    task : HiddenTask
        Of which environment, what is measured, and how many observations are stacked.
    records : sequence of Record
        Of these steps, without noise.
    folder : Path
        Receives the file.
    seed : int
        Of the training.
    progress : ProgressBars
        Where a bar is shown.

    Returns
    -------
    Path
        The estimator's file.
    """
    torch.manual_seed(seed)
    regression = _Regression(task, records)
    name, steps = f"estimates from {task.frames} observations", SETTINGS["inverse_steps"]
    optimise_at_once(
        name, regression, regression.loss, progress, steps=steps, learning_rate=DEFAULT.learning_rate, seed=seed
    )
    path = folder / OBSERVER
    WindowEstimator(regression.export(), task.frames).save(path)
    return path


class _Regression(nn.Module):
    """The network, and the stacks and hidden signals that it is fitted to, all of them scaled."""

    def __init__(self, task: HiddenTask, records: Sequence[Record]) -> None:
        super().__init__()
        entries, states, stacks, first = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), 0
        frames, noise, ny = task.frames, task.measurement_noise, len(task.measured)
        for record in records:
            assert record.u is not None
            assert record.x is not None
            y = record.y
            if noise:  # what is measured is among the states, as it was before any noise
                estimated = sorted(task.told(record.x.shape[1]))
                y = record.x[:, [estimated.index(entry) for entry in task.measured]]
            acted = np.concatenate([np.zeros_like(record.u[:1]), record.u[:-1]])  # before each output
            entries.append(np.concatenate([y, acted], axis=1))
            states.append(record.x)
            ages = np.arange(len(y))[:, None] - np.arange(frames)[::-1]
            stacks.append(first + np.maximum(ages, 0))  # before an episode there was its first output
            first += len(y)
        table, x = np.concatenate(entries), np.concatenate(states)
        stack = np.concatenate(stacks)[np.isfinite(x).all(1)]
        self._noise = np.where(np.arange(table.shape[1]) < ny, noise, 0.0)
        self._mean, self._x_mean = table.mean(0), np.nanmean(x, 0)
        self._scale = _or_one(np.sqrt(table.var(0) + self._noise**2))
        self._x_scale = _or_one(np.nanstd(x, 0))
        self._table, self._x = _tensor((table - self._mean) / self._scale), _tensor((x - self._x_mean) / self._x_scale)
        self._stack, self._noise_scaled = torch.as_tensor(stack), _tensor(self._noise / self._scale)
        width, depth, activation = DEFAULT.width, DEFAULT.depth, DEFAULT.activation
        self._frames = frames
        self.network = Network(frames * table.shape[1], x.shape[1], width=width, depth=depth, activation=activation)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error of a batch, in standard deviations of the signals."""
        stack = self._stack[torch.randint(len(self._stack), (DEFAULT.batch,), generator=generator)]
        seen = self._table[stack]
        if self._noise.any():
            noise = torch.randn(seen.shape, generator=generator)
            for i in reversed(range(self._frames - 1)):  # an episode's first output has one noise wherever it stands
                again = (stack[:, i] == stack[:, i + 1])[:, None]
                noise[:, i] = torch.where(again, noise[:, i + 1], noise[:, i])
            seen = seen + self._noise_scaled * noise
        return {"loss": ((self.network(seen.flatten(1)) - self._x[stack[:, -1]]) ** 2).mean()}

    def export(self) -> MLP:
        """The network in units of the signals."""
        found = self.network.export()
        (first, *weights), (bias, *biases) = found.weights, found.biases
        scaled = first / np.tile(self._scale, self._frames)
        bias = bias - scaled @ np.tile(self._mean, self._frames)
        weights[-1] = weights[-1] * self._x_scale[:, None]
        biases[-1] = biases[-1] * self._x_scale + self._x_mean
        return MLP([scaled, *weights], [bias, *biases], found.activation)


class WindowRefits(BaseCallback):
    """Fits an estimator again to an agent's own episodes, as :class:`training.KKLTrainingCallback` fits an observer.

    Parameters
    ----------
    learn : callable
        As :func:`learn_window`, told all but the records.
    every : int
        Steps of all environments together from refit to refit, where an algorithm begins to collect.
    rehearsal : int
        Further steps at the end, in which the agent acts without exploration, and which end in a last refit.
    records : sequence of Record
        From before, which it is fitted to as well.
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
            self._refit(ended=True)

    def _on_training_end(self) -> None:
        for _ in rehearsed(self.model, self._rehearsal):
            pass  # the environments keep what happens
        self._refit(ended=False)

    def _refit(self, *, ended: bool) -> None:
        played: list[Rollouts] = self.training_env.env_method("rollouts", ended=ended)
        records = [*self._records, *(record for one in played if one.episodes for record in one.records())]
        if not records:
            return
        with torch.random.fork_rng():  # the agent's random numbers stay its own
            estimator = WindowEstimator.read(self._learn(records))
        self.training_env.env_method("replace_estimator", estimator)


def refitting_window(
    task: HiddenTask,
    times: int,
    steps: int,
    rehearsal: int,
    path: Path,
    records: Sequence[Record] = (),
    *,
    seed: int,
    progress: ProgressBars,
) -> WindowRefits:
    """Make what fits an estimator again to an agent's own steps, at equal distances.

    Parameters
    ----------
    task : HiddenTask
        Where the agent acts.
    times : int
        How often.
    steps : int
        Of the agent's training.
    rehearsal : int
        Steps after them in which the agent acts without exploration, for a last refit.
    path : Path
        Receives the estimator in use at each time.
    records : sequence of Record
        From before, which it is fitted to as well.
    seed : int
        Of its training.
    progress : ProgressBars
        Where bars are shown.

    Returns
    -------
    WindowRefits
        For the training.
    """
    learn = partial(learn_window, task, folder=path.parent, seed=seed, progress=progress)
    return WindowRefits(learn, max(1, steps // (times + 1)), rehearsal, records)


def _or_one(scale: np.ndarray) -> np.ndarray:
    """Of signals that never change, one."""
    return np.where(scale > 1e-9, scale, 1.0)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


__all__ = ["WindowRefits", "learn_window", "refitting_window"]
