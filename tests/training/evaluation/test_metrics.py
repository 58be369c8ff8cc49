"""Measures of error, by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from training import nrmse, smape
from training.evaluation.metrics import component_smape, percentage_error, rmse, settling_time


def test_smape_by_hand():
    x = np.array([[[3.0, 4.0]], [[0.0, 2.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[0.0, 1.0]]])
    assert smape(x, x_hat)[0] == pytest.approx(100 * (2 * 5 / 5 + 2 * 1 / 3) / 2)
    assert percentage_error(x, x_hat)[:, 0] == pytest.approx([200.0, 200 / 3])
    assert smape(x, x_hat, skip=1)[0] == pytest.approx(100 * 2 / 3)
    assert smape(np.zeros((2, 1, 2)), np.zeros((2, 1, 2)))[0] == 0.0
    with pytest.raises(ValueError, match="cannot compare"):
        smape(x, x_hat[:1])


def test_nrmse_by_hand():
    x = np.zeros((4, 2, 3))
    x[..., 0] = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, 1.0], [-1.0, -1.0]])  # of standard deviation 1
    x[..., 1] = 300.0 + np.array([0.0, 4.0])  # 2, though none of the two moves by itself
    x[..., 2] = 5.0
    x_hat = x + np.array([[0.1, 0.2, 1.0], [0.3, 0.0, 1.0]])
    x_hat[0] += 7.0
    found = nrmse(x, x_hat, skip=1)
    assert found[:, :2] == pytest.approx(np.array([[10.0, 10.0], [30.0, 0.0]]))
    assert np.isnan(found[:, 2]).all()
    assert nrmse(x, x)[:, 0].tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="cannot compare"):
        nrmse(x, x_hat, skip=4)


def test_nrmse_of_estimates_that_are_not_finite_and_of_no_trajectories():
    x = np.arange(12.0).reshape(3, 2, 2)
    x_hat = x.copy()
    x_hat[2, 0, 0], x_hat[1, 1, 1] = np.nan, np.inf
    assert nrmse(x, x_hat).tolist() == [[math.inf, 0.0], [0.0, math.inf]]
    assert nrmse(x[:, :0], x[:, :0]).shape == (0, 2)


def test_a_state_that_only_rounds_has_no_figure():
    x = np.full((100, 1, 1), 300.0)
    x[::2] = np.nextafter(300.0, 301.0)
    assert np.isnan(nrmse(x, x + 0.01)).all()


@given(
    arrays(float, (5, 3, 2), elements=st.floats(-1e3, 1e3)),
    arrays(float, (5, 3, 2), elements=st.floats(-1e3, 1e3)),
    st.tuples(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6)),
)
def test_nrmse_knows_no_units(x, error, unit):
    x[0], x[1] = -1e3, 1e3  # it moves
    np.testing.assert_allclose(nrmse(x * unit, (x + error) * unit), nrmse(x, x + error), rtol=1e-6, atol=1e-9)


def test_one_norm_of_mixed_units_says_nothing_of_the_small_state():
    t = np.linspace(0.0, 4 * np.pi, 400, endpoint=False)[:, None]
    x = np.stack([300 + 20 * np.sin(t), 1e-3 * (1 + np.cos(t))], axis=-1)
    x_hat = x + np.array([0.03, 0.0])
    x_hat[..., 1] += 0.02e-3 * np.cos(t)
    assert smape(x, x_hat)[0] == pytest.approx(0.01, rel=0.01)
    assert nrmse(x, x_hat)[0] == pytest.approx([100 * 0.03 / (20 / np.sqrt(2)), 2.0])


def test_all_other_measures_by_hand():
    x = np.array([[[3.0, 4.0]], [[3.0, 4.0]], [[3.0, 4.0]], [[0.0, 0.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[3.0, 0.0]], [[3.0, 4.0]], [[0.0, 0.0]]])
    assert smape(x, x_hat) == pytest.approx([100 * (2 + 2 * 4 / 8 + 0 + 0) / 4])
    assert smape(x, x_hat, skip=1) == pytest.approx([100 * (2 * 4 / 8 + 0 + 0) / 3])
    assert component_smape(x, x_hat) == pytest.approx([100 * (2 + 2 + 0 + 2 + 0 + 0 + 0 + 0) / 8])
    assert rmse(x, x_hat) == pytest.approx([math.sqrt((25 + 16) / 4)])
    # The root mean square of |x| is sqrt(75 / 4); errors 5 and 4 are above a tenth of it, 0 is below.
    assert settling_time(x, x_hat, dt=0.5) == pytest.approx([1.0])
    assert settling_time(x, x[::-1], dt=0.5) == pytest.approx([math.inf])
    x_hat[3, 0, 0] = np.nan
    assert (smape(x, x_hat)[0] > 50.0, rmse(x, x_hat).tolist()) == (True, [math.inf])
