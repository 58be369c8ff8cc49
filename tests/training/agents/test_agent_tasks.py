"""Tasks of agents, and their observations."""

from dataclasses import replace

import linear_system
import numpy as np
import pytest
from linear_system import Oscillator

from kkl_gym import get_system
from observers import load
from training.agents.cost import MAX_COST, paid
from training.agents.environments import single
from training.agents.information import INFORMATION, make, observer_of, output_deviation
from training.agents.tasks import HIDDEN_VELOCITIES, TASKS, Task, control_task, get_task

N = 3
PENDULUM, CART = HIDDEN_VELOCITIES["Pendulum-v1"], HIDDEN_VELOCITIES["CartPole-v1"]
NOISY = replace(PENDULUM, measurement_noise=0.3)
VAN_DER_POL = control_task("van_der_pol", 0.2, period=0.02, duration=0.2)


def make_with_observer(task, information, n=N):
    observed = task.system is not None and information in ("x_hat", "x_hat_std", "z")
    return make(task, information, n, observer="van_der_pol" if observed else None)


def actions(env, steps, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(steps)]


CASES = [(VAN_DER_POL, information) for information in INFORMATION]
CASES += [(CART, information) for information in INFORMATION if not information.startswith("x_hat")]


@pytest.mark.parametrize(("task", "information"), CASES)
def test_last_observations_of_episodes_and_first_ones_of_the_next(task, information):
    """Compare with the same environment with longer episodes; observations are scaled to about one."""
    steps = 10
    longer = replace(task, env_kwargs={**task.env_kwargs, "max_episode_steps": 400 if task.system else 50})
    short = replace(task, env_kwargs={**task.env_kwargs, "max_episode_steps": steps * task.repeat})
    ours, other = (make_with_observer(each, information) for each in (short, longer))
    first, _ = ours.reset(seed=1)
    assert (first == other.reset(seed=1)[0]).all()
    calm = np.zeros((N, 1), np.float32) if task.system else np.array([0, 1, 0])
    for k in range(steps):
        action = calm if task.system else (calm + k) % 2  # keeps the pole upright for these steps
        obs, reward, terminated, truncated, info = ours.step(action)
        expected, expected_reward, *_ = other.step(action)
        assert (reward == expected_reward).all()
        assert obs in ours.observation_space
        assert obs.dtype == np.float32
        if k < steps - 1:
            assert (obs == expected).all()
    assert truncated.all()
    assert not terminated.any()
    assert all((info["final_obs"][row] == expected[row]).all() for row in range(N))
    assert obs.shape == first.shape
    if information == "stacked":  # all frames are the first observation
        assert np.ptp(obs.reshape(N, task.frames, -1), axis=1).max() == 0
    assert 0.01 < np.sqrt(np.square(first).mean()) < 5


def test_states_and_outputs_are_taken_from_the_target_over_the_scale():
    system = get_system("lorenz")
    task = control_task("lorenz", period=0.01, duration=1.0)
    for information, key in (("state", "x"), ("x_hat", "x_hat")):
        env = make(task, information, N, observer="lorenz" if information == "x_hat" else None)
        obs, info = env.reset(seed=0)
        assert np.allclose(obs, (info[key] - system.target) / system.scale, atol=1e-6)
    obs, info = make(task, "y", N).reset(seed=0)
    assert np.allclose(obs, (info["y"] - system.target[1]) / system.scale[1], atol=1e-6)
    assert output_deviation(system)({"y": np.array([[system.target[1]]])}).tolist() == [[0.0]]


def test_error_bars_are_shown_as_logarithms():
    env = make(VAN_DER_POL, "x_hat_std", N, observer="van_der_pol")
    env.reset(seed=0)
    obs, *_, info = env.step(np.zeros((N, 1)))
    sigma = np.sqrt(np.diagonal(info["x_cov"], axis1=1, axis2=2)) / get_system("van_der_pol").scale
    np.testing.assert_allclose(obs[:, 2:], np.log10(np.maximum(sigma, 1e-6)), rtol=1e-5)


def test_z_is_the_whitened_filter_state_relative_to_the_target():
    env = make(VAN_DER_POL, "z", N, observer="van_der_pol")
    env.reset(seed=0)
    for action in actions(env, 5):
        obs, *_, info = env.step(action)
    observer = load(observer_of(get_system("van_der_pol")), 0.2)
    inverse = observer.artifact.inverse
    at_target = observer.artifact.filter.start(np.zeros((N, 1)))
    whitened = (info["z"] - at_target) @ (inverse.gain(0.2)[:, None] * inverse.whiten).T
    assert np.allclose(obs[:, :-1], whitened, atol=1e-4)
    assert np.allclose(obs[:, -1], inverse.age_feature(np.full(N, 0.1)))


