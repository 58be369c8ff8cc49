"""A tracking observer's own part as nodes of an ONNX graph: :mod:`observers.tracker`.

A row of the tracker's state holds the estimate and its covariance, both of scaled states, the NIS, the mean square of
the innovations' running mean, the number of samples of which anything was there, that running mean, and the last
sample, in which what was missing is replaced by what was predicted. All are doubles.
"""

import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from observers.artifact import Artifact
from training.export.exported import tracker_arrays, tracker_numbers
from training.export.onnx_map import Maps
from training.export.onnx_nodes import Graph, Value

Prediction = tuple[Value, Value, Value]
"""Estimate (n, k), covariance (n, k, k), and covariance with the states before, (n, nx, k)."""


def state_width(artifact: Artifact) -> int:
    """Numbers in a row of the state."""
    return artifact.nx + artifact.nx**2 + 3 + 2 * artifact.ny


class TrackerNodes:
    """The step of a tracker, in two parts: between them the filter takes in the sample."""

    def __init__(self, graph: Graph, artifact: Artifact, given: dict[str, Value], begins: Value, real: Any) -> None:
        self._graph, self._artifact, self._given, self._real = graph, artifact, given, real
        self._motion = motion = artifact.require_motion()
        self._begins, self._low_high = begins, motion.scaled_bounds
        self._numbers = tracker_numbers(motion, artifact.filter.dt)
        self._factors: dict[Value, tuple[list[Value], Value, Value]] = {}
        nx, ny = artifact.nx, artifact.ny
        ends = np.cumsum([0, nx, nx * nx, 1, 1, 1, ny, ny])
        *parts, self.y = (given["tracker"].part(a, b) for a, b in itertools.pairwise(ends))
        start = tracker_arrays(motion)
        values = (start["start_mean"][None], start["start_covariance"].reshape(1, -1), 1.0, 1.0, 0.0, np.zeros((1, ny)))
        self._before = [graph.where(begins, value, part) for value, part in zip(values, parts, strict=True)]
        self._x, self._P = self._before[0], self._before[1].shaped(-1, nx, nx)
        level = graph("Max", given["process_noise"], motion.least_process_noise) * motion.process_noise
        noise = graph("Min", given["measurement_noise"], np.array(artifact.inverse.measurement_noise_max, float))
        noise = graph("Max", noise, motion.least_measurement_noise)
        self._Q = (level * level + motion.error**2).raised(2) * np.eye(nx)
        self._R = (noise * noise).raised(2) * np.eye(ny)

    def taken(self) -> tuple[list[Value], Value]:
        """Predict, and take in the new sample: the state after it, and that sample, in which nothing is missing."""
        graph, begins, y, nx = self._graph, self._begins, self._given["y_next"], self._motion.nx
        prediction = self._predicted(self._x, self._P)
        new = (self._before[4] < float(self._numbers["window"])) & ~begins
        for _ in range(self._numbers["relinearisations"]):
            again = self._relinearised(prediction)
            sound = (again[0].sum() + self._factored(again[1])[2]).finite
            prediction = self._chosen(new & sound, again, prediction)
        mean, P, _ = self._chosen(begins, (self._x, self._P, prediction[2]), prediction)
        V, white, expected = self._corrected(mean, P)
        mean, P = mean + self._times(V, white), P - V @ V.mT
        whole = graph.where(graph("IsNaN", y), graph.where(expected.finite, expected, self.y), y)
        start = graph.where(begins, self._factored(P)[2], 0.0)  # a start needs a factor, too
        P = P.shaped(-1, nx**2)
        sound = (mean.sum() + P.sum() + start).finite
        return self._watched(mean, P, white, sound), graph.where(begins, y, whole)

    def supervised(self, tracked: list[Value], maps: Maps) -> list[Value]:
        """Take T_inv's estimate where it is surer, soon after a reset, or where the filter diverged."""
        graph, motion, window = self._graph, self._motion, float(self._numbers["window"])
        x, P, nis, trend_square, seen, trend = tracked
        lost = ~graph("LessOrEqual", nis, self._numbers["limit"])
        theirs = maps.covariance(graph("Min", seen, window) * self._artifact.filter.dt, motion.x_scale)
        sizes = (self._factored(each.shaped(-1, motion.nx, motion.nx))[2] for each in (theirs, P))
        takes = lost | ((seen < window) & operator.lt(*sizes))
        inverted = (maps.estimate() - motion.x_offset) / motion.x_scale
        return [
            graph.where(takes, inverted.within(*self._low_high), x),
            graph.where(takes, theirs, P),
            graph.where(lost, 1.0, nis),
            graph.where(lost, 1.0, trend_square),
            seen,
            graph.where(lost, 0.0, trend),
        ]

    def estimate(self, s: Value) -> Value:
        """Scaled states in their units, (n, nx)."""
        return s * self._motion.x_scale + self._motion.x_offset

    def _predicted(self, x: Value, P: Value) -> Prediction:
        mean, S, across = self._transformed(x, P, self._moved, self._motion.nx)
        return mean, S + self._Q, across

    def _relinearised(self, prediction: Prediction) -> Prediction:
        """Predict again, with the motion linearised about where the step began as far as the sample tells."""
        mean, P, across = prediction
        V, white, _ = self._corrected(mean, P)
        G = across @ (self._factored(P)[1] @ V)
        start, spread = self._x + self._times(G, white), self._P - G @ G.mT
        again, S, of_start = self._predicted(start, spread)
        D = of_start.mT @ (self._factored(spread)[1] @ G)
        return again - self._times(D, white), S + D @ D.mT, of_start + G @ D.mT

    def _corrected(self, mean: Value, P: Value) -> tuple[Value, Value, Value]:
        """What a sample says: mean + V white and P - V V^T are what is known then; and what was expected."""
        graph, artifact, y = self._graph, self._artifact, self._given["y_next"]
        nx, ny = artifact.nx, artifact.ny
        if artifact.C is not None:
            C = artifact.C * self._motion.x_scale
            expected, V = mean @ C.T + artifact.C @ self._motion.x_offset, P @ C.T
            S = C @ V
        else:
            expected, S, V = self._transformed(mean, P, self._output, ny)
        missing = graph("IsNaN", y)
        apart = graph.where(missing, 0.0, y - expected).raised(1)
        whole = self._beside(self._eliminated(graph.joined(S + self._R, V, apart), ny, missing.columns(ny)))
        return whole.part(ny, ny + nx), whole.part(ny + nx, ny + nx + 1).shaped(-1, ny), expected

    def _eliminated(self, rows: Value, count: int, skipped: list[Value] | None = None) -> list[Value]:
        """Columns (n, m) of [L, B L^-T] for rows [P, B], (n, m, count), of which P = L L^T comes first."""
        graph, columns = self._graph, []
        for j in range(count):
            column = graph("Gather", rows, np.array(j), axis=2)
            column = column / graph("Sqrt", column.part(j, j + 1))
            if skipped:
                column = graph.where(skipped[j], 0.0, column)
            columns.append(column)
            rows = rows - column.raised(2) @ column.part(0, count).raised(1)
        return columns

    def _factored(self, P: Value) -> tuple[list[Value], Value, Value]:
        """Columns (n, nx) of P's Cholesky factor, P's inverse, and half the logarithm of its determinant, (n, 1)."""
        if P not in self._factors:
            graph, nx = self._graph, self._motion.nx
            columns = self._eliminated(graph.joined(P, P * 0.0 + np.eye(nx)), nx)
            root = self._beside(columns).part(nx, 2 * nx)
            logs = (graph("Log", column.part(j, j + 1)) for j, column in enumerate(columns))
            L = [column.part(0, nx) * np.where(np.arange(nx) < j, 0.0, 1.0) for j, column in enumerate(columns)]
            self._factors[P] = L, root @ root.mT, graph("Sum", *logs)
        return self._factors[P]

    def _transformed(self, x: Value, P: Value, function: Callable[[Value, int], Value], width: int) -> Prediction:
        """What a function makes of a Gaussian, by sigma points."""
        graph, nx = self._graph, self._motion.nx
        middle, squares, other = (self._numbers[name] for name in ("middle", "middle_squares", "other"))
        far = [column * math.sqrt(0.5 / other) for column in self._factored(P)[0]]
        points = graph.joined(x, *(each for column in far for each in (x + column, x - column)), axis=0)
        count = 1 + 2 * nx
        to = function(points, count).shaped(count, -1, width)
        if function == self._output:  # where it is undefined, that of the mean
            to = graph.where(to.finite, to, to.part(0, 1, axis=0))
        means, products = (np.array([first, *[other] * (2 * nx)])[:, None, None] for first in (middle, squares))
        mean = (to * means).sum(axis=0, keepdims=0)
        to, at = to - mean, points.shaped(count, -1, nx) - x
        weighed = graph("Transpose", to * products, perm=[1, 0, 2])
        S, across = (graph("Transpose", each, perm=[1, 2, 0]) @ weighed for each in (to, at))
        return mean, S, across

    def _moved(self, points: Value, count: int) -> Value:
        """Scaled states (m, nx), ``count`` for each row, a sample later."""
        graph, motion = self._graph, self._motion
        s = points.within(*self._low_high)
        u = [graph.joined(*[self._given["u"]] * count, axis=0)] if self._artifact.nu else []
        if motion.flow is not None:
            q = graph.joined(s, *(each / motion.flow.u_scale for each in u))
            change = graph.network(motion.flow.mlp, q, self._real) * motion.flow.gain
            return s + q @ motion.flow.linear[:, 1:].T + motion.flow.linear[:, 0] + change
        assert motion.equations is not None
        field, substeps = motion.equations.field, motion.equations.substeps
        inputs = u[0].columns(self._artifact.nu) if u else []

        def f(x: Value) -> Value:
            return graph.expression(field, x=x.columns(motion.nx), u=inputs)

        x = self.estimate(s)
        if not substeps:
            x = f(x)
        for _ in range(substeps):
            h = self._artifact.filter.dt / substeps
            k1 = f(x)
            k2 = f(x + k1 * (h / 2))
            k3 = f(x + k2 * (h / 2))
            k4 = f(x + k3 * h)
            x = x + (k1 + (k2 + k3) * 2.0 + k4) * (h / 6)
        return (x - motion.x_offset) / motion.x_scale

    def _output(self, points: Value, count: int) -> Value:
        """Outputs of scaled states (m, nx); where they are undefined, those within the bounds."""
        graph, h = self._graph, self._artifact.h
        assert h is not None
        given, near = (
            graph.expression(h, x=self.estimate(each).columns(self._motion.nx))
            for each in (points, points.within(*self._low_high))
        )
        return graph.where(given.finite, given, near)

    def _watched(self, x: Value, P: Value, white: Value, sound: Value) -> list[Value]:
        """The state after a sample; it stays, and the estimate is lost, where that is not finite."""
        graph, numbers, ny, begins = self._graph, self._numbers, self._artifact.ny, self._begins
        x_before, P_before, nis, trend_square, seen, trend = self._before
        there = (~graph("IsNaN", self._given["y_next"])).cast(np.float64)
        count = there.sum()
        trend = trend + there * (white - trend) * numbers["trend_share"]
        squares = (white * white).sum() - count * nis
        nis = nis + squares * (numbers["share"] / ny)
        squares = (trend * trend * there).sum() * numbers["trend_gain"] - count * trend_square
        trend_square = trend_square + squares * (numbers["trend_square_share"] / ny)
        coloured = (trend_square > numbers["trend_limit"]) & (count > 0.0) & ~begins
        goes_on = sound & ~begins
        return [
            graph.where(sound, x.within(*self._low_high), x_before),
            graph.where(sound, P * graph.where(coloured, numbers["inflation"], 1.0), P_before),
            graph.where(begins, 1.0, graph.where(sound, nis, np.inf)),
            graph.where(goes_on, graph.where(coloured, 1.0, trend_square), self._before[3]),
            graph.where(goes_on, seen + graph("Min", count, 1.0), seen),
            graph.where(goes_on, graph.where(coloured, 0.0, trend), self._before[5]),
        ]

    def _chosen(self, where: Value, these: Prediction, those: Prediction) -> Prediction:
        masks = (where, where.raised(2), where.raised(2))
        mean, P, across = (self._graph.where(*each) for each in zip(masks, these, those, strict=True))
        return mean, P, across

    def _times(self, V: Value, w: Value) -> Value:
        """V w, (n, nx), for w (n, ny)."""
        return (V @ w.raised(2)).shaped(-1, self._motion.nx)

    def _beside(self, columns: list[Value]) -> Value:
        return self._graph.joined(*(column.raised(2) for column in columns), axis=2)
