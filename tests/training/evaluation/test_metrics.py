"""Measures of error, computed by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from training import nrmse, smape


def test_smape_by_hand():
    x = np.array([[[3.0, 4.0]], [[0.0, 2.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[0.0, 1.0]]])
    assert smape(x, x_hat)[0] == pytest.approx(100 * (2 * 5 / 5 + 2 * 1 / 3) / 2)
    assert smape(x, x_hat, skip=1)[0] == pytest.approx(100 * 2 / 3)
    assert smape(np.zeros((2, 1, 2)), np.zeros((2, 1, 2)))[0] == 0.0
    with pytest.raises(ValueError, match="cannot compare"):
        smape(x, x_hat[:1])


def test_nrmse_by_hand():
    x = np.zeros((4, 2, 3))
    x[..., 0] = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, 1.0], [-1.0, -1.0]])  # standard deviation 1
    x[..., 1] = 300.0 + np.array([0.0, 4.0])  # standard deviation 2 over two constant trajectories
    x[..., 2] = 5.0
    x_hat = x + np.array([[0.1, 0.2, 1.0], [0.3, 0.0, 1.0]])
    x_hat[0] += 7.0
    found = nrmse(x, x_hat, skip=1)
    assert found[:, :2] == pytest.approx(np.array([[10.0, 10.0], [30.0, 0.0]]))
    assert np.isnan(found[:, 2]).all()
    x_hat[2, 0, 0], x_hat[1, 1, 1] = np.nan, np.inf
    assert nrmse(x, x_hat)[[0, 1], [0, 1]].tolist() == [math.inf, math.inf]
    assert nrmse(x[:, :0], x[:, :0]).shape == (0, 3)
    rounding = np.where(np.arange(100) % 2, 300.0, np.nextafter(300.0, 301.0))[:, None, None]
    assert np.isnan(nrmse(rounding, rounding + 0.01)).all()
    with pytest.raises(ValueError, match="cannot compare"):
        nrmse(x, x_hat, skip=4)


@given(
    arrays(float, (5, 3, 2), elements=st.floats(-1e3, 1e3)),
    arrays(float, (5, 3, 2), elements=st.floats(-1e3, 1e3)),
    st.tuples(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6)),
)
def test_nrmse_does_not_depend_on_units(x, error, unit):
    x[0], x[1] = -1e3, 1e3  # x must not be constant
    np.testing.assert_allclose(nrmse(x * unit, (x + error) * unit), nrmse(x, x + error), rtol=1e-6, atol=1e-9)