@pytest.mark.parametrize("task", [PENDULUM, replace(CART, past_actions=False)])
def test_stacks_and_traces_by_hand(task):
    task = replace(task, frames=4, time_constants=(1.0, 3.0))
    plain, stacked, traces = (make(task, kind, 2) for kind in ("y", "stacked", "traces"))
    seen, decay = [], np.exp(-1 / np.array([1.0, 3.0]))[:, None, None]
    y, shown, traced = (env.reset(seed=0)[0] for env in (plain, stacked, traces))
    nu = 1 if task.past_actions else 0
    trace = np.tile(np.concatenate([y, np.zeros((2, nu))], axis=1), (2, 1, 1))
    for k, action in enumerate([None, *actions(plain, 8)]):
        if k:
            (y, *_), (shown, *_), (traced, *_) = (env.step(action) for env in (plain, stacked, traces))
        u = action / 2 if k and nu else np.zeros((2, nu))  # torques are within ±2
        seen.append(np.concatenate([y, u], axis=1))
        trace = decay * trace + (1 - decay) * seen[-1] if k else trace
        rows = [*[seen[0]] * (4 - len(seen)), *seen[-4:]]
        np.testing.assert_allclose(shown, np.concatenate(rows, axis=1), rtol=1e-5)
        np.testing.assert_allclose(traced, np.concatenate([*trace, seen[-1]], axis=1), rtol=1e-5, atol=1e-6)


def test_noise_is_added_to_measured_entries_and_does_not_change_episodes():
    clean, noisy = single(PENDULUM), single(NOISY)
    apart = []
    for seed in range(3):
        for env in (clean, noisy):
            env.reset(seed=seed)
        for _ in range(200):
            here, there = (env.step(np.array([0.5], dtype=np.float32))[0] for env in (clean, noisy))
            apart.append(there - here)
    spread = np.std(apart, axis=0)
    np.testing.assert_allclose(spread[:2], 0.3, rtol=0.1)
    assert spread[2] == 0
    assert abs(np.corrcoef(np.array(apart)[:, :2].T)[0, 1]) < 0.15
    np.testing.assert_array_equal(*(single(NOISY).reset(seed=4)[0] for _ in range(2)))
    np.testing.assert_array_equal(make(NOISY, "state", 1).reset(seed=1)[0][0], single(PENDULUM).reset(seed=1)[0])


def test_rewards_are_minus_the_cost_and_escaping_has_no_advantage():
    """An action has five samples with rewards 1 / (1 + 4 c); the state escapes in the second of the third action."""
    task, cost = control_task("rossler", period=0.05, duration=20.0), np.array([0.0, 0.3, 2 * MAX_COST])
    total = task.repeat / (1 + 4 * cost)
    np.testing.assert_allclose(paid(task, total, 15, False), [0.0, -0.3, -MAX_COST], atol=1e-12)
    escaped = paid(task, 0.4 * total, 12, True)
    np.testing.assert_allclose(escaped, np.array([0.0, -0.3, -MAX_COST]) * (1 + task.steps - 3), atol=1e-9)


def test_a_system_is_named_in_three_ways():
    assert get_task("Lorenz") == get_task("KKLLorenz-v0") == TASKS["lorenz"]
    own = get_task(f"{linear_system.__file__}:TwoOutputs", frames=2, env_kwargs={"process_noise": 0.0})
    assert (own.name, own.measurement_noise, own.frames) == ("two-outputs", (0.1, 0.3), 2)
    assert own.env_kwargs["process_noise"] == 0.0
    assert get_task("lorenz", 2.0).measurement_noise == 2.0
    assert get_task("CartPole-v1", 0.1) == replace(CART, measurement_noise=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"measured": ()}, "measured must name"),
        ({"measured": (0, 0)}, "each once"),
        ({"measurement_noise": np.nan}, "from 0 on"),
        ({"time_constants": (2.0, 1.0)}, "must rise"),
        ({"angles": ((0, 1, 2),)}, "angles must be a cosine and a sine"),
        ({"repeat": 2}, "only environments of systems repeat actions"),
        ({"env_kwargs": {"g": PENDULUM}}, "env_kwargs must be JSON"),
    ],
)
def test_invalid_tasks_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Task(**{"env_id": "Pendulum-v1", "measured": (0,), **arguments})


def test_errors_name_missing_entries_and_observers():
    with pytest.raises(ValueError, match=r"no entry 7 .* 0 to 2"):
        single(Task("Pendulum-v1", (7,)))
    with pytest.raises(ValueError, match="needs an observer"):
        make(PENDULUM, "x_hat", 1)
    with pytest.raises(ValueError, match="no use for the observer"):
        make(PENDULUM, "y", 1, observer="van_der_pol")
    with pytest.raises(ValueError, match="name the measured entries of Acrobot-v1"):
        get_task("Acrobot-v1")
    with pytest.raises(ValueError, match="measured: only for environments; the system lorenz measures y"):
        get_task("lorenz", measured=(0,))
    with pytest.raises(ValueError, match="no observer ships for 'oscillator'"):
        observer_of(Oscillator())
