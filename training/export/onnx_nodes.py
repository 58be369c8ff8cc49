"""A graph under construction, and what several parts of it are made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from observers.errors import ArtifactError
from observers.expression import Expression
from observers.network import MLP

_OPERATIONS = {name: name.capitalize() for name in ("sin", "cos", "exp", "log", "sqrt", "tanh", "abs", "sign", "floor")}
_OPERATIONS |= {"+": "Add", "*": "Mul", "**": "Pow", "minimum": "Min", "maximum": "Max", "where": "Where"}
_OPERATIONS |= {"<": "Less", "<=": "LessOrEqual", ">": "Greater", ">=": "GreaterOrEqual"}
_OPERATIONS |= {"and": "And", "or": "Or", "not": "Not"}


@dataclass(frozen=True)
class Value:
    """A value of a graph, with the operators of arrays."""

    graph: "Graph"
    name: str
    __array_ufunc__ = None  # so that NumPy's arrays leave operators to values

    def __add__(self, other: Any) -> "Value":
        return self.graph("Add", self, other)

    def __radd__(self, other: Any) -> "Value":
        return self.graph("Add", other, self)

    def __sub__(self, other: Any) -> "Value":
        return self.graph("Sub", self, other)

    def __mul__(self, other: Any) -> "Value":
        return self.graph("Mul", self, other)

    def __truediv__(self, other: Any) -> "Value":
        return self.graph("Div", self, other)

    def __matmul__(self, other: Any) -> "Value":
        return self.graph("MatMul", self, other)

    def __rmatmul__(self, other: Any) -> "Value":
        return self.graph("MatMul", other, self)

    def __lt__(self, other: Any) -> "Value":
        return self.graph("Less", self, other)

    def __gt__(self, other: Any) -> "Value":
        return self.graph("Greater", self, other)

    def __and__(self, other: Any) -> "Value":
        return self.graph("And", self, other)

    def __or__(self, other: Any) -> "Value":
        return self.graph("Or", self, other)

    def __invert__(self) -> "Value":
        return self.graph("Not", self)

    @property
    def mT(self) -> "Value":
        """Matrices (n, a, b) transposed."""
        return self.graph("Transpose", self, perm=[0, 2, 1])

    @property
    def finite(self) -> "Value":
        """Whether numbers are neither infinite nor NaN."""
        return self.graph("Abs", self) < np.inf

    def sum(self, axis: int = 1, keepdims: int = 1) -> "Value":
        """Sum along an axis."""
        return self.graph("ReduceSum", self, np.array([axis]), keepdims=keepdims)

    def part(self, first: int, end: int, axis: int = 1) -> "Value":
        """A range of rows or columns."""
        return self.graph("Gather", self, np.arange(first, end), axis=axis)

    def shaped(self, *shape: int) -> "Value":
        """The same numbers in another shape."""
        return self.graph("Reshape", self, np.array(shape))

    def raised(self, axis: int) -> "Value":
        """The same with another axis of length 1."""
        return self.graph("Unsqueeze", self, np.array([axis]))

    def cast(self, kind: Any) -> "Value":
        """The same as numbers of another type."""
        from onnx import helper

        return self.graph("Cast", self, to=helper.np_dtype_to_tensor_dtype(np.dtype(kind)))

    def columns(self, count: int) -> "list[Value]":
        """The columns of (n, count), each (n, 1)."""
        return [self] if count == 1 else self.graph.several("Split", count, self, axis=1)

    def within(self, low: Any, high: Any) -> "Value":
        """The same, cut at bounds."""
        return self.graph("Min", self.graph("Max", self, low), high)


class Graph:
    """Nodes and constants, each under a name of its own. Arrays of a step have a row for each observer."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, operation: str, *inputs: Any, **attributes: Any) -> Value:
        """Add a node of values and constants; returns its output."""
        return self.several(operation, 1, *inputs, **attributes)[0]

    def several(self, operation: str, outputs: int, *inputs: Any, **attributes: Any) -> list[Value]:
        """Add a node; returns its outputs."""
        from onnx import helper

        names = [each.name if isinstance(each, Value) else self._constant(each) for each in inputs]
        name = f"{operation}_{len(self.nodes)}"
        results = [name] if outputs == 1 else [f"{name}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(operation, names, results, name=name, **attributes))
        return [Value(self, each) for each in results]

    def _constant(self, values: Any) -> str:
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, order="C"), name))
        return name

    def named(self, name: str, value: Value) -> None:
        """Give a value the name of an output."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [value.name], [name], name=name))

    def where(self, condition: Any, value: Any, other: Any) -> Value:
        """One value where a condition holds, and another elsewhere."""
        return self("Where", condition, value, other)

    def joined(self, *columns: Value, axis: int = 1) -> Value:
        """Columns side by side."""
        return self("Concat", *columns, axis=axis)

    def log1p(self, value: Value, *, unit: Any, end: Any) -> Value:
        """log(1 + min(value, end) / unit)."""
        if np.isfinite(end).all():
            value = self("Min", value, np.atleast_1d(end).astype(float))
        return self("Log", value / np.atleast_1d(unit).astype(float) + 1.0)

    def between(self, at: Value, points: np.ndarray) -> Value:
        """Weights (n, k) of points that rise in an interpolation at values (n, 1): beyond the last it alone counts."""
        passed = ((at - points[:-1]) / np.diff(points)).within(0.0, 1.0)  # of each interval
        shape = (len(points) - 1, len(points))
        return passed @ (np.eye(*shape, 1) - np.eye(*shape)) + np.eye(1, len(points))  # from each to the next

    def network(self, mlp: MLP, h: Value, real: Any) -> Value:
        """What a network makes of its inputs (n, inputs), in doubles; it computes in numbers of type ``real``."""
        h = h.cast(real)
        for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
            if i and mlp.activation == "silu":
                half = h * np.full(1, 0.5, real)
                h = half + half * self("Tanh", half)  # as in observers.network: it cannot overflow
            elif i:
                h = self({"tanh": "Tanh", "relu": "Relu"}[mlp.activation], h)
            # The weights are floats in Python, too.
            h = self("Gemm", h, *(np.asarray(values, np.float32).astype(real) for values in (weight, bias)), transB=1)
        return h.cast(np.float64)

    def expression(self, expression: Expression, **columns: Sequence[Value]) -> Value:
        """The components, side by side, of columns "x" and "u"; what appears more than once is computed once."""
        values: dict[Any, Any] = {}

        def value(part: Any) -> Any:
            if not isinstance(part, tuple):
                return part
            if part not in values:
                name, *arguments = part
                own = columns[name][arguments[0]] if name in columns else self._operated(name, *map(value, arguments))
                values[part] = own
            return values[part]

        shape = self("Shape", columns["x"][0])
        return self.joined(*(self("Expand", value(part), shape) for part in expression.components))

    def _operated(self, name: str, *values: Any) -> Any:
        if name == "tan":
            return self("Sin", *values) / self("Cos", *values)
        if name == "%":
            rest = self("Mod", *values, fmod=1)
            return rest + self.where(rest * values[1] < 0.0, values[1], 0.0)  # of the sign that NumPy gives it
        if name not in _OPERATIONS:
            raise ArtifactError(f"ONNX has no {name}, which this observer's equations need: export C or JavaScript")
        first, *others = values
        if name == "where" or not others:
            return self(_OPERATIONS[name], *values)
        for other in others:
            first = self(_OPERATIONS[name], first, other)
        return first
