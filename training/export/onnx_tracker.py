"""A tracking observer's own part as nodes of an ONNX graph: :mod:`observers.tracker`.

A row of the tracker's state holds the estimate and its covariance, both of scaled states, the NIS, the mean square of
the innovations' running mean, the number of samples of which anything was there, that running mean, and the last
sample, in which what was missing is replaced by what was predicted. All are doubles.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from observers.artifact import Artifact
from training.export.exported import tracker_arrays, tracker_numbers
from training.export.onnx_map import Maps
from training.export.onnx_nodes import Graph

Prediction = tuple[str, str, str]
"""Estimate (n, k), covariance (n, k, k), and covariance with the states before, (n, nx, k)."""


def state_width(artifact: Artifact) -> int:
    """Numbers in a row of the state."""
    return artifact.nx + artifact.nx**2 + 3 + 2 * artifact.ny


class TrackerNodes:
    """The step of a tracker, in two parts: between them the filter takes in the sample."""

    def __init__(self, graph: Graph, artifact: Artifact, given: dict[str, str], begins: str, real: Any) -> None:
        self._graph, self._artifact, self._given, self._real = graph, artifact, given, real
        self._motion = motion = artifact.require_motion()
        self._begins, self._low_high = begins, motion.scaled_bounds
        self._numbers = tracker_numbers(motion, artifact.filter.dt)
        self._factors: dict[str, tuple[list[str], str, str]] = {}
        nx, ny = artifact.nx, artifact.ny
        ends = np.cumsum([0, nx, nx * nx, 1, 1, 1, ny, ny])
        *parts, self.y = (graph.part(given["tracker"], a, b) for a, b in itertools.pairwise(ends))
        start = tracker_arrays(motion)
        values = (start["mean"][None], start["covariance"].reshape(1, -1), 1.0, 1.0, 0.0, np.zeros((1, ny)))
        self._before = [graph("Where", begins, value, part) for value, part in zip(values, parts, strict=True)]
        self._x, self._P = self._before[0], self._matrix(self._before[1])
        self._Q, self._R = self._variances()

    def taken(self) -> tuple[list[str], str]:
        """Predict, and take in the new sample: the state after it, and that sample, in which nothing is missing."""
        graph, begins, y, seen = self._graph, self._begins, self._given["y_next"], self._before[4]
        prediction = self._predicted(self._x, self._P)
        new = graph("And", graph("Less", seen, float(self._numbers["window"])), graph("Not", begins))
        for _ in range(self._numbers["relinearisations"]):
            again = self._relinearised(prediction)
            numbers = graph("Add", graph.sum(again[0]), self._factored(again[1])[2])
            prediction = self._chosen(graph("And", new, graph.finite(numbers)), again, prediction)
        mean, P, _ = self._chosen(begins, (self._x, self._P, prediction[2]), prediction)
        V, white, expected = self._corrected(mean, P)
        mean, P = self._shifted(mean, V, white), graph("Sub", P, self._outer(V, V))
        stand_in = graph("Where", graph.finite(expected), expected, self.y)
        whole = graph("Where", graph("IsNaN", y), graph("Where", begins, y, stand_in), y)
        numbers = graph("Add", graph.sum(mean), graph.sum(self._flat(P)))
        start = graph("Where", begins, self._factored(P)[2], 0.0)  # a start needs a factor, too
        return self._watched(mean, P, white, graph.finite(graph("Add", numbers, start))), whole

    def supervised(self, tracked: list[str], maps: Maps) -> list[str]:
        """Take T_inv's estimate where it is surer, soon after a reset, or where the filter diverged."""
        graph, motion, window = self._graph, self._motion, float(self._numbers["window"])
        x, P, nis, trend_square, seen, trend = tracked
        lost = graph("Not", graph("LessOrEqual", nis, self._numbers["limit"]))
        age = graph("Mul", graph("Min", seen, window), self._artifact.filter.dt)
        theirs = maps.covariance(age, motion.x_scale)
        surer = graph("Less", *(self._factored(self._matrix(each))[2] for each in (theirs, P)))
        takes = graph("Or", lost, graph("And", graph("Less", seen, window), surer))
        inverted = graph("Div", graph("Sub", maps.estimate(), motion.x_offset), motion.x_scale)
        return [
            graph("Where", takes, graph.within(inverted, *self._low_high), x),
            graph("Where", takes, theirs, P),
            graph("Where", lost, 1.0, nis),
            graph("Where", lost, 1.0, trend_square),
            seen,
            graph("Where", lost, 0.0, trend),
        ]

    def estimate(self, x: str) -> str:
        """Scaled states in their units, (n, nx)."""
        return self._graph("Add", self._graph("Mul", x, self._motion.x_scale), self._motion.x_offset)

    def _variances(self) -> tuple[str, str]:
        """Q, (n, nx, nx), and R, (n, ny, ny)."""
        graph, motion, inverse = self._graph, self._motion, self._artifact.inverse
        level = graph("Max", self._given["process_noise"], motion.least_process_noise)
        added = graph("Mul", level, motion.process_noise)
        end = np.atleast_1d(inverse.measurement_noise_max).astype(float)
        noise = graph("Min", self._given["measurement_noise"], end)
        noise = graph("Max", noise, motion.least_measurement_noise)
        variances = graph("Add", graph("Mul", added, added), motion.error**2), graph("Mul", noise, noise)
        sizes = motion.nx, self._artifact.ny
        Q, R = (
            graph("Mul", graph("Unsqueeze", v, np.array([2])), np.eye(n)) for v, n in zip(variances, sizes, strict=True)
        )
        return Q, R

    def _predicted(self, x: str, P: str) -> Prediction:
        mean, S, across = self._transformed(x, P, self._moved, self._motion.nx)
        return mean, self._graph("Add", S, self._Q), across

    def _relinearised(self, prediction: Prediction) -> Prediction:
        """Predict again, with the motion linearised about where the step began as far as the sample tells."""
        graph, (mean, P, across) = self._graph, prediction
        V, white, _ = self._corrected(mean, P)
        G = graph("MatMul", across, graph("MatMul", self._factored(P)[1], V))
        start, spread = self._shifted(self._x, G, white), graph("Sub", self._P, self._outer(G, G))
        again, S, of_start = self._predicted(start, spread)
        D = graph("MatMul", self._transposed(of_start), graph("MatMul", self._factored(spread)[1], G))
        again = self._shifted(again, D, graph("Neg", white))
        return again, graph("Add", S, self._outer(D, D)), graph("Add", of_start, self._outer(G, D))

    def _corrected(self, mean: str, P: str) -> tuple[str, str, str]:
        """What a sample says: mean + V white and P - V V^T are what is known then; and what was expected."""
        graph, artifact, y, (ny, nx) = (
            self._graph,
            self._artifact,
            self._given["y_next"],
            (self._artifact.ny, self._artifact.nx),
        )
        if artifact.C is not None:
            C = artifact.C * self._motion.x_scale
            expected = graph("Add", graph("MatMul", mean, C.T), artifact.C @ self._motion.x_offset)
            V = graph("MatMul", P, C.T)
            S = graph("MatMul", C, V)
        else:
            expected, S, V = self._transformed(mean, P, self._output, ny)
        missing = graph("IsNaN", y)
        apart = graph("Unsqueeze", graph("Where", missing, 0.0, graph("Sub", y, expected)), np.array([1]))
        rows = graph.joined(graph("Add", S, self._R), V, apart)
        columns = self._eliminated(rows, ny, graph.columns(missing, ny))
        whole = graph.joined(*(graph("Unsqueeze", column, np.array([2])) for column in columns), axis=2)
        white = graph("Squeeze", graph.part(whole, ny + nx, ny + nx + 1), np.array([1]))
        return graph.part(whole, ny, ny + nx), white, expected

    def _eliminated(self, rows: str, count: int, skipped: list[str] | None = None) -> list[str]:
        """Columns (n, m) of [L, B L^-T] for rows [P, B], (n, m, count), of which P = L L^T comes first."""
        graph, columns = self._graph, []
        for j in range(count):
            column = graph("Gather", rows, np.array(j), axis=2)
            column = graph("Div", column, graph("Sqrt", graph.part(column, j, j + 1)))
            if skipped:
                column = graph("Where", skipped[j], 0.0, column)
            columns.append(column)
            upright, across = (
                graph("Unsqueeze", part, np.array([axis]))
                for part, axis in ((column, 2), (graph.part(column, 0, count), 1))
            )
            rows = graph("Sub", rows, graph("MatMul", upright, across))
        return columns

    def _factored(self, P: str) -> tuple[list[str], str, str]:
        """Columns (n, nx) of P's Cholesky factor, P's inverse, and half the logarithm of its determinant, (n, 1)."""
        if P not in self._factors:
            graph, nx = self._graph, self._motion.nx
            identity = graph("Add", graph("Mul", P, 0.0), np.eye(nx))
            columns = self._eliminated(graph.joined(P, identity), nx)
            whole = graph.joined(*(graph("Unsqueeze", column, np.array([2])) for column in columns), axis=2)
            root = graph.part(whole, nx, 2 * nx)
            logs = [graph("Log", graph.part(column, j, j + 1)) for j, column in enumerate(columns)]
            L = [
                graph("Mul", graph.part(column, 0, nx), (np.arange(nx) >= j) * 1.0) for j, column in enumerate(columns)
            ]
            self._factors[P] = L, self._outer(root, root), graph("Sum", *logs)
        return self._factors[P]

    def _transformed(self, x: str, P: str, function: Callable[[str, int], str], width: int) -> Prediction:
        """What a function makes of a Gaussian, by sigma points."""
        graph, nx = self._graph, self._motion.nx
        middle, squares, other = (self._numbers[name] for name in ("middle", "middle_squares", "other"))
        far = [graph("Mul", column, math.sqrt(0.5 / other)) for column in self._factored(P)[0]]
        points = [x, *(graph(sign, x, column) for column in far for sign in ("Add", "Sub"))]
        count, at = len(points), graph.joined(*points, axis=0)
        to = graph("Reshape", function(at, count), np.array([count, -1, width]))
        if function == self._output:  # where it is undefined, that of the mean
            to = graph("Where", graph.finite(to), to, graph.part(to, 0, 1, axis=0))
        weights = np.full((count, 1, 1), other)
        weights[0] = middle
        mean = graph.sum(graph("Mul", to, weights), axis=0, keepdims=0)
        weights[0] = squares
        off = graph("Sub", to, mean)
        weighed = graph("Transpose", graph("Mul", off, weights), perm=[1, 0, 2])
        at = graph("Sub", graph("Reshape", at, np.array([count, -1, nx])), x)
        S, across = (graph("MatMul", graph("Transpose", each, perm=[1, 2, 0]), weighed) for each in (off, at))
        return mean, S, across

    def _moved(self, points: str, count: int) -> str:
        """Scaled states (m, nx), ``count`` for each row, a sample later."""
        graph, motion, nu = self._graph, self._motion, self._artifact.nu
        s = graph.within(points, *self._low_high)
        u = graph.joined(*[self._given["u"]] * count, axis=0) if nu else ""
        if motion.flow is not None:
            q = graph.joined(s, graph("Div", u, motion.flow.u_scale)) if nu else s
            change = graph("Add", graph("MatMul", q, motion.flow.linear[:, 1:].T), motion.flow.linear[:, 0])
            h = graph("Mul", graph.network(motion.flow.mlp, q, self._real), motion.flow.gain)
            return graph("Add", s, graph("Add", change, h))
        assert motion.equations is not None
        inputs, field, n = graph.columns(u, nu) if nu else [], motion.equations.field, motion.equations.substeps

        def f(x: str, h: float = 0.0, k: str = "") -> str:
            x = graph("Add", x, graph("Mul", k, h)) if k else x
            return graph.expression(field, x=graph.columns(x, motion.nx), u=inputs)

        x = self.estimate(s)
        if not n:
            x = f(x)
        for h in [self._artifact.filter.dt / max(n, 1)] * n:
            k1 = f(x)
            k2 = f(x, h / 2, k1)
            k3 = f(x, h / 2, k2)
            k4 = f(x, h, k3)
            total = graph("Sum", k1, k2, k2, k3, k3, k4)
            x = graph("Add", x, graph("Mul", total, h / 6))
        return graph("Div", graph("Sub", x, motion.x_offset), motion.x_scale)

    def _output(self, points: str, count: int) -> str:
        """Outputs of scaled states (m, nx); where they are undefined, those within the bounds."""
        graph, h = self._graph, self._artifact.h
        assert h is not None
        given, near = (
            graph.expression(h, x=graph.columns(self.estimate(each), self._motion.nx))
            for each in (points, graph.within(points, *self._low_high))
        )
        return graph("Where", graph.finite(given), given, near)

    def _watched(self, x: str, P: str, white: str, sound: str) -> list[str]:
        """The state after a sample; it stays, and the estimate is lost, where that is not finite."""
        graph, numbers, ny, begins = self._graph, self._numbers, self._artifact.ny, self._begins
        x_before, P_before, nis, trend_square, seen, trend = self._before
        there = graph.cast(graph("Not", graph("IsNaN", self._given["y_next"])), np.float64)
        count = graph.sum(there)
        step = graph("Mul", there, graph("Sub", white, trend))
        trend = graph("Add", trend, graph("Mul", step, numbers["trend_share"]))

        def averaged(mean: str, values: str, share: float) -> str:
            step = graph("Sub", graph.sum(graph("Mul", values, there)), graph("Mul", count, mean))
            return graph("Add", mean, graph("Mul", step, share / ny))

        nis = averaged(nis, graph("Mul", white, white), numbers["share"])
        raised = graph("Mul", graph("Mul", trend, trend), numbers["trend_gain"])
        trend_square = averaged(trend_square, raised, numbers["trend_square_share"])
        coloured = graph("And", graph("Greater", trend_square, numbers["trend_limit"]), graph("Greater", count, 0.0))
        inflated = graph(
            "Mul",
            self._flat(P),
            graph("Where", graph("And", coloured, graph("Not", begins)), numbers["inflation"], 1.0),
        )
        goes_on = graph("And", sound, graph("Not", begins))
        return [
            graph("Where", sound, graph.within(x, *self._low_high), x_before),
            graph("Where", sound, inflated, P_before),
            graph("Where", begins, 1.0, graph("Where", sound, nis, np.inf)),
            graph("Where", goes_on, graph("Where", coloured, 1.0, trend_square), self._before[3]),
            graph("Where", goes_on, graph("Add", seen, graph("Min", count, 1.0)), seen),
            graph("Where", goes_on, graph("Where", coloured, 0.0, trend), self._before[5]),
        ]

    def _chosen(self, where: str, these: Prediction, those: Prediction) -> Prediction:
        graph = self._graph
        matrices = graph("Unsqueeze", where, np.array([2]))
        masks = (where, matrices, matrices)
        mean, P, across = (graph("Where", *each) for each in zip(masks, these, those, strict=True))
        return mean, P, across

    def _shifted(self, x: str, V: str, w: str) -> str:
        """Add V w to x, for w (n, ny)."""
        graph = self._graph
        return graph(
            "Add", x, graph("Squeeze", graph("MatMul", V, graph("Unsqueeze", w, np.array([2]))), np.array([2]))
        )

    def _outer(self, V: str, W: str) -> str:
        return self._graph("MatMul", V, self._transposed(W))

    def _transposed(self, value: str) -> str:
        return self._graph("Transpose", value, perm=[0, 2, 1])

    def _matrix(self, flat: str) -> str:
        return self._graph("Reshape", flat, np.array([-1, self._motion.nx, self._motion.nx]))

    def _flat(self, value: str) -> str:
        return self._graph("Reshape", value, np.array([-1, self._motion.nx**2]))
