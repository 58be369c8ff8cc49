"""T_inv as nodes of an ONNX graph, and how far it is off."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from observers.inverse import InverseMap
from observers.spread import LARGEST_LOG
from training.export.exported import Exported
from training.export.onnx_nodes import Graph


@dataclass(frozen=True)
class Read:
    """What the networks of a map are given."""

    inverse: InverseMap
    signals: list[str]


class Maps:
    """The maps of an observer at a step: that of driven motion, and where there is one that of free motion."""

    def __init__(self, graph: Graph, exported: Exported, z: str, given: dict[str, str], real: Any) -> None:
        self._graph, self._given, self._real, self._dt = graph, given, real, exported.artifact.filter.dt
        linear, maps = exported.artifact.filter, exported.maps
        self._maps, self._untouched = [self._read(maps["driven"], z)], ""
        if "free" in maps:
            nz = len(linear.A)
            columns = graph.constant(np.eye(linear.size)[:, :nz])
            self._maps.append(self._read(maps["free"], graph("MatMul", z, columns)))
            acted = graph.constant(np.arange(linear.size)[:, None] >= nz)
            self._untouched = graph("Equal", graph("MatMul", graph("Abs", z), acted), graph.constant([0.0]))

    def estimate(self, age: str) -> str:
        """The estimates (n, nx), in doubles, at ages (n, 1) in samples."""
        return self._of_each([self._mean(read, age) for read in self._maps])

    def covariance(self, age: str, scale: np.ndarray) -> list[str]:
        """What covariances hold, row by row, (n, 1) each, in multiples of ``scale`` (nx,)."""
        found = zip(*(self._covariance(read, age, scale) for read in self._maps), strict=True)
        return [self._of_each(list(entries)) for entries in found]

    def _of_each(self, found: list[str]) -> str:
        """What the map that each row is for says."""
        return found[0] if len(found) == 1 else self._graph("Where", self._untouched, found[1], found[0])

    def _read(self, inverse: InverseMap, z: str) -> Read:
        graph, told = self._graph, list[str]()
        modes = graph("MatMul", z, graph.constant(inverse.whiten.T))
        modes = graph("Sub", modes, graph.constant(inverse.z_offset @ inverse.whiten.T))
        noise = self._given.get("measurement_noise")
        if noise is not None:
            if "measurement_noise" in inverse.features:
                noise = graph("Min", noise, graph.constant(np.atleast_1d(inverse.measurement_noise_max)))
                told.append(graph.log1p(noise, unit=inverse.measurement_noise_unit, end=np.inf))
            square, gains = graph("Mul", noise, noise), graph.constant(np.atleast_2d(inverse.noise_gain) ** 2)
            modes = graph("Div", modes, graph("Add", graph("MatMul", square, gains), graph.constant([1.0])))
        if "process_noise" in inverse.features:
            level, end = self._given["process_noise"], inverse.process_noise_max
            told.append(graph.log1p(level, unit=inverse.process_noise_unit, end=end))
        return Read(inverse, [modes, *told])

    def _inputs(self, read: Read, age: str) -> str:
        """What the networks are given, (n, inputs)."""
        graph, inverse, signals = self._graph, read.inverse, read.signals
        if "age" in inverse.features:
            seconds = graph("Mul", age, graph.constant([self._dt]))
            signals = [*signals, graph.log1p(seconds, unit=inverse.age_unit, end=inverse.age_max)]
        return graph.cast(graph.joined(*signals), self._real)

    def _mean(self, read: Read, age: str) -> str:
        graph, inverse = self._graph, read.inverse
        h = graph.cast(graph.network(inverse.mlp, self._inputs(read, age), self._real), np.float64)
        return graph("Add", graph("Mul", h, graph.constant(inverse.x_scale)), graph.constant(inverse.x_offset))

    def _covariance(self, read: Read, age: str, scale: np.ndarray) -> list[str]:
        """D L L^T D, as :class:`observers.spread.Spread` says."""
        graph, inverse = self._graph, read.inverse
        assert inverse.spread is not None  # or the artifact could not have a flow
        bars, nx = inverse.spread.in_units(inverse.x_scale), inverse.spread.nx
        out = graph.cast(graph.network(bars, self._inputs(read, age), self._real), np.float64)
        values = graph.columns(out, bars.outputs)
        rise, below = self._rise(inverse, age), iter(values[nx:])
        rows: list[list[str]] = []
        largest = inverse.spread.largest_variances(inverse.x_scale) / scale**2
        for value, unit, end in zip(values, scale.tolist(), largest.tolist(), strict=False):
            log = graph("Add", graph("Min", value, graph.constant([LARGEST_LOG])), rise)
            D = graph("Div", graph("Exp", log), graph.constant([unit]))
            row = [*(graph("Mul", D, next(below)) for _ in rows), D]
            squares = [graph("Mul", each, each) for each in row]
            variance = squares[0] if len(squares) == 1 else graph("Sum", *squares)
            most = graph.constant([end])
            share = graph("Sqrt", graph("Div", most, graph("Max", variance, most)))
            rows.append([graph("Mul", each, share) for each in row])
        entries = [[""] * nx for _ in range(nx)]
        for i, row in enumerate(rows):
            for j, other in enumerate(rows[: i + 1]):
                products = [graph("Mul", a, b) for a, b in zip(row, other, strict=False)]
                entries[i][j] = entries[j][i] = products[0] if len(products) == 1 else graph("Sum", *products)
        return [entry for row in entries for entry in row]

    def _rise(self, inverse: InverseMap, age: str) -> str:
        """By what logarithms of standard deviations rise, (n, 1): between levels of noise and ages."""
        graph, spread = self._graph, inverse.spread
        assert spread is not None
        tables = np.log(spread.factors.reshape(-1, len(spread.levels), len(spread.ages))) / 2
        of_age = self._shares(graph("Mul", age, graph.constant([self._dt])), spread.ages)
        noise, end = self._given["measurement_noise"], np.atleast_1d(inverse.measurement_noise_max)
        level = graph("Div", graph("Min", noise, graph.constant(end)), graph.constant(end))
        of_level = self._shares(graph("ReduceMax", level, axes=[1], keepdims=1), spread.levels)
        rises = [self._weighed(graph("MatMul", of_level, graph.constant(table)), of_age) for table in tables]
        if len(rises) == 1:
            return rises[0]
        end = np.atleast_1d(inverse.process_noise_max)
        share = graph("Div", graph("Min", self._given["process_noise"], graph.constant(end)), graph.constant(end))
        return graph("Add", rises[0], graph("Mul", share, graph("Sub", rises[1], rises[0])))

    def _weighed(self, values: str, weights: str) -> str:
        products = self._graph("Mul", values, weights)
        return self._graph("ReduceSum", products, self._graph.constant([1], np.int64), keepdims=1)

    def _shares(self, at: str, points: np.ndarray) -> str:
        """Weights (n, k) of points in an interpolation at values (n, 1): beyond an end it alone counts."""
        graph = self._graph
        if len(points) == 1:
            return graph.constant([[1.0]])
        passed = graph("Div", graph("Sub", at, graph.constant(points[:-1])), graph.constant(np.diff(points)))
        passed = graph.within(passed, 0.0, 1.0)  # of each interval
        shape = (len(points) - 1, len(points))
        shifted = graph("MatMul", passed, graph.constant(np.eye(*shape, 1) - np.eye(*shape)))  # from each to the next
        return graph("Add", shifted, graph.constant(np.eye(1, len(points))))
