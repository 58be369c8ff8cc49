"""The filters of the memory against integration, closed forms and worst-case signals."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_lyapunov

from kkl_gym.memory import IMAGINED, Memory

BANKS = [((1.0, 2.0, 4.0, 8.0), (1.0, 4.0)), ((0.5, 3.0, 500.0), ()), ((7.0,), (0.5, 30.0, 9000.0))]
banks = pytest.mark.parametrize(("outputs", "inputs"), BANKS)


def memory(ny=2, nu=1, outputs=(1, 2, 4, 8), inputs=(1, 4)):
    return Memory(ny, nu, time_constants=outputs, input_time_constants=inputs)


def of_angles():
    """A memory of five outputs; the third is not an angle."""
    return Memory(5, 2, [(3, 1), (0, 4)], time_constants=(1, 3), input_time_constants=(2,))


def of_an_angle(outputs=(1, 3)):
    return Memory(2, 0, [(0, 1)], time_constants=outputs, input_time_constants=())


def signals(steps, *shape, seed=0):
    return np.random.default_rng(seed).normal(size=(steps, *shape))


def turning(steps, *shape, seed=0):
    """Five outputs of two angles that make more than one turn, and these angles, unwrapped."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-np.pi, np.pi, (*shape, 2)) + rng.uniform(-2.5, 2.5, (steps, *shape, 2)).cumsum(0)
    other = rng.normal(size=(steps, *shape, 1))
    (a, b), (cos, sin) = np.moveaxis(angles, -1, 0), (np.cos, np.sin)
    return np.stack([cos(b), sin(a), other[..., 0], cos(a), sin(b)], axis=-1), np.concatenate([other, angles], axis=-1)


def run(filters, y, u):
    return np.array([filters.reset(y[0]), *(filters.advance(one, held) for one, held in zip(y[1:], u))])


@banks
def test_the_filters_are_those_that_integration_finds(outputs, inputs):
    y, u = signals(12, 2), signals(11, 1, seed=1)
    filters = memory(2, 1, outputs, inputs)
    shown = run(filters, y, u)
    tau, tau_u = np.array(outputs)[:, None], np.array(inputs)

    def rate(t, state, k):
        z, v = state[: tau.size * 2].reshape(-1, 2), state[tau.size * 2 :]
        return np.concatenate([((y[k] + (y[k + 1] - y[k]) * t - z) / tau).ravel(), (u[k] - v) / tau_u])

    state = np.concatenate([np.tile(y[0], tau.size), np.zeros(tau_u.size)])
    for k in range(11):
        state = solve_ivp(rate, (0, 1), state, method="DOP853", rtol=1e-11, atol=1e-12, args=(k,)).y[:, -1]
        kept = np.exp(-1 / tau) ** (k + 1)
        w = (y[k + 1] - state[: tau.size * 2].reshape(-1, 2)) * (1 - kept * np.exp(-IMAGINED / tau)) / (1 - kept)
        expected = np.concatenate([y[k + 1], (filters.mixing @ w).ravel(), state[tau.size * 2 :]])
        assert np.allclose(shown[k + 1], expected, rtol=1e-5, atol=1e-5)


@banks
def test_a_steady_motion_is_extrapolated_into_the_past(outputs, inputs):
    filters, rate = memory(2, 1, outputs, inputs), np.array([[0.3, -2.0]])
    shown = run(filters, np.arange(40.0)[:, None] * rate + 5.0, np.zeros((39, 1)))[:, 2:]
    tau = np.array(outputs)[:, None]
    for k in (1, 2, 20, 39):
        w = tau * (1 - np.exp(-(k + 64) / tau)) * rate  # lag behind a ramp since 64 samples before y_0
        assert np.allclose(shown[k, : 2 * tau.size], (filters.mixing @ w).ravel(), rtol=1e-5, atol=1e-5)


