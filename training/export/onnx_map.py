"""T_inv as nodes of an ONNX graph, and the covariance of its error."""

from typing import Any

import numpy as np

from observers.inverse import InverseMap
from training.export.exported import Exported, table
from training.export.onnx_nodes import Graph, Value


class Maps:
    """The maps of an observer at a step: that of driven motion, and where there is one that of free motion."""

    def __init__(self, graph: Graph, exported: Exported, z: Value, given: dict[str, Value], real: Any) -> None:
        self._graph, self._given, self._real, self._dt = graph, given, real, exported.artifact.filter.dt
        self._maps, size, nz = exported.maps, exported.artifact.filter.size, len(exported.artifact.filter.A)
        self._z = {"driven": z, "free": z.part(0, nz)}
        self._untouched = graph("Equal", graph("Abs", z) @ ((np.arange(size)[:, None] >= nz) * 1.0), 0.0)

    def estimate(self) -> Value:
        """The estimates (n, nx), in doubles."""
        return self._of_each({label: self._mean(inverse, self._z[label]) for label, inverse in self._maps.items()})

    def covariance(self, age: Value, scale: np.ndarray) -> Value:
        """The covariances (n, nx^2) in units of ``scale`` (nx,), at ages (n, 1) in seconds."""
        return self._of_each({label: self._covariance(each, age, scale) for label, each in self._maps.items()})

    def _of_each(self, values: dict[str, Value]) -> Value:
        """In each row the value of the map that it is for."""
        if "free" not in values:
            return values["driven"]
        return self._graph.where(self._untouched, values["free"], values["driven"])

    def _mean(self, inverse: InverseMap, z: Value) -> Value:
        graph, given = self._graph, self._given
        modes, conditions = z @ inverse.whiten.T - inverse.z_offset @ inverse.whiten.T, list[Value]()
        if "measurement_noise" in given:
            noise, end = given["measurement_noise"], inverse.measurement_noise_max
            if "measurement_noise" in inverse.features:
                noise = graph("Min", noise, np.atleast_1d(end).astype(float))
                conditions.append(graph.log1p(noise, unit=inverse.measurement_noise_unit, end=np.inf))
            modes = modes / ((noise * noise) @ np.atleast_2d(inverse.noise_gain) ** 2 + 1.0)
        if "process_noise" in inverse.features:
            level, end = given["process_noise"], inverse.process_noise_max
            conditions.append(graph.log1p(level, unit=inverse.process_noise_unit, end=end))
        if "age" in inverse.features:
            conditions.append(graph.log1p(given["age"] * self._dt, unit=inverse.age_unit, end=inverse.age_max))
        h = graph.network(inverse.mlp, graph.joined(modes, *conditions), self._real)
        return h * inverse.x_scale + inverse.x_offset

    def _covariance(self, inverse: InverseMap, age: Value, scale: np.ndarray) -> Value:
        graph, (levels, ages, covariance) = self._graph, table(inverse, scale)
        shares = self._given["measurement_noise"] / np.atleast_1d(inverse.measurement_noise_max).astype(float)
        share = graph("Min", graph("ReduceMax", shares, axes=[1], keepdims=1), 1.0)
        by_age = graph.between(share, levels) @ covariance.reshape(len(levels), -1)
        by_age = by_age.shaped(-1, len(ages), len(scale) ** 2)
        return (graph.between(age, ages).raised(2) * by_age).sum(keepdims=0)
