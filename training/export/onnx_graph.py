"""The step as an ONNX graph: a function of the filter's state, two samples and the input between them."""

import json
from typing import Any

import numpy as np

import kkl_gym
from training.export.exported import Exported
from training.export.onnx_map import Maps
from training.export.onnx_nodes import Graph, Value
from training.export.onnx_tracker import TrackerNodes, state_width

OPSET, IR = 13, 7  # of 2020 and 2021; what reads ONNX reads these
_TYPES = {"float": np.float32, "double": np.float64}
_STATES = ("z", "tracker")  # what is given back for the next step, in doubles


def onnx_model(exported: Exported) -> Any:
    """Build the graph, see that ONNX takes it for one, and describe it in its metadata.

    The inputs have a row for each observer of a batch: ``z`` (size), ``y`` (ny), ``u`` (nu), ``y_next`` (ny), ``age``
    (1), the samples since the observer was switched on, and as far as the map is told of them ``measurement_noise``
    and ``process_noise``. The outputs are ``z_next`` (size) and ``x_hat`` (nx, and estimated parameters). A row of age
    0 begins: its z, y and u count for nothing. An observer that tracks has ``tracker`` and ``tracker_next`` beside z,
    which hold y as well, and takes a y_next of NaN for missing. docs/guides/export.md says more.
    """
    from onnx import checker, helper

    artifact, linear, tracks = exported.artifact, exported.artifact.filter, exported.artifact.motion is not None
    real, levels = _TYPES[exported.precision], len(exported.levels)
    inputs = {
        "z": linear.size,
        "tracker": state_width(artifact) if tracks else 0,
        "y": 0 if tracks else artifact.ny,
        "u": artifact.nu,
        "y_next": artifact.ny,
        "age": 1,
        "measurement_noise": levels,
        "process_noise": int(exported.needs_process_noise),
    }
    inputs = {name: width for name, width in inputs.items() if width}
    outputs = {"z_next": linear.size, "tracker_next": inputs.get("tracker", 0), "x_hat": len(exported.estimates)}
    outputs = {name: width for name, width in outputs.items() if width}
    graph = Graph()
    given = {name: Value(graph, name) for name in inputs}
    given |= {name: value.cast(np.float64) for name, value in given.items() if name not in _STATES}
    begins = graph("Equal", given["age"], 0.0)
    tracker = TrackerNodes(graph, artifact, given, begins, real) if tracks else None
    if tracker is None:
        z = _filtered(graph, exported, given, begins)
        x_hat = Maps(graph, exported, z, given, real).estimate()
    else:
        tracked, whole = tracker.taken()
        z = _filtered(graph, exported, given | {"y": tracker.y, "y_next": whole}, begins)
        tracked = tracker.supervised(tracked, Maps(graph, exported, z, given, real))
        graph.named("tracker_next", graph.joined(*tracked, whole))
        x_hat = tracker.estimate(tracked[0])
    graph.named("z_next", z)
    graph.named("x_hat", x_hat.cast(real))

    def value(name: str, width: int) -> Any:
        kind = np.float64 if name.removesuffix("_next") in _STATES else real
        return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(kind)), ["batch", width])

    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            exported.name,
            [value(name, width) for name, width in inputs.items()],
            [value(name, width) for name, width in outputs.items()],
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


def _filtered(graph: Graph, exported: Exported, given: dict[str, Value], begins: Value) -> Value:
    """The filter's next state, (n, size)."""
    linear = exported.artifact.filter
    signals = graph.joined(*(given[name] for name in ("z", "y", "u", "y_next") if name in given))
    update = np.vstack([linear.transition.T, linear.early_y.T, linear.held_u.T, linear.late_y.T])
    return graph.where(begins, given["y_next"] @ linear.equilibrium.T, signals @ update)
