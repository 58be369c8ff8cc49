"""The step as an ONNX graph: a function of the filter's state, two samples and the input between them."""

import json
from typing import Any

import numpy as np

import kkl_gym
from observers.inverse import InverseMap
from training.export.exported import Exported

OPSET, IR = 13, 7  # of 2020 and 2021; what reads ONNX reads these
_TYPES = {"float": np.float32, "double": np.float64}


def onnx_model(exported: Exported) -> Any:
    """Build the graph, see that ONNX takes it for one, and describe it in its metadata.

    The inputs have a row for each observer of a batch: ``z`` (size), ``y`` (ny), ``u`` (nu), ``y_next`` (ny), ``age``
    (1), the samples since the observer was switched on, and as far as the map is told of them ``measurement_noise``
    and ``process_noise``. The outputs are ``z_next`` (size) and ``x_hat`` (nx, and estimated parameters). A row of age
    0 begins: its z, y and u count for nothing. docs/guides/export.md says more.

    Parameters
    ----------
    exported : Exported
        The observer. Its levels of noise are named in the metadata alone.

    Returns
    -------
    onnx.ModelProto
        The model.

    Raises
    ------
    ArtifactError
        If it tracks.
    ModuleNotFoundError
        Without the extra ``onnx``.
    """
    exported.refuse_flow()
    from onnx import checker, helper

    artifact, linear = exported.artifact, exported.artifact.filter
    real, levels = _TYPES[exported.precision], len(exported.levels)
    widths = {
        "z": linear.size,
        "y": artifact.ny,
        "u": artifact.nu,
        "y_next": artifact.ny,
        "age": 1,
        "measurement_noise": levels,
        "process_noise": int(exported.told_process_noise),
    }
    graph = _Graph()
    given = {name: name if name == "z" else graph.cast(name, np.float64) for name, width in widths.items() if width}
    signals = [given[name] for name in ("z", "y", "u", "y_next") if name in given]
    update = np.vstack([linear.transition.T, linear.early_y.T, linear.held_u.T, linear.late_y.T])
    advanced = graph("MatMul", graph("Concat", *signals, axis=1), graph.constant(update))
    start = graph("MatMul", given["y_next"], graph.constant(linear.equilibrium.T))
    begins = graph("Equal", given["age"], graph.constant([0.0]))
    z = graph("Where", begins, start, advanced)

    x_hat = _estimate(graph, artifact.inverse, z, given, dt=linear.dt, real=real)
    if artifact.free_inverse is not None:
        columns = graph.constant(np.eye(linear.size)[:, : len(linear.A)])
        free = _estimate(graph, artifact.free_inverse, graph("MatMul", z, columns), given, dt=linear.dt, real=real)
        acted = graph.constant(np.arange(linear.size)[:, None] >= len(linear.A))
        untouched = graph("Equal", graph("MatMul", graph("Abs", z), acted), graph.constant([0.0]))
        x_hat = graph("Where", untouched, free, x_hat)
    graph.named("z_next", z)
    graph.named("x_hat", graph.cast(x_hat, real))

    def value(name: str, width: int) -> Any:
        kind = np.float64 if name.startswith("z") else real
        return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(kind)), ["batch", width])

    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            exported.name,
            [value(name, width) for name, width in widths.items() if width],
            [value("z_next", linear.size), value("x_hat", len(exported.estimates))],
            graph.constants,
            doc_string=f"One step of the KKL observer {exported.source}; a row of age 0 begins anew.",
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR,
        producer_name="kkl-gym",
        producer_version=kkl_gym.__version__,
    )
    texts = {key: told if isinstance(told, str) else json.dumps(told) for key, told in exported.described.items()}
    helper.set_model_props(model, texts)
    checker.check_model(model, full_check=True)
    return model


class _Graph:
    """Nodes and constants, each under a name of its own."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def __call__(self, operation: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; returns the name of its output."""
        from onnx import helper

        name = f"{operation}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, inputs, [name], name=name, **attributes))
        return name

    def constant(self, values: Any, kind: Any = np.float64) -> str:
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=kind, order="C"), name))
        return name

    def cast(self, name: str, kind: Any) -> str:
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


def _estimate(graph: _Graph, inverse: InverseMap, z: str, given: dict[str, str], *, dt: float, real: Any) -> str:
    """T_inv(z), in doubles; the network itself is of type ``real``."""
    modes = graph("MatMul", z, graph.constant(inverse.whiten.T))
    modes = graph("Sub", modes, graph.constant(inverse.z_offset @ inverse.whiten.T))
    told, noise = [], given.get("measurement_noise")
    if noise is not None:
        if "measurement_noise" in inverse.features:
            unit, end = inverse.measurement_noise_unit, inverse.measurement_noise_max
            noise = graph("Min", noise, graph.constant(np.atleast_1d(end)))
            told.append(graph.log1p(noise, unit=unit, end=np.inf))
        variance = graph("MatMul", graph("Mul", noise, noise), graph.constant(np.atleast_2d(inverse.noise_gain) ** 2))
        modes = graph("Div", modes, graph("Add", variance, graph.constant([1.0])))
    if "process_noise" in inverse.features:
        level, end = given["process_noise"], inverse.process_noise_max
        told.append(graph.log1p(level, unit=inverse.process_noise_unit, end=end))
    if "age" in inverse.features:
        age = graph("Mul", given["age"], graph.constant([dt]))
        told.append(graph.log1p(age, unit=inverse.age_unit, end=inverse.age_max))
    h = graph.cast(graph("Concat", modes, *told, axis=1), real)
    for i, (weight, bias) in enumerate(zip(inverse.mlp.weights, inverse.mlp.biases, strict=True)):
        if i:
            h = _activated(graph, inverse.mlp.activation, h, real)
        # The weights are floats in Python, too.
        names = [graph.constant(np.asarray(values, np.float32), real) for values in (weight, bias)]
        h = graph("Gemm", h, *names, transB=1)
    h = graph("Mul", graph.cast(h, np.float64), graph.constant(inverse.x_scale))
    return graph("Add", h, graph.constant(inverse.x_offset))


def _activated(graph: _Graph, activation: str, h: str, real: Any) -> str:
    if activation != "silu":
        return graph({"tanh": "Tanh", "relu": "Relu"}[activation], h)
    half = graph("Mul", h, graph.constant([0.5], real))
    return graph("Add", half, graph("Mul", half, graph("Tanh", half)))  # as in observers.network: it cannot overflow
