"""The lesson of a flow: how states move over a sample, where there are no equations."""

import numpy as np
import torch
from torch import nn

from observers import Flow, Motion
from training.lessons.run import Run
from training.maps.coordinates import spread
from training.maps.networks import Network, tensor
from training.sources import OF_MEDIAN, Increments, Source

WIDTH, DEPTH, BATCH, LEARNING_RATE = 24, 2, 1024, 3e-3
LEAST = 0.01  # of the mean square of scaled increments, added to it: errors of smaller ones are not taken relative
LEAST_ERROR = 0.01  # of the increments' size, that is assumed at least


def learn_flow(source: Source, run: Run) -> Motion:
    """Learn the motion of a tracker over a sample: an affine fit, and a network on what that leaves.

    Parameters
    ----------
    source : Source
        Where motions come from.
    run : Run
        The training under way, with the configuration.

    Returns
    -------
    Motion
        With factors of one, which :func:`training.calibrate` replaces.

    Raises
    ------
    ValueError
        If no two samples in a row have all states, or such an observer cannot track.
    """
    parts = source.tracking()
    with run.timed("motions"), run.progress.phase("motions for a flow") as report:
        learned, judged = source.increments(report=report)
    parts = {"x_offset": learned.x.mean(0), "x_scale": spread(learned.x)} | parts
    offset, scale = parts["x_offset"], parts["x_scale"]  # of a simulated source, in which its process noise is
    u_scale = np.abs(learned.u).max(0, initial=0.0)
    u_scale = np.where(u_scale > 0, u_scale, 1.0)
    problem = FlowProblem(learned, offset, scale, u_scale, run.device)
    run.minimise(
        "flow", problem.network, problem.loss, run.config.flow_steps, learning_rate=LEARNING_RATE, optimiser="soap"
    )
    flow = problem.flow()
    s = (judged.x - offset) / scale
    missed = np.abs(flow(s, judged.u) - s - judged.change / scale)
    least = LEAST_ERROR * np.sqrt(np.mean((learned.change / scale) ** 2, axis=0))
    error = np.maximum(OF_MEDIAN * np.median(missed, axis=0), least)
    return Motion(**parts | {"flow": flow, "error": error})


class FlowProblem:
    """The affine part by least squares, and the batches on which the network is trained."""

    def __init__(
        self, increments: Increments, offset: np.ndarray, scale: np.ndarray, u_scale: np.ndarray, device: torch.device
    ) -> None:
        inputs = np.column_stack([(increments.x - offset) / scale, increments.u / u_scale])
        change = increments.change / scale
        affine = np.column_stack([np.ones(len(inputs)), inputs])
        self.linear, self.u_scale = np.linalg.lstsq(affine, change, rcond=None)[0].T, u_scale
        left = change - affine @ self.linear.T
        self.gain = left.std(0)
        left = left / np.where(self.gain > 0, self.gain, 1.0)
        self.network: nn.Module = Network(
            inputs.shape[1], change.shape[1], width=WIDTH, depth=DEPTH, activation="tanh"
        ).to(device)
        self._inputs, self._left = tensor(inputs, device), tensor(left, device)
        self._weight = tensor(1.0 / ((left**2).mean(-1) + LEAST), device)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error of a batch, relative to what the affine part leaves of each sample."""
        rows = torch.randint(len(self._inputs), (BATCH,), generator=generator, device=self._inputs.device)
        square = (self.network(self._inputs[rows]) - self._left[rows]).square().mean(-1)
        loss = (self._weight[rows] * square).mean()
        return {"loss": loss, "error": loss.detach().sqrt()}

    def flow(self) -> Flow:
        """The flow as it is now."""
        assert isinstance(self.network, Network)
        return Flow(self.network.export(), self.linear, self.gain, self.u_scale)


__all__ = ["learn_flow"]
