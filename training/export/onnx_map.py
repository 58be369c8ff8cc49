"""T_inv as nodes of an ONNX graph, and the covariance of its error."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from observers.inverse import InverseMap
from training.export.exported import Exported, table
from training.export.onnx_nodes import Graph


@dataclass(frozen=True)
class Read:
    """A map with its network's inputs beside the age."""

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
            self._maps.append(self._read(maps["free"], graph("MatMul", z, np.eye(linear.size)[:, :nz])))
            acted = graph("MatMul", graph("Abs", z), np.where(np.arange(linear.size)[:, None] >= nz, 1.0, 0.0))
            self._untouched = graph("Equal", acted, 0.0)

    def estimate(self) -> str:
        """The estimates (n, nx), in doubles."""
        return self._of_each([self._mean(read) for read in self._maps])

    def covariance(self, age: str, scale: np.ndarray) -> str:
        """The covariances (n, nx^2) in units of ``scale`` (nx,), at ages (n, 1) in seconds."""
        return self._of_each([self._covariance(read.inverse, age, scale) for read in self._maps])

    def _of_each(self, values: list[str]) -> str:
        """In each row the value of the map that it is for."""
        return values[0] if len(values) == 1 else self._graph("Where", self._untouched, values[1], values[0])

    def _read(self, inverse: InverseMap, z: str) -> Read:
        graph, conditions = self._graph, list[str]()
        modes = graph("MatMul", z, inverse.whiten.T)
        modes = graph("Sub", modes, inverse.z_offset @ inverse.whiten.T)
        noise = self._given.get("measurement_noise")
        if noise is not None:
            if "measurement_noise" in inverse.features:
                noise = graph("Min", noise, np.atleast_1d(inverse.measurement_noise_max).astype(float))
                conditions.append(graph.log1p(noise, unit=inverse.measurement_noise_unit, end=np.inf))
            squares = graph("MatMul", graph("Mul", noise, noise), np.atleast_2d(inverse.noise_gain) ** 2)
            modes = graph("Div", modes, graph("Add", squares, 1.0))
        if "process_noise" in inverse.features:
            level, end = self._given["process_noise"], inverse.process_noise_max
            conditions.append(graph.log1p(level, unit=inverse.process_noise_unit, end=end))
        return Read(inverse, [modes, *conditions])

    def _mean(self, read: Read) -> str:
        graph, inverse, signals = self._graph, read.inverse, read.signals
        if "age" in inverse.features:
            seconds = graph("Mul", self._given["age"], self._dt)
            signals = [*signals, graph.log1p(seconds, unit=inverse.age_unit, end=inverse.age_max)]
        h = graph.network(inverse.mlp, graph.joined(*signals), self._real)
        return graph("Add", graph("Mul", h, inverse.x_scale), inverse.x_offset)

    def _covariance(self, inverse: InverseMap, age: str, scale: np.ndarray) -> str:
        graph, (levels, ages, covariance) = self._graph, table(inverse, scale)
        share = graph(
            "Div", self._given["measurement_noise"], np.atleast_1d(inverse.measurement_noise_max).astype(float)
        )
        share = graph("Min", graph("ReduceMax", share, axes=[1], keepdims=1), 1.0)
        of_level = graph("MatMul", graph.between(share, levels), covariance.reshape(len(levels), -1))
        by_age = graph("Reshape", of_level, np.array([-1, len(ages), len(scale) ** 2]))
        weights = graph("Unsqueeze", graph.between(age, ages), np.array([2]))
        return graph.sum(graph("Mul", weights, by_age), keepdims=0)
