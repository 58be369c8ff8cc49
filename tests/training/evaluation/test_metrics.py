"""Measures of error, by hand."""

import numpy as np
import pytest

from training import smape


def test_smape_by_hand():
    x = np.array([[[3.0, 4.0]], [[0.0, 2.0]]])
    x_hat = np.array([[[0.0, 0.0]], [[0.0, 1.0]]])
    assert smape(x, x_hat)[0] == pytest.approx(100 * (2 * 5 / 5 + 2 * 1 / 3) / 2)
    assert smape(x, x_hat, skip=1)[0] == pytest.approx(100 * 2 / 3)
    assert smape(np.zeros((2, 1, 2)), np.zeros((2, 1, 2)))[0] == 0.0
    with pytest.raises(ValueError, match="cannot compare"):
        smape(x, x_hat[:1])
