"""What is done to rows in one pass, compiled and not, against a second way to compute it."""

import numpy as np
import pytest

from kkl_gym.rows import clipped, held, judged
from observers.thresholds import MANY_ROWS


@pytest.fixture(params=[3, MANY_ROWS + 3])
def rows(request):
    """Few, and so many that compiled code takes them."""
    if request.param > 3:
        pytest.importorskip("numba")
    return request.param


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_clipped(rows, dtype):
    low, high = np.array([-1, 0, -np.inf], np.float32), np.array([1, 0.5, np.inf], np.float32)
    values = np.random.default_rng(0).normal(size=(rows, 3)).astype(dtype)
    values[0] = np.nan, -np.inf, np.inf
    out = clipped(values, low, high)
    assert out.dtype == np.float32
    assert np.array_equal(out, np.clip(values.astype(np.float32), low, high), equal_nan=True)
    assert np.array_equal(out[1], clipped(values[1], low, high))
    with pytest.raises(ValueError, match="broadcast"):
        clipped(values, low[:2], high[:2])


def test_clipped_beyond_float32(rows):
    high = np.array([1.0, np.inf], np.float32)
    out = clipped(np.full((rows, 2), [1e39, -1e300]), -high, high)
    assert np.array_equal(out, np.full((rows, 2), [1.0, -np.inf]))


@pytest.mark.parametrize("nu", [0, 1, 2])
def test_held(rows, nu):
    actions, u_max = np.random.default_rng(0).uniform(-2, 2, (2 * rows, 3)), np.array([5.0, 0.25])[:nu]
    actions[0], actions[2, 0], actions[4, 0] = np.nan, np.inf, -np.inf
    for given in (actions[::2, :nu], np.ascontiguousarray(actions[:rows, :nu])):
        before = given.copy()
        u = held(given, u_max)
        assert u.shape == (nu, rows)
        assert u.flags.c_contiguous
        assert np.array_equal(u, (np.clip(given, -1, 1) * u_max).T, equal_nan=True)
        assert np.array_equal(given, before, equal_nan=True)


def test_judged(rows):
    x = np.random.default_rng(0).normal(size=(2, rows))
    bounds, target, weights = np.array([[-1.0, -0.5], [0.7, 1.0]]), np.array([0.1, -0.2]), np.array([0.3, 2.0])
    x[:, 0], x[:, 1], x[0, 2] = (0.7, -0.5), (np.nan, 0.0), np.inf
    inside, reward = judged(x, (*bounds,), target=target, weights=weights)
    assert inside.dtype == bool
    assert inside.tolist() == [-1 <= a <= 0.7 and -0.5 <= b <= 1 for a, b in x.T]
    assert inside[0]
    assert not inside[1:3].any()
    assert reward[inside] == pytest.approx(
        [1 / (1 + 1.2 * (a - 0.1) ** 2 + 8 * (b + 0.2) ** 2) for a, b in x.T[inside]]
    )
    assert reward[2] == 0.0


@pytest.mark.parametrize("far", [1e200, -1e200, np.inf, np.nan])
def test_what_escapes_far_warns_of_nothing(rows, far):
    """A discrete system's step may lead anywhere, and a weight may be zero."""
    x = np.zeros((2, rows))
    x[0, 1] = far
    inside, reward = judged(x, (np.full(2, -1.0), np.ones(2)), target=np.zeros(2), weights=np.array([0.0, 1.0]))
    assert np.flatnonzero(~inside).tolist() == [1]
    assert (reward[inside] == 1.0).all()
