"""What agents are shown."""

import numpy as np
import pytest
from linear_system import Oscillator

from kkl_gym import get_system
from observers import load
from training.agents.information import (
    INFORMATION,
    STACKED,
    Features,
    estimate_and_spread,
    kalman_filters,
    make,
    modes,
    observer_of,
    output_deviation,
)
from training.agents.tasks import ControlTask

N = 3
TASK = ControlTask("van_der_pol", measurement_noise=0.2, period=0.02, duration=0.2)


def actions(steps):
    return np.random.default_rng(0).uniform(-1.5, 1.5, (steps, N, 1)).astype(np.float32)


@pytest.mark.parametrize("information", INFORMATION)
def test_last_observations_of_episodes_and_first_ones_of_the_next(information):
    """Against the same environment that leaves resets to us; their size is about one."""
    ours, bare = make(TASK, information, N), make(TASK, information, N, autoreset_mode="Disabled")
    assert (ours.reset(seed=1)[0] == bare.reset(seed=1)[0]).all()
    ends, shown = 0, []
    for action in actions(25):
        obs, reward, terminated, truncated, info = ours.step(action)
        expected, expected_reward, _, over, _ = bare.step(action)
        assert (reward == expected_reward).all()
        assert (truncated == over).all()
        assert not terminated.any()
        if over.any():
            ends += 1
            assert all((info["final_obs"][row] == expected[row]).all() for row in range(N))
            assert all(info["final_obs"][row].dtype == np.float32 for row in range(N))
            expected, _ = bare.reset(options={"reset_mask": over})
        assert (obs == expected).all()
        assert obs in ours.observation_space
        shown.append(obs)
    assert ends == 2
    assert 0.05 < np.sqrt(np.square(shown).mean()) < 5


def test_states_are_taken_from_the_target_over_the_scale():
    system = get_system("lorenz")
    task = ControlTask("lorenz", period=0.01, duration=1.0)
    for information, key in (("state", "x"), ("x_hat", "x_hat")):
        obs, info = make(task, information, N).reset(seed=0)
        assert np.allclose(obs, (info[key] - system.target) / system.scale, atol=1e-6)
    obs, info = make(task, "y", N).reset(seed=0)
    assert np.allclose(obs, (info["y"] - system.target[1]) / system.scale[1], atol=1e-6)
    assert output_deviation(system)({"y": np.array([[system.target[1]]])}).tolist() == [[0.0]]


def test_standard_deviations_are_shown_by_their_size():
    system = get_system("van_der_pol")
    x_hat, sigma = np.array([[1.0, -2.0], [0.0, 3.0]]), np.array([[0.1, 10.0], [1e-3, 0.0]]) * system.scale
    shown = estimate_and_spread(system)({"x_hat": x_hat, "x_cov": sigma[..., None] ** 2 * np.eye(2)})
    np.testing.assert_allclose(shown[:, :2], (x_hat - system.target) / system.scale)
    np.testing.assert_allclose(shown[:, 2:], [[-1.0, 1.0], [-3.0, -6.0]])


def test_z_is_what_the_network_sees_from_its_value_at_the_target():
    system = get_system("van_der_pol")
    env = make(TASK, "z", N)
    env.reset(seed=0)
    for action in actions(5):
        obs, *_, info = env.step(action)
    observer = load(observer_of(system), 0.2)
    inverse = observer.artifact.inverse
    feature, width = modes(observer, system)
    assert obs.shape == (N, width)
    at_target = observer.artifact.filter.start(np.zeros((N, 1)))
    shift = feature({"z": at_target, "sample": info["sample"]})
    assert np.allclose(shift[:, :-1], 0.0)
    whitened = (info["z"] - at_target) @ (inverse.gain(0.2)[:, None] * inverse.whiten).T
    assert np.allclose(obs[:, :-1], whitened, atol=1e-4)
    assert np.allclose(obs[:, -1], inverse.age_feature(np.full(N, 0.1)))


def test_stacked_outputs_and_actions_by_hand():
    env = make(TASK, "stacked", N)
    obs, info = env.reset(seed=0)
    scaled = output_deviation(get_system("van_der_pol"))
    pairs = [np.concatenate([scaled(info), np.zeros((N, 1))], 1)] * STACKED
    assert np.allclose(obs, np.concatenate(pairs, 1))
    for action in actions(TASK.steps - 1):
        obs, *_, info = env.step(action)
        pairs = [*pairs[1:], np.concatenate([scaled(info), np.clip(action, -1, 1)], 1)]
        assert np.allclose(obs, np.concatenate(pairs, 1), atol=1e-6)


def test_kalman_filters_that_know_the_input_follow_a_driven_state():
    env = make(ControlTask("van_der_pol", measurement_noise=0.1, period=0.01, duration=5.0), "ekf", N)
    env.reset(seed=0)
    errors = []
    for action in actions(400):
        *_, info = env.step(action)
        errors.append(np.abs(info["x_hat"] - info["x"]).max())
    assert max(errors[200:]) < 0.1 < errors[0]
    y, unknown = np.ones((N, 1)), np.full((N, 2), np.nan)  # states, at which they are not to look
    filters, rows = kalman_filters(env.unwrapped), np.array([True, False, False])
    filters.reset(y, unknown)
    first = filters.report()["x_hat"]
    filters.advance(-y, np.zeros((N, 1)))
    assert (filters.report()["x_hat"] != first).any(1).all()
    filters.restart(y[:1], rows, unknown[:1])
    assert ((filters.report()["x_hat"] == first).all(1) == rows).all()


def test_rows_that_have_ended_stay_as_they_are():
    env = make(TASK, "stacked", N, autoreset_mode="Disabled")
    env.reset(seed=0)
    for action in actions(TASK.steps):
        obs, _, _, truncated, _ = env.step(action)
    assert truncated.all()
    assert (env.step(actions(1)[0])[0] == obs).all()
    again, _ = env.reset(options={"reset_mask": [True, False, False]})
    assert (again[1:] == obs[1:]).all()
    assert (again[0] != obs[0]).any()
    moved = env.step(actions(1)[0])[0]
    assert (moved[1:] == obs[1:]).all()
    assert (moved[0] != again[0]).any()


def test_wrong_uses():
    with pytest.raises(ValueError, match="no observer ships for 'oscillator'"):
        observer_of(Oscillator())
    with pytest.raises(ValueError, match="unknown information 'everything'"):
        make(TASK, "everything", N)
    with pytest.raises(ValueError, match="resets in the same step"):
        Features(TASK.make(N, autoreset_mode="NextStep"), ["x"], feature=lambda info: info["x"], width=2)
