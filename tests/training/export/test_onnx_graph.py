"""The step as an ONNX graph, run by ONNX Runtime, against the same in Python."""

import json

import numpy as np
import pytest
from exported_steps import apart, apart_at_all_levels, exported_of, in_doubles, noise
from rollout_observers import observer_of

from observers import shipped
from observers.errors import ArtifactError
from observers.names import resolve
from observers.storage import checksum
from training.export import Exported

pytest.importorskip("onnx", reason="needs the extra onnx")
pytest.importorskip("onnxruntime", reason="needs the extra onnx")

from onnx_steps import Runner

from training.export.onnx_graph import OPSET, onnx_model


@pytest.mark.parametrize(("precision", "tolerance"), [("float", 1e-5), ("double", 1e-10)])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"inputs": False, "noise": False, "age": False},
        {"pair": True, "outputs": 2, "process": True, "free_inverse": True},
        {"estimated": True, "process": True},
    ],
)
def test_every_kind_of_map(options, precision, tolerance, make_artifact, tmp_path):
    exported = exported_of(make_artifact(**options), tmp_path, precision=precision)
    y, u = noise(exported.artifact, 300, (3,))
    u[:, 0] = 0.0  # a row that keeps to the map of free motion
    runner = Runner(exported)
    assert set(runner.types.values()) == {"tensor(double)", f"tensor({precision})"}
    assert apart(exported, runner.along(y, u), y, u) < tolerance


@pytest.mark.parametrize(
    "name",
    [
        "van_der_pol-static",
        "lorenz",
        *(pytest.param(name, marks=pytest.mark.slow) for name in shipped()),
    ],
)
@pytest.mark.parametrize(("precision", "tolerance"), [("float", 1e-5), ("double", 1e-9)])
def test_what_ships(name, precision, tolerance, request):
    slow = request.node.get_closest_marker("slow")  # in which there are so many steps at each of three levels
    size = {"steps": 34_000} if slow else {"steps": 1200, "length": 200}

    def along(exported, y, u):
        return Runner(exported).along(y[:, None], u[:, None])[:, 0]

    of_range, of_scale = apart_at_all_levels(name, precision, along, **size)
    print(f"{name} {precision}: {of_range:.1e} of the range, {of_scale:.1e} of the scale")
    assert of_range < tolerance


def test_rows_have_levels_of_their_own_and_begin_anew(make_artifact, tmp_path):
    exported = exported_of(make_artifact(), tmp_path, precision="double")
    runner, (y, u) = Runner(exported), noise(exported.artifact, 20, (2,))
    z = np.zeros((2, exported.artifact.filter.size))
    for k in range(20):
        age = np.array([[k], [k if k < 10 else k - 10]])
        found = runner.step(z=z, y=y[k - 1], u=u[k - 1], y_next=y[k], age=age)
        z, x_hat = found["z_next"], found["x_hat"]
    np.testing.assert_allclose(x_hat[0], in_doubles(exported, y, u)[-1, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(x_hat[1], in_doubles(exported, y[10:], u[10:])[-1, 1], rtol=0, atol=1e-9)
    runner.exported = Exported.read("lorenz-static", measurement_noise=7 - 4.5)  # beyond what this map is told: 1
    beyond = runner.step(z=z, y=y[0], u=u[0], y_next=y[1], age=np.full((2, 1), 5))["x_hat"]
    runner.exported = Exported.read("lorenz-static", measurement_noise=1.0)
    assert np.array_equal(beyond, runner.step(z=z, y=y[0], u=u[0], y_next=y[1], age=np.full((2, 1), 5))["x_hat"])


def test_an_input_that_is_no_number_is_not_taken_for_none(make_artifact, tmp_path):
    exported = exported_of(make_artifact(free_inverse=True), tmp_path)
    z, y = np.zeros((1, exported.artifact.filter.size)), np.ones((1, 1))
    x_hat = Runner(exported).step(z=z, y=y, u=np.full((1, 1), np.nan), y_next=y, age=np.ones((1, 1)))["x_hat"]
    assert np.isnan(x_hat).all()


def test_what_is_said_of_it():
    model = onnx_model(Exported.read("van_der_pol-static"))
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert said["name"] == "van_der_pol_static"
    assert said["system"] == "van_der_pol"
    assert said["artifact"] == "van_der_pol-static.safetensors"
    assert said["sha256"] == checksum(resolve("van_der_pol-static"), ArtifactError)
    read = {name: json.loads(said[name]) for name in ("parameters", "dt", "y", "u", "x_hat", "measurement_noise")}
    assert read == {"parameters": {"mu": 3.0}, "dt": 0.01, "y": ["y"], "u": ["u"], "x_hat": ["x1", "x2"],
                    "measurement_noise": [0.5]}  # fmt: skip
    assert json.loads(said["process_noise"]) == 0.05
    assert [(one.domain, one.version) for one in model.opset_import] == [("", OPSET)]
    assert {value.type.tensor_type.shape.dim[0].dim_param for value in model.graph.input} == {"batch"}


def test_observers_from_rollouts_name_their_signals(tmp_path):
    artifact = observer_of("Pendulum-v1", ["obs[0]", "obs[1]"], ["obs[2]"], ["action[0]"])
    exported = exported_of(artifact, tmp_path, precision="double")
    said = {entry.key: entry.value for entry in onnx_model(exported).metadata_props}
    assert [json.loads(said[name]) for name in ("y", "u", "x_hat")] == [["obs[0]", "obs[1]"], ["action[0]"], ["obs[2]"]]
    y, u = noise(artifact, 50, (2,))
    assert apart(exported, Runner(exported).along(y, u), y, u) < 1e-10
