"""Environments of which a part is hidden, and what agents are shown of them."""

import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from training.agents.any_environment.information import Stacked, show
from training.agents.any_environment.task import HIDDEN_VELOCITIES, HiddenTask

PENDULUM = HIDDEN_VELOCITIES["Pendulum-v1"]
CART = HIDDEN_VELOCITIES["CartPole-v1"]
NOISY = replace(PENDULUM, measurement_noise=0.3)


def test_noise_lies_on_what_is_measured_and_leaves_episodes_as_they_are():
    clean, noisy = PENDULUM.make(), NOISY.make()
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
    np.testing.assert_array_equal(*(NOISY.make().reset(seed=4)[0] for _ in range(2)))
    np.testing.assert_array_equal(show(NOISY, "state").reset(seed=1)[0], PENDULUM.make().reset(seed=1)[0])


@pytest.mark.parametrize(
    ("task", "kind"),
    [
        (NOISY, "state"),
        (replace(CART, measurement_noise=0.1), "y"),
        (replace(PENDULUM, angles=((0, 1),)), "z"),
        (replace(PENDULUM, angles=((0, 1),)), "stacked"),
        (CART, "recurrent"),
    ],
)
def test_what_is_shown_passes_gymnasiums_checker(task, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about bounds that are infinite, and that the environment is wrapped
        check_env(show(task, kind), skip_render_check=True)


def test_stacked_observations_hold_actions_and_begin_with_the_first():
    env, plain = show(PENDULUM, "stacked"), show(PENDULUM, "y")
    first, _ = env.reset(seed=0)
    y0, _ = plain.reset(seed=0)
    np.testing.assert_array_equal(first.reshape(8, 3), np.tile([*y0, 0], (8, 1)))
    seen = [np.append(y0, 0)]
    for k in range(10):
        action = np.array([np.sin(k)], dtype=np.float32)
        shown = env.step(action)[0]
        seen.append(np.append(plain.step(action)[0], action / 2))  # of torques within ±2
        expected = [*[seen[0]] * (8 - len(seen)), *seen[-8:]]
        np.testing.assert_allclose(shown.reshape(8, 3), expected, rtol=1e-6)
    np.testing.assert_array_equal(show(PENDULUM, "recurrent").reset(seed=0)[0], [*y0, 0])


def test_a_task_says_what_memories_and_stacks_hold():
    task = replace(PENDULUM, time_constants=(1, 2), frames=4)
    assert show(task, "stacked").observation_space.shape == (4 * 3,)
    assert show(task, "z").observation_space.shape == (2 + 2 * 2 + 2,)
    z, stacked = (show(replace(CART, past_actions=False), kind) for kind in ("z", "stacked"))
    assert z.observation_space.shape == (2 + 2 * 4,)
    seen = [z.reset(seed=0)[0], *(z.step(action)[0] for action in (0, 1, 1))]
    shown = [stacked.reset(seed=0)[0], *(stacked.step(action)[0] for action in (0, 1, 1))]
    outputs = np.array(seen)[:, :2]
    np.testing.assert_array_equal(shown[-1].reshape(8, 2), [*[outputs[0]] * 4, *outputs])
    assert shown[-1] in stacked.observation_space


def test_agents_on_memories_and_stacks_can_be_told_of_angles():
    task = replace(PENDULUM, measured=(1, 0), angles=((0, 1),), frames=4)
    assert show(task, "z").observation_space.shape == (2 + 4 + 2,)
    env, plain = show(task, "stacked"), show(task, "y")
    (first, _), (y0, _) = env.reset(seed=0), plain.reset(seed=0)
    np.testing.assert_array_equal(first, np.float32([0, 0] * 3 + [*y0, 0]))
    turned, actions, rate = [0.0] * 4, [0.0] * 4, 0.0
    for _ in range(60):
        action = np.array([2.0 if rate >= 0 else -2.0], dtype=np.float32)  # which swings it all around
        shown = env.step(action)[0]
        y = plain.step(action)[0]
        rate = env.unwrapped.state[1]
        turned = [*turned[1:], turned[-1] + 0.05 * rate]  # Euler's, with the new rate
        actions = [*actions[1:], action[0] / 2]
        earlier = np.stack([actions[:3], turned[-1] - np.array(turned[:3])], axis=1).ravel()
        np.testing.assert_allclose(shown, [*earlier, *y, actions[-1]], atol=1e-5)
        assert shown in env.observation_space
    assert abs(turned[-1]) > 2 * np.pi


def test_stacks_of_angles_outlive_samples_without_one():
    class Blind(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (2,))
        action_space = gym.spaces.Box(-1, 1, (2,))
        seen = np.float32([1, 0])

        def reset(self, *, seed=None, options=None):
            return self.seen, {}

        def step(self, action):
            self.seen[:] = action  # a buffer that is filled again
            return self.seen, 0.0, False, False, {}

    env = Stacked(Blind(), 3, [(0, 1)], actions=False)
    env.reset()
    shown = [env.step(seen)[0] for seen in ([0, 0], [np.nan, 0], [0, 1], [-1, 0])]
    np.testing.assert_allclose(shown[2], [np.pi / 2, np.pi / 2, 0, 1], atol=1e-6)
    np.testing.assert_allclose(shown[3], [np.pi, np.pi / 2, -1, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"measured": ()}, "measured must name"),
        ({"measured": (0, 0)}, "each once"),
        ({"measured": (0.5,)}, "entry of measured"),
        ({"measurement_noise": np.nan}, "from 0 on"),
        ({"time_constants": (2.0, 1.0)}, "must rise"),
        ({"past_actions": "no"}, "past_actions must be"),
        ({"angles": ((0, 1),)}, r"of Pendulum-v1 that are measured, \(0,\), each once, got \(\(0, 1\),\)"),
        ({"measured": (0, 1), "angles": ((0, -1),)}, "a sine must be an integer, not negative, got -1"),
        ({"measured": (0, 1), "angles": (0, 1)}, "angles must be pairs of entries"),
        ({"frames": 10**9}, "frames must be"),
    ],
)
def test_a_task_that_makes_no_sense_is_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        HiddenTask("Pendulum-v1", **{"measured": (0,), **arguments})


def test_entries_and_environments_that_are_not_there_are_named():
    with pytest.raises(ValueError, match=r"no entry 7 .* 0 to 2"):
        HiddenTask("Pendulum-v1", (7,)).make()
    with pytest.raises(ValueError, match="cannot make 'Pendulam-v1'"):
        HiddenTask("Pendulam-v1", (0,)).make()
    with pytest.raises(ValueError, match="one of state"):
        show(PENDULUM, "nothing")
    with pytest.raises(ValueError, match="needs an observer"):
        show(PENDULUM, "x_hat")
