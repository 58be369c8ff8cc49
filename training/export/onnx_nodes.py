"""A graph under construction, and what several parts of it are made of."""

from typing import Any

import numpy as np

from observers.network import MLP


class Graph:
    """Nodes and constants, each under a name of its own. Arrays of a step have a row for each observer."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, operation: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; returns the name of its output."""
        return self.several(operation, 1, *inputs, **attributes)[0]

    def several(self, operation: str, outputs: int, *inputs: str, **attributes: Any) -> list[str]:
        """Add a node; returns the names of its outputs."""
        from onnx import helper

        name = f"{operation}_{len(self.nodes)}"
        names = [name] if outputs == 1 else [f"{name}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(operation, inputs, names, name=name, **attributes))
        return names

    def constant(self, values: Any, kind: Any = np.float64) -> str:
        """Add a constant; returns its name."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=kind, order="C"), name))
        return name

    def cast(self, name: str, kind: Any) -> str:
        """The same as numbers of another type."""
        from onnx import helper

        return self("Cast", name, to=helper.np_dtype_to_tensor_dtype(np.dtype(kind)))

    def named(self, name: str, value: str) -> None:
        """Give a value the name of an output."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [value], [name], name=name))

    def log1p(self, value: str, *, unit: Any, end: Any) -> str:
        """log(1 + min(value, end) / unit)."""
        if np.isfinite(end).all():
            value = self("Min", value, self.constant(np.atleast_1d(end)))
        return self("Log", self("Add", self("Div", value, self.constant(np.atleast_1d(unit))), self.constant([1.0])))

    def columns(self, value: str, count: int) -> list[str]:
        """The columns of (n, count), each (n, 1)."""
        return [value] if count == 1 else self.several("Split", count, value, axis=1)

    def joined(self, *columns: str) -> str:
        """Columns side by side."""
        return self("Concat", *columns, axis=1)

    def within(self, value: str, low: Any, high: Any) -> str:
        """The same, cut at bounds."""
        return self("Min", self("Max", value, self.constant(low)), self.constant(high))

    def network(self, mlp: MLP, h: str, real: Any) -> str:
        """What a network makes of its inputs (n, inputs), both of type ``real``."""
        for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
            if i:
                h = self._activated(mlp.activation, h, real)
            # The weights are floats in Python, too.
            names = [self.constant(np.asarray(values, np.float32), real) for values in (weight, bias)]
            h = self("Gemm", h, *names, transB=1)
        return h

    def _activated(self, activation: str, h: str, real: Any) -> str:
        if activation != "silu":
            return self({"tanh": "Tanh", "relu": "Relu"}[activation], h)
        half = self("Mul", h, self.constant([0.5], real))
        return self("Add", half, self("Mul", half, self("Tanh", half)))  # as in observers.network: it cannot overflow
