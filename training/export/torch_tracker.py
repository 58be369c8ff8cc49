"""The tracker's recursion (:mod:`observers.tracker`) in Torch, for a batch of rows along the last axis."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from observers.artifact import Artifact
from training.export.exported import tracker_arrays, tracker_numbers
from training.export.torch_parts import Module, Network, TorchExpression, between, eliminated, product

Tracked = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Scaled states (nx, n), P (nx, nx, n), NIS (n,), mean square of the trend (n,), number of samples (n,), trend (ny, n).

The trend is the running mean of the whitened innovations.
"""
Prediction = tuple[Tensor, Tensor, Tensor, Tensor]
"""Means (nx, n), covariances (nx, nx, n) and covariances with the previous states (nx, nx, n); their validity (n,)."""


class TorchTracker(Module):
    """The tracker of an artifact; between :meth:`advance` and :meth:`supervise`, the linear filter takes the sample."""

    def __init__(self, artifact: Artifact, dtype: torch.dtype) -> None:
        super().__init__()
        motion, factors = artifact.require_motion(), artifact.require_motion().factors
        self.nx, self.ny, self.dt = artifact.nx, artifact.ny, artifact.filter.dt
        self.width = self.nx + self.nx**2 + 3 + self.ny  # numbers in a row of the state
        self.numbers = numbers = tracker_numbers(motion, self.dt)
        self.window, self.far = float(numbers["window"]), math.sqrt(0.5 / numbers["other"])
        self.least_process_noise = motion.least_process_noise
        self.h = None if artifact.h is None else TorchExpression(artifact.h.components)
        others = [numbers["other"]] * (2 * self.nx)
        columns = tracker_arrays(motion) | {"units": np.outer(motion.x_scale, motion.x_scale)}
        columns |= {name: getattr(motion, name) for name in ("error", "process_noise", "least_measurement_noise")}
        columns |= {"eye": np.eye(self.nx), "eye_y": np.eye(self.ny), "weights": np.array([numbers["middle"], *others])}
        columns |= {"square_weights": np.array([numbers["middle_squares"], *others])}
        if motion.equations is not None:
            self.equations: Any = replace(motion.equations, field=TorchExpression(motion.equations.field.components))
        if (flow := motion.flow) is not None:
            self.flow = Network(flow.mlp, dtype)
            columns |= {"gain": flow.gain, "u_scale": flow.u_scale, "affine": flow.linear[:, 0]}
            self.put(linear=flow.linear[:, 1:])
        if artifact.C is not None:
            columns |= {"C": artifact.C * motion.x_scale, "C_offset": artifact.C @ motion.x_offset}
        self.put(**{name: values[..., None] for name, values in columns.items()})
        self.put(levels=factors.levels, ages=factors.ages, factors=factors.factors[0], most=factors.factors[-1])

    def covariance(self, state: Tensor, age: Tensor, share: Tensor, process_share: Tensor) -> Tensor:
        """Return calibrated covariances (n, nx^2) at ages (n, 1), for noise levels (n, 1) as shares of the largest."""
        table = self.factors + process_share.clamp(max=1.0)[..., None] * (self.most - self.factors)
        factor = between(age, self.ages, between(share, self.levels, table).log()[..., None]).exp()
        return factor * (self._unpacked(state)[1] * self.units).flatten(0, 1).T

    def states(self, s: Tensor) -> Tensor:
        """Return the states (nx, n) in their own units, from scaled states."""
        return s * self.x_scale + self.x_offset

    def advance(
        self, state: Tensor, y: Tensor, u: Tensor, begins: Tensor, measurement_noise: Tensor, process_noise: Tensor
    ) -> tuple[Tracked, Tensor]:
        """Predict and correct by y (ny, n); return the state (its NIS infinite on failure) and the expected outputs."""
        Q = self.eye * ((process_noise.clamp(min=self.least_process_noise) * self.process_noise) ** 2 + self.error**2)
        R = self.eye_y * torch.maximum(measurement_noise, self.least_measurement_noise) ** 2
        numbers, (x0, P0, nis, square, seen, trend) = self.numbers, self._unpacked(state)
        x0, P0 = torch.where(begins, self.start_mean, x0), torch.where(begins, self.start_covariance, P0)
        new = (seen < self.window) & ~begins
        prediction = self._predicted(x0, P0, u, Q, x0.new_zeros(self.nx, 0, 1), x0.new_zeros(0, 1))
        for _ in range(numbers["relinearisations"]):
            prediction = self._relinearised(x0, P0, prediction, new, y, u, Q, R)
        mean, P, _, sound = prediction
        mean, P = torch.where(begins, x0, mean), torch.where(begins, P0, P)
        V, white, expected, known = self._corrected(mean, P, y, R)
        x, P = mean + (V * white).sum(1), P - product(V, V)
        sound = sound & known & (x.sum(0) + P.sum((0, 1))).isfinite() & (eliminated(P)[1] | ~begins)
        there = (~y.isnan()).to(x.dtype)
        count = there.sum(0)
        moved = trend + numbers["trend_share"] * there * (white - trend)
        nis = nis + numbers["share"] / self.ny * ((white**2).sum(0) - count * nis)
        change = numbers["trend_gain"] * (there * moved**2).sum(0) - count * square
        raised = square + numbers["trend_square_share"] / self.ny * change
        coloured, going = (raised > numbers["trend_limit"]) & (count > 0) & ~begins, sound & ~begins
        raised = torch.where(going, torch.where(coloured, 1.0, raised), square)
        return (
            torch.where(sound, self._within(x), x0),
            torch.where(sound, torch.where(coloured, numbers["inflation"] * P, P), P0),
            torch.where(begins, 1.0, torch.where(sound, nis, math.inf)),
            torch.where(begins, 1.0, raised),
            torch.where(going, seen + count.clamp(max=1.0), seen),
            torch.where(going, torch.where(coloured, 0.0, moved), trend),
        ), expected

    def supervise(self, tracked: Tracked, x_hat: Tensor, covariance: Callable[[Tensor], Tensor]) -> Tensor:
        """Use T_inv's estimates (nx, n) after a divergence, and while seen < window if their covariance is smaller."""
        x, P, nis, square, seen, trend = tracked
        # The cause of a divergence may have disturbed z, too: take T_inv's covariance at an age of at most a window.
        learned = covariance(seen.clamp(max=self.window)[:, None] * self.dt)
        lost, learned = ~(nis <= self.numbers["limit"]), learned.reshape(P.shape) / self.units
        of_learned, own = (eliminated(each)[0].diagonal().log().sum(1) for each in (learned, P))
        taken = lost | ((seen < self.window) & (of_learned < own))  # compares determinants
        x = torch.where(taken, self._within((x_hat - self.x_offset) / self.x_scale), x)
        P = torch.where(taken, learned, P).flatten(0, 1)
        nis, square = torch.where(lost, 1.0, nis), torch.where(lost, 1.0, square)
        return torch.cat([x, P, torch.stack([nis, square, seen]), torch.where(lost, 0.0, trend)])

    def _unpacked(self, state: Tensor) -> Tracked:
        x, P, statistics, trend = torch.split(state, [self.nx, self.nx**2, 3, self.ny])
        return x, P.reshape(self.nx, self.nx, -1), statistics[0], statistics[1], statistics[2], trend

    def _predicted(self, x: Tensor, P: Tensor, u: Tensor, Q: Tensor, G: Tensor, white: Tensor) -> Prediction:
        """Predict x and P; the motion is linearised about the mean x + G ``white`` and the covariance P - G G^T."""
        rows, sound = eliminated(P - product(G, G), G.transpose(0, 1).expand(-1, -1, x.shape[1]))
        L, H = rows[: self.nx], rows[self.nx :]
        mean, S, E = self._transformed(x + (G * white).sum(1), L, self._moved, u)
        D = product(E, H)
        return mean - (D * white).sum(1), S + Q + product(D, D), product(L, E) + product(G, D), sound

    def _relinearised(
        self, x: Tensor, P: Tensor, prediction: Prediction, new: Tensor, y: Tensor, u: Tensor, Q: Tensor, R: Tensor
    ) -> Prediction:
        """In rows ``new``, predict again: linearise the motion about the previous state as smoothed by the sample."""
        nx, (mean, S, across, sound) = self.nx, prediction
        V, white, _, known = self._corrected(mean, S, y, R)
        rows, solvable = eliminated(S, across, V.transpose(0, 1))
        *again, taken = self._predicted(x, P, u, Q, product(rows[nx : 2 * nx], rows[2 * nx :]), white)
        taken = taken & new & solvable & known & (again[0].sum(0) + again[1].sum((0, 1))).isfinite()
        mean, S, across = (torch.where(taken, *pair) for pair in zip(again, prediction, strict=False))
        return mean, S, across, taken | sound

    def _corrected(self, mean: Tensor, P: Tensor, y: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return V, ``white``, expected outputs, V's validity. The corrected moments: mean + V ``white``, P - V V^T."""
        sound = torch.ones_like(mean[0], dtype=torch.bool)
        if self.h is None:
            V = product(P, self.C)
            expected, S = (self.C * mean).sum(1) + self.C_offset, product(self.C, V.transpose(0, 1))
        else:
            L, sound = eliminated(P)
            expected, S, E = self._transformed(mean, L, self._output, y[:0])
            V = product(L, E)
        missing = y.isnan()
        S, V = torch.where(missing[:, None] | missing, self.eye_y, S + R), torch.where(missing, 0.0, V)
        rows, known = eliminated(S, V, torch.where(missing, 0.0, y - expected)[None])
        return rows[self.ny : -1], rows[-1], expected, sound & known

    def _transformed(
        self, x: Tensor, L: Tensor, function: Callable[[Tensor, Tensor], Tensor], u: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean and covariance of f(s), s ~ N(x, L L^T), by sigma points, and E with L E^T = cov(s, f(s))."""
        middle, far, count = x[:, None], self.far * L, 1 + 2 * self.nx
        to = function(torch.cat([middle, middle + far, middle - far], 1).flatten(1), u.repeat(1, count))
        to = to.reshape(len(to), count, -1)
        if function == self._output:  # where h is undefined, use h at the mean
            to = torch.where(to.isfinite(), to, to[:, :1])
        mean = (to * self.weights).sum(1)
        off, (plus, minus) = to - mean[:, None], torch.split(to[:, 1:], self.nx, 1)
        return mean, product(off * self.square_weights, off), self.far * self.numbers["other"] * (plus - minus)

    def _moved(self, s: Tensor, u: Tensor) -> Tensor:
        """Return the scaled states (nx, n) one sample later."""
        s = self._within(s)
        if hasattr(self, "flow"):
            q = torch.cat([s, u / self.u_scale])
            return self._within(s + self.affine + self.linear @ q + self.gain * self.flow(q.T).T)
        moved: Tensor = self.equations(self.states(s), u, self.dt)
        return self._within((moved - self.x_offset) / self.x_scale)

    def _output(self, s: Tensor, _: Tensor) -> Tensor:
        """Return outputs of scaled states (nx, n) or, where h is undefined, of the states limited to their bounds."""
        assert self.h is not None
        y, near = (self.h(self.states(each)) for each in (s, self._within(s)))
        return torch.where(y.isfinite(), y, near)

    def _within(self, s: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(s, self.low), self.high)
