"""A graph under construction, and what several parts of it are made of."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from observers.errors import ArtifactError
from observers.expression import Expression
from observers.network import MLP

_OPERATIONS = {name: name.capitalize() for name in ("sin", "cos", "exp", "log", "sqrt", "tanh", "abs", "sign", "floor")}
_OPERATIONS |= {"+": "Add", "*": "Mul", "**": "Pow", "minimum": "Min", "maximum": "Max", "where": "Where"}
_OPERATIONS |= {"<": "Less", "<=": "LessOrEqual", ">": "Greater", ">=": "GreaterOrEqual"}
_OPERATIONS |= {"and": "And", "or": "Or", "not": "Not"}


class Graph:
    """Nodes and constants, each under a name of its own. Arrays of a step have a row for each observer."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, operation: str, *inputs: Any, **attributes: Any) -> str:
        """Add a node of values and constants; returns the name of its output."""
        return self.several(operation, 1, *inputs, **attributes)[0]

    def several(self, operation: str, outputs: int, *inputs: Any, **attributes: Any) -> list[str]:
        """Add a node; returns the names of its outputs."""
        from onnx import helper

        names = [each if isinstance(each, str) else self._constant(each) for each in inputs]
        name = f"{operation}_{len(self.nodes)}"
        results = [name] if outputs == 1 else [f"{name}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(operation, names, results, name=name, **attributes))
        return results

    def _constant(self, values: Any) -> str:
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, order="C"), name))
        return name

    def cast(self, value: str, kind: Any) -> str:
        """The same as numbers of another type."""
        from onnx import helper

        return self("Cast", value, to=helper.np_dtype_to_tensor_dtype(np.dtype(kind)))

    def named(self, name: str, value: str) -> None:
        """Give a value the name of an output."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [value], [name], name=name))

    def log1p(self, value: str, *, unit: Any, end: Any) -> str:
        """log(1 + min(value, end) / unit)."""
        if np.isfinite(end).all():
            value = self("Min", value, np.atleast_1d(end).astype(float))
        return self("Log", self("Add", self("Div", value, np.atleast_1d(unit).astype(float)), 1.0))

    def columns(self, value: str, count: int) -> list[str]:
        """The columns of (n, count), each (n, 1)."""
        return [value] if count == 1 else self.several("Split", count, value, axis=1)

    def joined(self, *columns: str, axis: int = 1) -> str:
        """Columns side by side."""
        return self("Concat", *columns, axis=axis)

    def part(self, value: str, first: int, end: int, axis: int = 1) -> str:
        """A range of rows or columns."""
        return self("Gather", value, np.arange(first, end), axis=axis)

    def within(self, value: str, low: Any, high: Any) -> str:
        """The same, cut at bounds."""
        return self("Min", self("Max", value, low), high)

    def finite(self, value: str) -> str:
        """Whether values are neither infinite nor NaN."""
        return self("Less", self("Abs", value), np.inf)

    def sum(self, value: str, axis: int = 1, keepdims: int = 1) -> str:
        """Sum along an axis."""
        return self("ReduceSum", value, np.array([axis]), keepdims=keepdims)

    def between(self, at: str, points: np.ndarray) -> str:
        """Weights (n, k) of points that rise in an interpolation at values (n, 1): beyond the last it alone counts."""
        passed = self.within(self("Div", self("Sub", at, points[:-1]), np.diff(points)), 0.0, 1.0)  # of each interval
        shape = (len(points) - 1, len(points))
        shifted = self("MatMul", passed, np.eye(*shape, 1) - np.eye(*shape))  # from each to the next
        return self("Add", shifted, np.eye(1, len(points)))

    def network(self, mlp: MLP, h: str, real: Any) -> str:
        """What a network makes of its inputs (n, inputs), in doubles; it computes in numbers of type ``real``."""
        h = self.cast(h, real)
        for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
            if i:
                h = self._activated(mlp.activation, h, real)
            # The weights are floats in Python, too.
            h = self("Gemm", h, *(np.asarray(values, np.float32).astype(real) for values in (weight, bias)), transB=1)
        return self.cast(h, np.float64)

    def _activated(self, activation: str, h: str, real: Any) -> str:
        if activation != "silu":
            return self({"tanh": "Tanh", "relu": "Relu"}[activation], h)
        half = self("Mul", h, np.full(1, 0.5, real))
        return self("Add", half, self("Mul", half, self("Tanh", half)))  # as in observers.network: it cannot overflow

    def expression(self, expression: Expression, **columns: Sequence[str]) -> str:
        """The components, side by side, of columns "x" and "u"; what appears more than once is computed once."""
        values: dict[Any, Any] = {}

        def value(part: Any) -> Any:
            if not isinstance(part, tuple):
                return part
            if part not in values:
                name, *arguments = part
                values[part] = (
                    columns[name][arguments[0]] if name in columns else self._operated(name, *map(value, arguments))
                )
            return values[part]

        shape = self("Shape", columns["x"][0])
        return self.joined(*(self("Expand", value(part), shape) for part in expression.components))

    def _operated(self, name: str, *values: Any) -> Any:
        if name == "tan":
            return self("Div", self("Sin", *values), self("Cos", *values))
        if name == "%":
            rest = self("Mod", *values, fmod=1)
            other = self("Less", self("Mul", rest, values[1]), 0.0)  # of another sign than NumPy's
            return self("Add", rest, self("Where", other, values[1], 0.0))
        if name not in _OPERATIONS:
            raise ArtifactError(f"ONNX has no {name}, which this observer's equations need: export C or JavaScript")
        first, *others = values
        if name == "where" or not others:
            return self(_OPERATIONS[name], *values)
        for other in others:
            first = self(_OPERATIONS[name], first, other)
        return first
