"""The tracker's recursion (:mod:`observers.tracker`) in Torch; the rows of a batch are the last axis here.

Every row takes the same way through it, and torch.where decides what counts.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from observers.artifact import Artifact
from training.export.exported import tracker_arrays, tracker_numbers
from training.export.torch_parts import Module, Network, between, eliminated, evaluated, product


class Tracked(NamedTuple):
    """The tracker's state: scaled states, covariance, NIS, mean square of the trend, samples seen, trend (ny, n)."""

    x: Tensor
    P: Tensor
    nis: Tensor
    trend_square: Tensor
    seen: Tensor
    trend: Tensor


Prediction = tuple[Tensor, Tensor, Tensor, Tensor]
"""Means (nx, n), covariances (nx, nx, n), those with the states before (nx, nx, n), and where they are sound (n,)."""


class TorchTracker(Module):
    """The tracker of an artifact: between :meth:`advance` and :meth:`supervise` the filter takes in the sample."""

    def __init__(self, artifact: Artifact, dtype: torch.dtype) -> None:
        super().__init__()
        motion, factors = artifact.require_motion(), artifact.require_motion().factors
        self.nx, self.ny, self.dt = artifact.nx, artifact.ny, artifact.filter.dt
        self.numbers = numbers = tracker_numbers(motion, self.dt)
        self.window, self.far = float(numbers["window"]), math.sqrt(0.5 / numbers["other"])
        self.least_process_noise, self.equations, self.h = motion.least_process_noise, motion.equations, artifact.h
        self.flow = None if motion.flow is None else Network(motion.flow.mlp, dtype)
        others = [numbers["other"]] * (2 * self.nx)
        names = ["error", "process_noise", "least_measurement_noise"]
        columns = tracker_arrays(motion) | {name: getattr(motion, name) for name in names}
        columns |= {"weights": np.array([numbers["middle"], *others]), "eye": np.eye(self.nx), "eye_y": np.eye(self.ny)}
        columns["square_weights"] = np.array([numbers["middle_squares"], *others])
        if motion.flow is not None:
            columns |= {"gain": motion.flow.gain, "u_scale": motion.flow.u_scale, "affine": motion.flow.linear[:, 0]}
            self.put(linear=motion.flow.linear[:, 1:])
        if artifact.C is not None:
            columns |= {"C": artifact.C * motion.x_scale, "C_offset": artifact.C @ motion.x_offset}
        self.put(**{name: values[..., None] for name, values in columns.items()})
        self.put(levels=factors.levels, ages=factors.ages, factors=factors.factors[0], most=factors.factors[-1])
        self.put(units=np.outer(motion.x_scale, motion.x_scale)[..., None])

    @property
    def width(self) -> int:
        """Numbers in a row of the state."""
        return self.nx + self.nx**2 + 3 + self.ny

    def covariance(self, state: Tensor, age: Tensor, share: Tensor, process_share: Tensor) -> Tensor:
        """Calibrated covariances (n, nx^2) at ages (n, 1), and at levels (n, 1) in multiples of the largest."""
        table = self.factors + process_share.clamp(max=1.0)[..., None] * (self.most - self.factors)
        factor = between(age, self.ages, between(share, self.levels, table).log()[..., None]).exp()
        return factor * (self._unpacked(state).P * self.units).flatten(0, 1).T

    def states(self, s: Tensor) -> Tensor:
        """Scaled states (nx, n) in their units."""
        return s * self.x_scale + self.x_offset

    def advance(
        self, state: Tensor, y: Tensor, u: Tensor, begins: Tensor, measurement_noise: Tensor, process_noise: Tensor
    ) -> tuple[Tracked, Tensor]:
        """Predict, and correct by samples y (ny, n), of which NaN is missing; returns also predicted outputs.

        The state stays, and the NIS is infinite, where that leaves no estimate.
        """
        Q = self.eye * ((process_noise.clamp(min=self.least_process_noise) * self.process_noise) ** 2 + self.error**2)
        R = self.eye_y * torch.maximum(measurement_noise, self.least_measurement_noise) ** 2
        before, numbers = self._unpacked(state), self.numbers
        x0, P0 = torch.where(begins, self.start_mean, before.x), torch.where(begins, self.start_covariance, before.P)
        L, sound = eliminated(P0)
        mean, S, E = self._transformed(x0, L, self._moved, u)
        prediction = mean, S + Q, product(L, E), sound
        new = (before.seen < self.window) & ~begins
        for _ in range(numbers["relinearisations"]):
            prediction = _where(new, self._relinearised(x0, P0, prediction, y, u, Q, R), prediction)
        mean, P, _, sound = prediction
        V, white, expected, known = self._corrected(torch.where(begins, x0, mean), torch.where(begins, P0, P), y, R)
        x, P = torch.where(begins, x0, mean) + (V * white).sum(1), torch.where(begins, P0, P) - product(V, V)
        sound = sound & known & (x.sum(0) + P.sum((0, 1))).isfinite() & (eliminated(P)[1] | ~begins)
        there = (~y.isnan()).to(x.dtype)
        count = there.sum(0)
        trend = before.trend + numbers["trend_share"] * there * (white - before.trend)
        nis = before.nis + numbers["share"] / self.ny * ((white**2).sum(0) - count * before.nis)
        square = numbers["trend_gain"] * (there * trend**2).sum(0) - count * before.trend_square
        square = before.trend_square + numbers["trend_square_share"] / self.ny * square
        coloured, going = (square > numbers["trend_limit"]) & (count > 0) & ~begins, sound & ~begins
        square = torch.where(going, torch.where(coloured, 1.0, square), before.trend_square)
        tracked = Tracked(
            torch.where(sound, self._within(x), x0),
            torch.where(sound, torch.where(coloured, numbers["inflation"] * P, P), P0),
            torch.where(begins, 1.0, torch.where(sound, nis, math.inf)),
            torch.where(begins, 1.0, square),
            torch.where(going, before.seen + count.clamp(max=1.0), before.seen),
            torch.where(going, torch.where(coloured, 0.0, trend), before.trend),
        )
        return tracked, expected

    def supervise(self, tracked: Tracked, x: Tensor, P: Tensor) -> Tensor:
        """Take T_inv's estimates (nx, n) and covariances (nx^2, n) where these are surer, or the filter diverged.

        Returns the state (width, n).
        """
        lost, P = ~(tracked.nis <= self.numbers["limit"]), P.reshape(self.nx, self.nx, -1) / self.units
        taken = lost | ((tracked.seen < self.window) & (self._log_det(P) < self._log_det(tracked.P)))
        x = torch.where(taken, self._within((x - self.x_offset) / self.x_scale), tracked.x)
        P = torch.where(taken, P, tracked.P).flatten(0, 1)
        nis, trend_square = (torch.where(lost, 1.0, each) for each in (tracked.nis, tracked.trend_square))
        return torch.cat([x, P, torch.stack([nis, trend_square, tracked.seen]), torch.where(lost, 0.0, tracked.trend)])

    def _unpacked(self, state: Tensor) -> Tracked:
        x, P, watched, trend = torch.split(state, [self.nx, self.nx**2, 3, self.ny])
        return Tracked(x, P.reshape(self.nx, self.nx, -1), watched[0], watched[1], watched[2], trend)

    def _relinearised(
        self, x: Tensor, P: Tensor, prediction: Prediction, y: Tensor, u: Tensor, Q: Tensor, R: Tensor
    ) -> Prediction:
        """Predict again, with the motion linearised about where the step began as far as the sample tells."""
        nx, (mean, S, across, _) = self.nx, prediction
        V, white, _, known = self._corrected(mean, S, y, R)
        rows, sound = eliminated(S, across, V.transpose(0, 1))
        G = product(rows[nx : 2 * nx], rows[2 * nx :])
        rows, spread_sound = eliminated(P - product(G, G), G.transpose(0, 1))
        L, H = rows[:nx], rows[nx:]
        mean, S, E = self._transformed(x + (G * white).sum(1), L, self._moved, u)
        D = product(E, H)
        mean, S = mean - (D * white).sum(1), S + Q + product(D, D)
        sound = sound & spread_sound & known & (mean.sum(0) + S.sum((0, 1))).isfinite()
        return mean, S, product(L, E) + product(G, D), sound

    def _corrected(self, mean: Tensor, P: Tensor, y: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The update: V and white, for the mean + V white and P - V V^T; the expected outputs; soundness."""
        sound = torch.ones_like(mean[0], dtype=torch.bool)
        if self.h is None:
            V = product(P, self.C)
            expected, S = (self.C * mean).sum(1) + self.C_offset, product(self.C, V.transpose(0, 1))
        else:
            L, sound = eliminated(P)
            expected, S, E = self._transformed(mean, L, self._output, y[:0])
            V = product(L, E)
        missing = y.isnan()
        apart = torch.where(missing, 0.0, y - expected)
        rows, known = eliminated(S + R, V, apart[None], skipped=missing)
        return rows[self.ny : -1], rows[-1], expected, sound & known

    def _transformed(
        self, x: Tensor, L: Tensor, function: Callable[[Tensor, Tensor], Tensor], u: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What a function makes of Gaussians, by sigma points: means, covariances, and E, L E^T being that with x."""
        middle, far, count = x[:, None], self.far * L, 1 + 2 * self.nx
        points = torch.cat([middle, middle + far, middle - far], 1)
        to = function(points.flatten(1), u.repeat(1, count))
        to = to.reshape(len(to), count, -1)
        if function == self._output:  # where it is undefined, that of the mean
            to = torch.where(to.isfinite(), to, to[:, :1])
        mean = (to * self.weights).sum(1)
        off, (plus, minus) = to - mean[:, None], torch.split(to[:, 1:], self.nx, 1)
        return mean, product(off * self.square_weights, off), self.far * self.numbers["other"] * (plus - minus)

    def _moved(self, s: Tensor, u: Tensor) -> Tensor:
        """Scaled states (nx, n) a sample later."""
        s = self._within(s)
        if self.flow is not None:
            q = torch.cat([s, u / self.u_scale])
            return s + self.affine + self.linear @ q + self.gain * self.flow(q.T).T
        assert self.equations is not None
        field, substeps = self.equations.field, self.equations.substeps

        def f(x: Tensor) -> Tensor:
            return evaluated(field, x=x.unbind(), u=u.unbind())

        x = self.states(s) if substeps else f(self.states(s))
        for _ in range(substeps):
            h = self.dt / substeps
            k1 = f(x)
            k2 = f(x + h / 2 * k1)
            k3 = f(x + h / 2 * k2)
            k4 = f(x + h * k3)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return (x - self.x_offset) / self.x_scale

    def _output(self, s: Tensor, _: Tensor) -> Tensor:
        """Outputs of scaled states (nx, n); where they are undefined, those within the bounds."""
        assert self.h is not None
        y, near = (evaluated(self.h, x=self.states(each).unbind()) for each in (s, self._within(s)))
        return torch.where(y.isfinite(), y, near)

    def _within(self, s: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(s, self.low), self.high)

    def _log_det(self, P: Tensor) -> Tensor:
        """Half the logarithm of the determinants of covariances."""
        L, _ = eliminated(P)
        return torch.stack([L[i, i] for i in range(self.nx)]).log().sum(0)


def _where(chosen: Tensor, one: Prediction, other: Prediction) -> Prediction:
    """A prediction where it is chosen and sound, and another elsewhere."""
    chosen = chosen & one[3]
    mean, P, across = (torch.where(chosen, *each) for each in zip(one[:3], other[:3], strict=True))
    return mean, P, across, chosen | other[3]
