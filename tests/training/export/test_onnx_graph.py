"""The exported step as an ONNX graph, run by ONNX Runtime; few cases, since an export takes seconds."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from exported_steps import apart, mapped, motion, tracked

from observers.checks import ArtifactError
from observers.names import resolve
from observers.storage import checksum
from training import TorchObserver
from training.export.exported import Exported

pytest.importorskip("onnx", reason="needs the extra onnx")
pytest.importorskip("onnxruntime", reason="needs the extra onnx")
pytest.importorskip("onnxscript", reason="needs the extra onnx")

import onnxruntime

from training.export.onnx_graph import OPSET, onnx_model

TYPES = {"tensor(float)": np.float32, "tensor(double)": float}


class Runner:
    """Runs a graph with a batch."""

    def __init__(self, model):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self.types = {one.name: one.type for one in self.session.get_inputs()}
        self.width = self.session.get_inputs()[0].shape[1]
        self.names = [one.name for one in self.session.get_outputs()]

    def start(self, n):
        return np.zeros((n, self.width))

    def step(self, state, **given):
        """Run one step; return the outputs by name."""
        inputs = {name: np.asarray((given | {"state": state})[name], TYPES[kind]) for name, kind in self.types.items()}
        return dict(zip(self.names, self.session.run(self.names, inputs), strict=True))

    def along(self, y, u, measurement_noise, process_noise):
        """Estimates along a batch of records."""
        n, x_hat = y.shape[1], []
        levels = {
            "measurement_noise": np.tile(measurement_noise, (n, 1)),
            "process_noise": np.full((n, 1), process_noise),
        }
        state = self.start(n)
        for k in range(len(y)):
            found = self.step(state, y=y[k], u=u[k - 1], **levels)
            state = found["state_next"]
            x_hat.append(found["x_hat"])
        return np.array(x_hat)


def along(exported, y, u):
    return Runner(onnx_model(exported)).along(y, u, exported.levels, exported.process_noise)


@pytest.mark.parametrize(("precision", "tolerance"), [("double", 1e-9), ("float", 1e-5)])
def test_a_map_that_does_not_track(precision, tolerance):
    exported, y, u, expected = mapped(1)
    assert apart(exported, along(replace(exported, precision=precision), y, u), expected) < tolerance


@pytest.mark.slow
@pytest.mark.parametrize("index", [2, 6, 7])
def test_maps_that_track(index):
    exported, y, u, expected = tracked(index)
    assert apart(exported, along(exported, y[:, None], u[:, None])[:, 0], expected) < 1e-9


def test_shipped_maps():
    """Restarts, gaps, noise levels and covariances agree with TorchObserver; the metadata name all signals."""
    exported = Exported.read("van_der_pol")
    model = onnx_model(exported)
    runner, module = Runner(model), TorchObserver(exported.artifact)
    y, u = motion(exported.artifact, 60)
    y = np.stack([y, y + 0.3], 1).astype(np.float32)
    y[20:25, 0] = np.nan
    u, levels = np.stack([u, u], 1).astype(np.float32), np.array([[0.1], [0.7]])
    state, own = runner.start(2), module.start(2)
    for k in range(60):
        if k == 40:
            state[0], own[0] = 0.0, 0.0
        found = runner.step(state, y=y[k], u=u[k - 1], measurement_noise=levels, process_noise=levels)
        state = found["state_next"]
        given = [torch.tensor(each) for each in (y[k], u[k - 1], levels, levels)]
        with torch.no_grad():
            own, x_hat = module(own, *given)
            P = module.covariance(own, *given[2:]).numpy()
        assert np.abs((found["x_hat"] - x_hat.numpy()) / exported.artifact.inverse.x_scale).max() < 1e-5
        assert np.abs(found["covariance"] - P).max() < 1e-4 * np.abs(P).max()
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["sha256"] == checksum(resolve("van_der_pol"), ArtifactError)
    texts = ("name", "artifact", "sha256", "system")
    assert {name: value if name in texts else json.loads(value) for name, value in metadata.items()} == {
        "name": "van_der_pol", "artifact": resolve("van_der_pol").name, "sha256": metadata["sha256"],
        "system": "van_der_pol", "parameters": {"mu": 3.0}, "dt": 0.01, "y": ["y"], "u": ["u"], "x_hat": ["x1", "x2"],
        "measurement_noise": [0.5], "process_noise": 0.05,
    }  # fmt: skip
    assert [(one.domain, one.version) for one in model.opset_import] == [("", OPSET)]
    assert {value.type.tensor_type.shape.dim[0].dim_param for value in model.graph.input} == {"batch"}
