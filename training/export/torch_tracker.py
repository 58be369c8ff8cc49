"""The tracker's recursion (:mod:`observers.tracker`) in Torch; the rows of a batch are the last axis here.

Every row takes the same way through it, and torch.where decides what counts.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from observers.artifact import Artifact
from training.export.exported import output_expression, tracker_arrays, tracker_numbers
from training.export.torch_parts import Network, between, eliminated, evaluated, product, put


class Gaussian(NamedTuple):
    """A prediction: mean (nx, n), covariance (nx, nx, n), that with the states before (nx, nx, n), soundness (n,)."""

    mean: Tensor
    P: Tensor
    across: Tensor
    sound: Tensor

    def where(self, chosen: Tensor, other: "Gaussian") -> "Gaussian":
        """This one in some rows, and another elsewhere."""
        parts = (torch.where(chosen, *each) for each in zip(self[:3], other[:3], strict=True))
        return Gaussian(*parts, (chosen & self.sound) | (~chosen & other.sound))


class Tracked(NamedTuple):
    """The tracker's state: scaled states, covariance, NIS, mean square of the trend, samples seen, trend (ny, n).

    After a sample half the logarithm of the covariance's determinant belongs to it.
    """

    x: Tensor
    P: Tensor
    nis: Tensor
    trend_square: Tensor
    seen: Tensor
    trend: Tensor
    log_det: Tensor | None = None


class TorchTracker(nn.Module):
    """The tracker of an artifact: between :meth:`advance` and :meth:`supervise` the filter takes in the sample."""

    def __init__(self, artifact: Artifact, dtype: torch.dtype) -> None:
        super().__init__()
        motion = artifact.require_motion()
        self.nx, self.ny, self.dt = artifact.nx, artifact.ny, artifact.filter.dt
        self.numbers = tracker_numbers(motion, self.dt)
        self.window, self.far = float(self.numbers["window"]), math.sqrt(0.5 / self.numbers["other"])
        self.least_process_noise = motion.least_process_noise
        self.equations, self.h = motion.equations, None if artifact.C is not None else output_expression(artifact)
        self.flow = None if motion.flow is None else Network(motion.flow.mlp, dtype)
        others = [self.numbers["other"]] * (2 * self.nx)
        arrays = tracker_arrays(motion) | {
            "error": motion.error,
            "process_noise": motion.process_noise,
            "least_measurement_noise": motion.least_measurement_noise,
            "weights": np.array([self.numbers["middle"], *others]),
            "square_weights": np.array([self.numbers["middle_squares"], *others]),
            "eye": np.eye(self.nx),
            "eye_y": np.eye(self.ny),
        }
        if motion.flow is not None:
            arrays |= {"flow_gain": motion.flow.gain, "flow_linear": motion.flow.linear, "u_scale": motion.flow.u_scale}
        if artifact.C is not None:
            arrays |= {"C": artifact.C * motion.x_scale, "C_offset": artifact.C @ motion.x_offset}
        factors = motion.factors
        put(self, {name: values[..., None] for name, values in arrays.items()})
        put(self, {"levels": factors.levels, "ages": factors.ages})
        put(self, {"factors": factors.factors[0], "most_factors": factors.factors[-1]})

    @property
    def width(self) -> int:
        """Numbers in a row of the state."""
        return self.nx + self.nx**2 + 3 + self.ny

    def covariance(self, state: Tensor, age: Tensor, share: Tensor, process_share: Tensor) -> Tensor:
        """Calibrated covariances (n, nx^2) at ages (n, 1), and at levels (n, 1) in multiples of the largest."""
        table = self.factors + process_share.clamp(max=1.0)[..., None] * (self.most_factors - self.factors)
        factor = between(age, self.ages, between(share, self.levels, table).log()[..., None]).exp()
        return factor * self._units(self._unpacked(state).P, torch.mul).flatten(0, 1).T

    def learned(self, tracked: Tracked) -> Tensor:
        """Ages (n, 1) in seconds for T_inv's covariance: what misled the filter may have misled z as well."""
        return tracked.seen.clamp(max=self.window)[:, None] * self.dt

    def advance(
        self, state: Tensor, y: Tensor, u: Tensor, begins: Tensor, measurement_noise: Tensor, process_noise: Tensor
    ) -> tuple[Tracked, Tensor]:
        """Predict, and correct by samples y (ny, n), of which NaN is missing; returns also predicted outputs."""
        before = self._unpacked(state)
        Q = self.eye * ((process_noise.clamp(min=self.least_process_noise) * self.process_noise) ** 2 + self.error**2)
        R = self.eye_y * torch.maximum(measurement_noise, self.least_measurement_noise) ** 2
        started = before._replace(
            x=torch.where(begins, self.start_mean, before.x), P=torch.where(begins, self.start_covariance, before.P)
        )
        x, P = started.x, started.P
        L, sound = eliminated(P)
        mean, S, E = self._transformed(x, L, self._moved, u)
        prediction = Gaussian(mean, S + Q, product(L, E), sound)
        new = (before.seen < self.window) & ~begins
        for _ in range(self.numbers["relinearisations"]):
            again = self._relinearised(x, P, prediction, y, u, Q, R)
            prediction = again.where(new & again.sound, prediction)
        mean, P, _, sound = Gaussian(x, P, prediction.across, sound).where(begins, prediction)
        V, white, expected, known = self._corrected(mean, P, y, R)
        mean, P = mean + (V * white).sum(1), P - product(V, V)
        L, positive = eliminated(P)
        sound = sound & known & (mean.sum(0) + P.sum((0, 1))).isfinite() & (positive | ~begins)
        return self._watched(started, mean, P, self._log_det(L), white, ~y.isnan(), sound, begins), expected

    def supervise(self, tracked: Tracked, x: Tensor, P: Tensor) -> Tensor:
        """Take T_inv's estimates (nx, n) and covariances (nx^2, n) where these are surer, or the filter diverged.

        Returns the state (width, n).
        """
        lost = ~(tracked.nis <= self.numbers["limit"])
        P = self._units(P.reshape(self.nx, self.nx, -1), torch.div)
        taken = lost | ((tracked.seen < self.window) & (self._log_det(eliminated(P)[0]) < tracked.log_det))
        x = torch.where(taken, self._within((x - self.x_offset) / self.x_scale), tracked.x)
        P = torch.where(taken, P, tracked.P).flatten(0, 1)
        nis, trend_square = (torch.where(lost, 1.0, each) for each in (tracked.nis, tracked.trend_square))
        return torch.cat([x, P, torch.stack([nis, trend_square, tracked.seen]), torch.where(lost, 0.0, tracked.trend)])

    def _unpacked(self, state: Tensor) -> Tracked:
        x, P, watched, trend = state.split([self.nx, self.nx**2, 3, self.ny])
        return Tracked(x, P.reshape(self.nx, self.nx, -1), *watched.unbind(), trend)

    def _units(self, P: Tensor, operation: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        return operation(P, self.x_scale * self.x_scale[:, None])

    def _relinearised(
        self, x: Tensor, P: Tensor, prediction: Gaussian, y: Tensor, u: Tensor, Q: Tensor, R: Tensor
    ) -> Gaussian:
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
        return Gaussian(mean, S, product(L, E) + product(G, D), sound)

    def _corrected(self, mean: Tensor, P: Tensor, y: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What samples say: mean + V white and P - V V^T are what is known then; what was expected; soundness."""
        nx, ny, sound = self.nx, self.ny, torch.ones_like(mean[0], dtype=torch.bool)
        if self.h is None:
            V = product(P, self.C)
            expected, S = (self.C * mean).sum(1) + self.C_offset, product(self.C, V.transpose(0, 1))
        else:
            L, sound = eliminated(P)
            expected, S, E = self._transformed(mean, L, self._output, None)
            V = product(L, E)
        missing = y.isnan()
        apart = torch.where(missing, 0.0, y - expected)
        rows, known = eliminated(S + R, V, apart[None], skipped=missing)
        return rows[ny : ny + nx], rows[-1], expected, sound & known

    def _transformed(self, x: Tensor, L: Tensor, function: Callable[..., Tensor], u: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """What a function makes of Gaussians, by sigma points: means, covariances, and E, L E^T being that with x."""
        middle, far = x[:, None], self.far * L
        to = function(torch.cat([middle, middle + far, middle - far], 1), u)
        mean = (to * self.weights).sum(1)
        off = to - mean[:, None]
        ends = to[:, 1:].unflatten(1, (2, self.nx))
        weight = self.far * self.numbers["other"]
        return mean, product(off * self.square_weights, off), weight * (ends[:, 0] - ends[:, 1])

    def _moved(self, s: Tensor, u: Tensor) -> Tensor:
        """Scaled states (nx, points, n) a sample later."""
        s, dt = self._within(s), self.dt
        if self.flow is not None:
            v = (u / self.u_scale)[:, None].expand(-1, s.shape[1], -1)
            q = torch.cat([s, v]).flatten(1)
            moved = self.flow_linear[:, :1, 0] + self.flow_linear[:, 1:, 0] @ q + self.flow_gain * self.flow(q.T).T
            return s + moved.reshape(s.shape)
        assert self.equations is not None
        field, substeps = self.equations.field, self.equations.substeps

        def f(x: Tensor) -> Tensor:
            return evaluated(field, x=x.unbind(), u=u.unbind())

        x = self.states(s)
        if not substeps:
            x = f(x)
        for _ in range(substeps):
            h = dt / substeps
            k1 = f(x)
            k2 = f(x + h / 2 * k1)
            k3 = f(x + h / 2 * k2)
            k4 = f(x + h * k3)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return (x - self.x_offset[..., None]) / self.x_scale[..., None]

    def _output(self, s: Tensor, _: None) -> Tensor:
        """Outputs of scaled states (nx, points, n); where they are undefined, those within the bounds, or the mean's."""
        assert self.h is not None
        y, near = (evaluated(self.h, x=self.states(each).unbind()) for each in (s, self._within(s)))
        y = torch.where(y.isfinite(), y, near)
        return torch.where(y.isfinite(), y, y[:, :1])

    def _watched(
        self,
        before: Tracked,
        x: Tensor,
        P: Tensor,
        log_det: Tensor,
        white: Tensor,
        there: Tensor,
        sound: Tensor,
        begins: Tensor,
    ) -> Tracked:
        """The state after samples; it stays, and the estimate is lost, where they left no estimate."""
        numbers, ny = self.numbers, self.ny
        seen, count = there.to(x.dtype), there.sum(0).to(x.dtype)
        trend = before.trend + numbers["trend_share"] * seen * (white - before.trend)
        nis = before.nis + numbers["share"] / ny * ((white**2).sum(0) - count * before.nis)
        squares = numbers["trend_gain"] * (seen * trend**2).sum(0) - count * before.trend_square
        trend_square = before.trend_square + numbers["trend_square_share"] / ny * squares
        coloured = (trend_square > numbers["trend_limit"]) & (count > 0) & ~begins
        going = sound & ~begins
        return Tracked(
            torch.where(sound, self._within(x), before.x),
            torch.where(sound, torch.where(coloured, numbers["inflation"] * P, P), before.P),
            torch.where(begins, 1.0, torch.where(sound, nis, math.inf)),
            torch.where(begins | (sound & coloured), 1.0, torch.where(sound, trend_square, before.trend_square)),
            torch.where(going, before.seen + count.clamp(max=1.0), before.seen),
            torch.where(going, torch.where(coloured, 0.0, trend), before.trend),
            log_det + coloured * (0.5 * self.nx * math.log(numbers["inflation"])),
        )

    def states(self, s: Tensor) -> Tensor:
        """Scaled states (nx, ..., n) in their units."""
        shape = (-1, *[1] * (s.ndim - 1))
        return s * self.x_scale.reshape(shape) + self.x_offset.reshape(shape)

    def _within(self, s: Tensor) -> Tensor:
        shape = (-1, *[1] * (s.ndim - 1))
        return torch.minimum(torch.maximum(s, self.low.reshape(shape)), self.high.reshape(shape))

    def _log_det(self, L: Tensor) -> Tensor:
        """Half the logarithm of the determinant of L L^T."""
        return torch.stack([L[i, i] for i in range(self.nx)]).log().sum(0)
