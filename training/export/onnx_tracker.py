"""A tracking observer's own part as nodes of an ONNX graph: :mod:`observers.tracker` for outputs C x.

A row of the tracker's state holds the estimate and its covariance, both of scaled states, the mean squares of the
innovations and of their trend, the number of samples of which anything was there, that trend, and the last sample, in
which what was missing is replaced by what was predicted. All are doubles.
"""

import itertools
import math
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.polynomial import count, table
from observers.supervision import INFLATION, Supervision
from training.export.onnx_map import Maps
from training.export.onnx_nodes import Graph

# Estimate, covariance (n, nx, nx), mean squares (n, 1), number of samples (n, 1), and trend (n, ny).
Parts = tuple[str, str, str, str, str, str]


def state_width(artifact: Artifact) -> int:
    """Numbers in a row of the state."""
    return artifact.nx + artifact.nx**2 + 3 + 2 * artifact.ny


class TrackerNodes:
    """The step of a tracker, in two parts: between them the filter takes in the sample."""

    def __init__(self, graph: Graph, artifact: Artifact, given: dict[str, str], real: Any) -> None:
        assert artifact.C is not None
        self._graph, self._artifact, self._given, self._real = graph, artifact, given, real
        self._flow, self._C = artifact.require_flow(), artifact.C
        flow = self._flow
        self._low, self._high = flow.scaled_bounds
        self._watch = Supervision.of(flow, artifact.filter.dt)
        nx, ny = artifact.nx, artifact.ny
        ends = np.cumsum([0, nx, nx * nx, 1, 1, 1, ny, ny])
        x, P, mean_square, trend_square, count, trend, y = (
            graph("Gather", given["tracker"], graph.constant(np.arange(a, b), np.int64), axis=1)
            for a, b in itertools.pairwise(ends)
        )
        self._before: Parts = (x, self._matrix(P), mean_square, trend_square, count, trend)
        self.y = y  # the last sample, (n, ny)

    def taken(self) -> tuple[Parts, str]:
        """Predict, and take in the new sample: what follows, and that sample (n, ny), in which nothing is missing."""
        graph, ny = self._graph, self._artifact.ny
        x, P, root = self._predicted()
        y, before = graph.columns(self._given["y_next"], ny), graph.columns(self.y, ny)
        means = self._C @ self._flow.x_offset
        C = self._C * self._flow.x_scale
        whole, missing = [], [graph("IsNaN", each) for each in y]
        for k in range(ny):
            expected = graph("Add", graph("MatMul", x, graph.constant(C[k][:, None])), graph.constant([means[k]]))
            stand_in = graph("Where", self._finite(expected), expected, before[k])
            whole.append(graph("Where", missing[k], stand_in, y[k]))
        zero, white, seen = graph.constant([0.0]), [], []
        for k, variance in enumerate(self._measurement_variances()):
            row = graph.constant(C[k][:, None])
            across = graph("MatMul", P, row)  # (n, nx, 1)
            pivot = graph("Add", graph("MatMul", self._flat(across, C.shape[1]), row), variance)  # (n, 1)
            apart = graph("Sub", graph("Sub", y[k], graph.constant([means[k]])), graph("MatMul", x, row))
            apart = graph("Where", missing[k], zero, apart)
            of_sample = graph("Where", missing[k], zero, graph("Div", graph.constant([1.0]), pivot))
            gain = graph("Mul", self._flat(across, C.shape[1]), of_sample)
            x = graph("Add", x, graph("Mul", gain, apart))
            less = graph("MatMul", across, graph("Unsqueeze", gain, graph.constant([1], np.int64)))
            P = graph("Sub", P, less)
            white.append(graph("Mul", apart, graph("Sqrt", of_sample)))
            seen.append(graph.cast(graph("Not", missing[k]), np.float64))
        return self._sound(x, P, root, graph.joined(*white), graph.joined(*seen)), graph.joined(*whole)

    def supervised(self, tracked: Parts, maps: Maps, begins: str) -> Parts:
        """Let T_inv say where to begin, soon after a reset where it is surer, and where the estimate is lost."""
        graph, flow, age = self._graph, self._flow, self._given["age"]
        x, P, mean_square, trend_square, count, trend = tracked
        mean_square = graph("Where", begins, graph.constant([math.inf]), mean_square)
        count = graph("Where", begins, graph.constant([0.0]), count)
        lost = graph("Not", graph("LessOrEqual", mean_square, graph.constant([self._watch.limit])))
        window = graph.constant([float(self._watch.window)])
        theirs = graph.joined(*maps.covariance(graph("Min", count, window), flow.x_scale))
        ours, nx = self._flat(P, flow.nx**2), flow.nx
        diagonal = graph.constant(np.eye(nx).reshape(-1, 1))
        surer = graph("Less", graph("MatMul", theirs, diagonal), graph("MatMul", ours, diagonal))
        told = graph("Less", self._before[4], count)  # by this sample
        soon = graph("And", graph("Less", count, window), told)
        takes = graph("Or", lost, graph("And", soon, surer))
        said = graph("Sub", maps.estimate(age), graph.constant(flow.x_offset))
        said = graph.within(graph("Div", said, graph.constant(flow.x_scale)), self._low, self._high)
        return (
            graph("Where", takes, said, x),
            self._matrix(graph("Where", takes, theirs, ours)),
            graph("Where", lost, graph.constant([1.0]), mean_square),
            graph("Where", lost, graph.constant([1.0]), trend_square),
            count,
            graph("Where", lost, graph.constant([0.0]), trend),
        )

    def packed(self, tracked: Parts, y: str) -> str:
        """The state as the graph gives it back."""
        x, P, *watched = tracked
        return self._graph.joined(x, self._flat(P, self._flow.nx**2), *watched, y)

    def estimate(self, tracked: Parts) -> str:
        """The estimate in units of the states, (n, nx)."""
        graph, flow = self._graph, self._flow
        return graph("Add", graph("Mul", tracked[0], graph.constant(flow.x_scale)), graph.constant(flow.x_offset))

    def _predicted(self) -> tuple[str, str, list[str]]:
        """Estimate and covariance a sample later, and the entries of the factor of what it was."""
        graph, flow, nx = self._graph, self._flow, self._flow.nx
        x, P = self._before[:2]
        entries, states = graph.columns(self._flat(P, nx * nx), nx * nx), graph.columns(x, nx)
        L: list[list[str]] = []
        for i in range(nx):
            L.append([])
            for j in range(i + 1):
                entry = entries[nx * i + j]
                for k in range(j):
                    entry = graph("Sub", entry, graph("Mul", L[i][k], L[j][k]))
                if i > j:
                    L[i].append(graph("Div", entry, L[j][j]))
                else:
                    positive = graph("Greater", entry, graph.constant([0.0]))
                    L[i].append(graph("Where", positive, graph("Sqrt", entry), graph.constant([math.nan])))
        scaled = [graph("Div", self._given["u"], graph.constant(flow.u_scale))] if flow.nu else []
        points = []
        for j in range(nx):
            for far in (math.sqrt(nx), -math.sqrt(nx)):
                shifts = [graph("Mul", L[i][j], graph.constant([far])) for i in range(j, nx)]
                point = [*states[:j], *(graph("Add", *pair) for pair in zip(states[j:], shifts, strict=True))]
                points.append(graph.joined(graph.within(graph.joined(*point), self._low, self._high), *scaled))
        moved = graph("Reshape", self._moved(graph("Concat", *points, axis=0)), self._shape(len(points), -1, nx))
        mean = graph("ReduceMean", moved, axes=[0], keepdims=0)
        off = graph("Sub", moved, mean)
        P = graph("MatMul", graph("Transpose", off, perm=[1, 2, 0]), graph("Transpose", off, perm=[1, 0, 2]))
        P = graph("Mul", P, graph.constant([1.0 / len(points)]))
        return mean, graph("Add", P, self._process_covariance(mean)), [entry for row in L for entry in row]

    def _moved(self, points: str) -> str:
        """Where scaled states, behind which lie scaled inputs, are a sample later: (m, nx)."""
        graph, flow = self._graph, self._flow
        variables = flow.nx + flow.nu
        earlier, by = table(variables, flow.degree)
        powers = [points]
        for degree in range(2, flow.degree + 1):
            first, own = count(variables, degree - 2), slice(count(variables, degree - 1), count(variables, degree))
            lower = graph("Gather", powers[-1], graph.constant(earlier[own] - first, np.int64), axis=1)
            powers.append(graph("Mul", lower, graph("Gather", points, graph.constant(by[own], np.int64), axis=1)))
        change = graph("MatMul", graph.joined(*powers), graph.constant(flow.polynomial[:, 1:].T))
        change = graph("Add", change, graph.constant(flow.polynomial[:, 0]))
        said = graph.cast(graph.network(flow.mlp, graph.cast(points, self._real), self._real), np.float64)
        change = graph("Add", change, graph("Mul", said, graph.constant(flow.gain)))
        return graph("Add", graph("Gather", points, graph.constant(np.arange(flow.nx), np.int64), axis=1), change)

    def _process_covariance(self, mean: str) -> str:
        """Of what is added to scaled states on the way to their mean (n, nx) a sample later, (n, nx, nx)."""
        graph, flow = self._graph, self._flow
        level = graph("Max", self._given["process_noise"], graph.constant([flow.least_process_noise]))
        added = graph("Mul", level, graph.constant(flow.process_noise))
        Q = graph("Add", graph("Mul", added, added), graph.constant(flow.error**2))
        if flow.bend is not None:
            step = graph("Sub", mean, self._before[0])
            moved = graph("MatMul", graph("Mul", step, step), graph.constant(np.ones((flow.nx, 1))))
            bent = graph("Mul", moved, graph.constant(flow.bend))
            Q = graph("Add", Q, graph("Mul", bent, bent))
        return graph("Mul", graph("Unsqueeze", Q, graph.constant([2], np.int64)), graph.constant(np.eye(flow.nx)))

    def _measurement_variances(self) -> list[str]:
        """Of the noise on each output, (n, 1)."""
        graph, ny = self._graph, self._artifact.ny
        inverse, noise = self._artifact.inverse, self._given["measurement_noise"]
        if "measurement_noise" in inverse.features:
            noise = graph("Min", noise, graph.constant(np.atleast_1d(inverse.measurement_noise_max)))
        least = graph("Max", noise, graph.constant(self._flow.least_measurement_noise))  # (n, ny), whatever it was
        return graph.columns(graph("Mul", least, least), ny)

    def _sound(self, x: str, P: str, root: list[str], white: str, seen: str) -> Parts:
        """What follows, unless it is not finite: the estimate then stays, and is lost.

        Innovations (n, ny) are in units of their standard deviations, 0 where samples are missing; where they are seen
        is 1. They are watched as :mod:`observers.supervision` has it.
        """
        graph, nx, watch, one = self._graph, self._flow.nx, self._watch, self._graph.constant([1.0])
        x_before, P_before, mean_square, trend_square, count, trend = self._before
        numbers = graph.joined(x, self._flat(P, nx * nx), *root)
        total = graph("ReduceSum", numbers, graph.constant([1], np.int64), keepdims=1)
        sound = self._finite(total)
        step = graph("Mul", seen, graph("Sub", white, trend))
        trend_next = graph("Add", trend, graph("Mul", step, graph.constant([watch.trend_share])))
        raised = graph(
            "Mul", graph("Mul", graph("Mul", trend_next, trend_next), seen), graph.constant([watch.trend_gain])
        )
        mean_square = self._averaged(mean_square, graph("Mul", white, white), seen, watch.share)
        trend_square_next = self._averaged(trend_square, raised, seen, watch.trend_square_share)
        beyond = graph("Greater", trend_square_next, graph.constant([watch.trend_limit]))
        any_seen = graph("Greater", graph("ReduceMax", seen, axes=[1], keepdims=1), graph.constant([0.0]))
        agree = graph("And", beyond, any_seen)
        inflated = graph("Mul", self._flat(P, nx * nx), graph("Where", agree, graph.constant([INFLATION]), one))
        return (
            graph("Where", sound, graph.within(x, self._low, self._high), x_before),
            self._matrix(graph("Where", sound, inflated, self._flat(P_before, nx * nx))),
            graph("Where", sound, mean_square, graph.constant([math.inf])),
            graph("Where", sound, graph("Where", agree, one, trend_square_next), trend_square),
            graph("Where", sound, graph("Add", count, graph.cast(any_seen, np.float64)), count),
            graph("Where", sound, graph("Where", agree, graph.constant([0.0]), trend_next), trend),
        )

    def _averaged(self, mean: str, values: str, seen: str, share: float) -> str:
        """A running mean (n, 1) of values (n, ny) after those of a sample that are seen; the others are 0."""
        graph = self._graph
        ones = graph.constant(np.ones((self._artifact.ny, 1)))
        total, count = (graph("MatMul", each, ones) for each in (values, seen))
        step = graph("Sub", total, graph("Mul", count, mean))
        return graph("Add", mean, graph("Mul", step, graph.constant([share / self._artifact.ny])))

    def _finite(self, value: str) -> str:
        return self._graph("Less", self._graph("Abs", value), self._graph.constant([math.inf]))

    def _matrix(self, flat: str) -> str:
        return self._graph("Reshape", flat, self._shape(-1, self._flow.nx, self._flow.nx))

    def _flat(self, value: str, width: int) -> str:
        return self._graph("Reshape", value, self._shape(-1, width))

    def _shape(self, *lengths: int) -> str:
        return self._graph.constant(lengths, np.int64)
