"""Maps that track as ONNX graphs, run by ONNX Runtime, against the same in Python."""

from dataclasses import replace

import numpy as np
import pytest
from exported_steps import apart, doubles, exported_of, in_doubles, lost_and_inflated
from random_tracking import KINDS, of_floats, signals, tracking

from observers import Expression, KKLObserver

pytest.importorskip("onnx", reason="needs the extra onnx")
pytest.importorskip("onnxruntime", reason="needs the extra onnx")

from onnx_steps import Runner

from training.export.onnx_graph import onnx_model
from training.export.onnx_tracker import state_width


@pytest.mark.parametrize(("precision", "tolerance"), [("float", 1e-5), ("double", 1e-9)])
@pytest.mark.parametrize("options", KINDS)
def test_two_thousand_samples(options, precision, tolerance, tmp_path):
    exported = exported_of(tracking(**options), tmp_path, precision=precision)
    y, u = of_floats(exported.artifact, 2000)
    y[2:9] = y[700:720] = y[300::7, 0] = np.nan  # from the start on, where T_inv has learned less than it is old
    x_hat = Runner(exported).along(y[:, None], u[:, None])[:, 0]
    assert apart(exported, x_hat, y, u) < tolerance
    lost, inflated = lost_and_inflated(exported, y, u)
    assert sum(lost[600:700]) > 1
    assert inflated.any()


def test_rows_have_levels_of_their_own(tmp_path):
    artifact = tracking(outputs=2, process=True, free_inverse=True)
    y, u = signals(artifact, 200, (2,))
    levels = [((0.2, 0.7), 0.1), ((0.9, 7.0), 0.6)]  # T_inv is told 2 and 0.2 at most, and the Kalman filter any
    exported = exported_of(artifact, tmp_path, precision="double")
    runner = Runner(exported)
    step = runner.session.run
    told = {"measurement_noise": np.array([a for a, _ in levels]), "process_noise": np.array([[b] for _, b in levels])}
    states, x_hat = {"z": np.zeros((2, artifact.filter.size)), "tracker": np.zeros((2, state_width(artifact)))}, []
    for k in range(200):
        given = {"u": u[k - 1], "y_next": y[k], "age": np.full((2, 1), float(k)), **told, **states}
        states["z"], states["tracker"], found = step(["z_next", "tracker_next", "x_hat"], given)
        x_hat.append(found)
    for row, (measurement, process) in enumerate(levels):
        cut = tuple(min(level, 2.0) for level in measurement)
        alone = replace(exported, measurement_noise=cut, process_noise=process)
        np.testing.assert_allclose(np.array(x_hat)[:, row], in_doubles(alone, y[:, row], u[:, row]), atol=1e-9)


def test_a_row_begins_anew_and_one_whose_covariance_breaks_down_is_lost(tmp_path):
    artifact = tracking()
    exported = exported_of(artifact, tmp_path, precision="double")
    runner, (y, u) = Runner(exported), signals(artifact, 80, (3,))
    states, x_hat = {"z": np.zeros((3, artifact.filter.size)), "tracker": np.zeros((3, state_width(artifact)))}, []
    for k in range(80):
        if k == 50:
            states["tracker"][1, 2] = -1.0  # a variance
        age = np.array([[k], [k], [k if k < 60 else k - 60]])
        found = runner.step(**states, u=u[k - 1], y_next=y[k], age=age)
        states = {name: found[f"{name}_next"] for name in states}
        x_hat.append(found["x_hat"])
    expected = [in_doubles(exported, y[:, 0], u[:, 0]), [], in_doubles(exported, y[60:, 2], u[60:, 2])]
    levels = exported.measurement_noise, exported.process_noise
    observer = KKLObserver(exported.artifact, levels[0], process_noise=levels[1], compiled=False)  # as it was read
    with doubles():
        observer.reset(y[0, 1])
        expected[1].append(observer.decode())
        for k in range(1, 80):
            if k == 50:
                observer._tracker._P[0, 0, 0] = -1.0
            expected[1].append(observer.step(y[k, 1], u[k - 1, 1]))
            if k == 50:
                assert observer._tracker._mean_square[0] == 1.0
    x_hat = np.array(x_hat)
    np.testing.assert_allclose(x_hat[:, 0], expected[0], atol=1e-9)
    np.testing.assert_allclose(x_hat[:, 1], expected[1], atol=1e-9)
    np.testing.assert_allclose(x_hat[60:, 2], expected[2], atol=1e-9)


def test_outputs_that_are_not_linear_are_refused(tmp_path):
    curved = replace(tracking(), C=None, h=Expression([["+", ["x", 0], ["x", 1]]]))
    with pytest.raises(ValueError, match=r"not linear, and ONNX takes y = C x alone: export the map that it was made"):
        onnx_model(exported_of(curved, tmp_path))
