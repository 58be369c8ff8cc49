"""Fitting the network that estimates hidden signals from stacked observations."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn

from observers import MLP
from training.agents.any_environment.observing import OBSERVER, SETTINGS
from training.agents.any_environment.task import HiddenTask
from training.agents.any_environment.window import WindowEstimator
from training.maps.networks import Network
from training.maps.optimise import optimise_at_once
from training.progress import ProgressBars
from training.recorded.config import RecordedConfig
from training.records import Record

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
    regression = _Regression(records, task.frames, task.measurement_noise)
    name, steps = f"estimates from {task.frames} observations", SETTINGS["inverse_steps"]
    optimise_at_once(
        name, regression, regression.loss, progress, steps=steps, learning_rate=DEFAULT.learning_rate, seed=seed
    )
    path = folder / OBSERVER
    WindowEstimator(regression.export(), task.frames).save(path)
    return path


class _Regression(nn.Module):
    """The network, and the stacks and hidden signals that it is fitted to, all of them scaled."""

    def __init__(self, records: Sequence[Record], frames: int, noise: float) -> None:
        super().__init__()
        entries, states, stacks, first = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), 0
        for record in records:
            assert record.u is not None
            assert record.x is not None
            acted = np.concatenate([np.zeros_like(record.u[:1]), record.u[:-1]])  # before each output
            entries.append(np.concatenate([record.y, acted], axis=1))
            states.append(record.x)
            ages = np.arange(len(record.y))[:, None] - np.arange(frames)[::-1]
            stacks.append(first + np.maximum(ages, 0))  # before an episode there was its first output
            first += len(record.y)
        table, x, ny = np.concatenate(entries), np.concatenate(states), records[0].y.shape[1]
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


def _or_one(scale: np.ndarray) -> np.ndarray:
    """Of signals that never change, one."""
    return np.where(scale > 1e-9, scale, 1.0)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


__all__ = ["learn_window"]
