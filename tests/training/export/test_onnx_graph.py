"""The step as an ONNX graph, run by ONNX Runtime, against the same in Python."""

import json
from dataclasses import replace

import numpy as np
import pytest
from exported_steps import (
    MAPS,
    apart,
    apart_at_all_levels,
    doubles,
    exported_of,
    in_doubles,
    mapped,
    operated,
    stepped,
    t_inv,
)
from exported_steps import tracked as tracked_record
from random_tracking import KINDS
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

TOLERANCES = {"float": 1e-5, "double": 1e-9}


@pytest.mark.parametrize(("index", "precision"), [*((i, "double") for i in range(len(MAPS))), (1, "float")])
def test_every_kind_of_map(index, precision):
    exported, y, u, expected = mapped(index)
    runner = Runner(replace(exported, precision=precision))
    assert set(runner.types.values()) == {"tensor(double)", f"tensor({precision})"}
    assert apart(exported, runner.along(y, u), expected) < TOLERANCES[precision]


@pytest.mark.parametrize(
    ("index", "precision"), [*((i, "double") for i in range(len(KINDS))), (1, "float"), (5, "float")]
)
def test_maps_that_track(index, precision):
    exported, y, u, expected = tracked_record(index)
    x_hat = Runner(replace(exported, precision=precision)).along(y[:, None], u[:, None])[:, 0]
    assert apart(exported, x_hat, expected) < TOLERANCES[precision]


def test_equations_of_all_operations_but_atan2():
    exported, y, u, expected = operated()
    assert apart(exported, Runner(exported).along(y[:, None], u[:, None])[:, 0], expected) < 1e-9
    with pytest.raises(ArtifactError, match="ONNX has no atan2"):
        onnx_model(operated(["atan2", ["u", 0], ["x", 1]])[0])


@pytest.mark.parametrize(
    ("name", "precision", "size"),
    [
        ("van_der_pol-spinn", "float", {"steps": 600, "length": 200}),
        ("lorenz", "double", {"steps": 600, "length": 200}),
        *(
            pytest.param(name, precision, {"steps": 34_000}, marks=pytest.mark.slow)
            for name in shipped()
            for precision in TOLERANCES
        ),
    ],
)
def test_what_ships(name, precision, size):
    def along(exported, y, u):
        return Runner(exported).along(y[:, None], u[:, None])[:, 0]

    of_range, of_scale = apart_at_all_levels(name, precision, along, **size)
    print(f"{name} {precision}: {of_range:.1e} of the range, {of_scale:.1e} of the scale")
    assert of_range < TOLERANCES[precision]


@pytest.mark.parametrize("tracks", [False, True])
def test_rows_have_levels_of_their_own(tracks):
    exported, y, u, _ = tracked_record(5) if tracks else mapped(1)
    y, u = (np.stack([each[:100]] * 2, 1) for each in ((y, u) if tracks else (y[:, 1], u[:, 1])))
    levels = [((0.2, 0.7), 0.1), ((0.9, 7.0), 0.6)]  # T_inv is told 2 and 0.2 at most, and the Kalman filter any
    told = {"measurement_noise": np.array([a for a, _ in levels]), "process_noise": np.array([[b] for _, b in levels])}
    x_hat = Runner(exported).along(y, u, **told)
    for row, (measurement, process) in enumerate(levels):
        cut = tuple(min(level, 2.0) for level in measurement)
        alone = replace(exported, measurement_noise=cut, process_noise=process)
        np.testing.assert_allclose(x_hat[:, row], in_doubles(alone, y[:, row], u[:, row]), atol=1e-9)


def test_a_row_begins_anew_and_one_whose_covariance_breaks_down_is_lost():
    exported, y, u, _ = tracked_record(0)
    y, u = (np.stack([each[10:90]] * 3, 1) for each in (y, u))
    runner, x_hat = Runner(exported), []
    states = runner.begun(3)
    for k in range(80):
        if k == 50:
            states["tracker"][1, 2] = -1.0  # a variance
        age = np.array([[k], [k], [k if k < 60 else k - 60]])
        found, states = runner.step(states, u=u[k - 1], y_next=y[k], age=age)
        x_hat.append(found)
    x_hat = np.array(x_hat)
    np.testing.assert_allclose(x_hat[:, 0], in_doubles(exported, y[:, 0], u[:, 0]), atol=1e-9)
    np.testing.assert_allclose(x_hat[60:, 2], in_doubles(exported, y[60:, 2], u[60:, 2]), atol=1e-9)
    with doubles():
        *_, observer = stepped(exported, y[:51, 1], u[:51, 1])
        np.testing.assert_allclose(x_hat[50, 1], t_inv(observer), atol=1e-9)
    assert abs(x_hat[50, 1] - x_hat[50, 0]).max() > 0.1
    assert np.isfinite(x_hat).all()


def test_an_input_that_is_no_number_is_not_taken_for_none(make_artifact, tmp_path):
    runner, y = Runner(exported_of(make_artifact(free_inverse=True), tmp_path)), np.ones((1, 1))
    states = {name: np.zeros_like(each) for name, each in runner.begun(1).items()}
    assert np.isnan(runner.step(states, y=y, u=np.full((1, 1), np.nan), y_next=y, age=np.ones((1, 1)))[0]).all()


def test_what_is_said_of_it():
    model = onnx_model(Exported.read("van_der_pol"))
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert (said["name"], said["system"]) == ("van_der_pol", "van_der_pol")
    assert said["artifact"] == resolve("van_der_pol").name
    assert said["sha256"] == checksum(resolve("van_der_pol"), ArtifactError)
    names = ("parameters", "dt", "y", "u", "x_hat", "measurement_noise", "process_noise")
    assert {name: json.loads(said[name]) for name in names} == {
        "parameters": {"mu": 3.0}, "dt": 0.01, "y": ["y"], "u": ["u"], "x_hat": ["x1", "x2"],
        "measurement_noise": [0.5], "process_noise": 0.05,
    }  # fmt: skip
    assert [(one.domain, one.version) for one in model.opset_import] == [("", OPSET)]
    assert {value.type.tensor_type.shape.dim[0].dim_param for value in model.graph.input} == {"batch"}


def test_observers_from_rollouts_name_their_signals(tmp_path):
    artifact = observer_of("Pendulum-v1", ["obs[0]", "obs[1]"], ["obs[2]"], ["action[0]"])
    model = onnx_model(exported_of(artifact, tmp_path, precision="double"))
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert [json.loads(said[name]) for name in ("y", "u", "x_hat")] == [["obs[0]", "obs[1]"], ["action[0]"], ["obs[2]"]]