@banks
def test_coordinates_are_uncorrelated_and_of_unit_size_for_wandering_signals(outputs, inputs):
    found = memory(1, 1, outputs, inputs)
    m, covariance = len(outputs), 0.0
    for correlation in np.geomspace(2 * outputs[0], 8 * outputs[-1], 6):
        stays = np.exp(-1 / correlation)  # y_k+1 = stays y_k + noise, w as in the docstring
        transition = np.block([[stays, np.zeros((1, m))], [found.rise[:, None] * (stays - 1), np.diag(found.decay)]])
        drive = np.concatenate([[1.0], found.rise])[:, None] * np.sqrt(1 - stays**2)
        covariance = covariance + solve_discrete_lyapunov(transition, drive @ drive.T)[1:, 1:] / 6
    assert np.allclose(found.mixing @ covariance @ found.mixing.T, np.eye(m), atol=1e-6)
    assert np.array_equal(abs(found.mixing) > 1e-9, np.tri(m, dtype=bool)[:, ::-1])  # one filter more each
    assert (found.mixing[range(m), range(m - 1, -1, -1)] > 0).all()


@pytest.mark.parametrize(("shortest", "ratio"), [(0.5, 1.5), (0.5, 10.0), (1.0, 2.0), (50.0, 1.5)])
def test_noise_is_amplified_at_most_threefold(shortest, ratio):
    most = 1 + int(np.log(9_999 / shortest) / np.log(ratio))
    for m in {1, 2, min(4, most), most}:
        found = memory(1, 0, shortest * ratio ** np.arange(m), ())
        later = ((found.decay - 1) * found.rise)[:, None]  # response after a pulse of y has ended
        of_filters = found.rise[:, None] * found.rise + solve_discrete_lyapunov(np.diag(found.decay), later @ later.T)
        assert 0.5 < np.sqrt((found.mixing @ of_filters @ found.mixing.T).diagonal().max()) < 3.0


def test_an_output_at_rest_leaves_no_trace():
    filters = memory()
    rest, away = np.array([1e4, -3.0]), np.array([1e4 + 1.0, -3.0])
    assert not filters.reset(rest)[2:].any()
    assert np.abs(filters.advance(away, np.ones(1))[2:]).max() > 0.3
    for _ in range(400):
        shown = filters.advance(away, np.zeros(1))
    assert np.abs(shown[2:]).max() < 1e-9


def test_a_single_row_and_a_batch_agree():
    y, u = signals(30, 5, 3), signals(29, 5, 2, seed=1)

    def rows():
        return np.stack([run(memory(3, 2), y[:, i], u[:, i]) for i in range(5)], 1)

    batch = run(memory(3, 2), y, u)
    assert batch.dtype == rows().dtype == np.float32
    assert np.allclose(batch, rows(), rtol=1e-6, atol=1e-6)


def test_nothing_underflows_while_a_memory_fills():
    with np.errstate(all="raise"):
        run(memory(2, 1, (0.5, 50.0)), signals(800, 2), signals(799, 1, seed=1))


@pytest.mark.parametrize("shape", [(), (4,)])
def test_features_of_angles_depend_on_the_unwrapped_angles(shape):
    (y, unwrapped), u = turning(40, *shape), signals(39, *shape, 2, seed=1)
    assert np.ptp(unwrapped[..., 1:], axis=0).min() > 2 * np.pi
    seen, plain = run(of_angles(), y, u), run(memory(3, 2, (1, 3), (2,)), unwrapped, u)
    assert np.allclose(seen[..., :5], y)
    assert np.allclose(seen[..., 5:], plain[..., 3:], atol=1e-5)
    assert seen.dtype == np.float32


def test_where_cosine_and_sine_are_zero_an_angle_is_taken_to_rest():
    still = np.array([[np.cos(2), np.sin(2)]] * 5)
    still[2], still[3] = 0.0, -0.0
    assert np.abs(run(of_an_angle(), still, np.zeros((4, 0)))[:, 2:]).max() < 1e-6
