"""Rewards and terminations that a system defines."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from alike_vectors import compare
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from kkl_gym import ActionRepeat, EquationError, KKLEnv, KKLVectorEnv, System
from kkl_gym.elementary import where


class Cart(System):
    """A cart whose episode ends successfully at 1; below -3 it is lost."""

    name = "cart"
    X, bounds, u_max, G = ((-1.0, 0.5), (-1.0, 1.0)), ((-3.0, 9.0), (-9.0, 9.0)), (2.0,), ((0.0,), (1.0,))
    dt = 0.05
    target = (0.7, 0.0)

    def f(self, x):
        return x[1], -x[1]

    def h(self, x):
        return (x[0],)

    def reward(self, x, u):
        return -abs(x[0] - self.target[0]) - 0.1 * u[0] * u[0] + where(self.terminated(x), 5.0, 0.0)

    def terminated(self, x):
        return x[0] > 1.0


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("n", [4, 128])
def test_rows_are_single_environments(mode, n):
    actions = np.clip(np.random.default_rng(0).normal(0.3, 1.0, (90, n, 1)), -1, 1).astype(np.float32)
    ours = KKLVectorEnv(Cart(), n, max_episode_steps=50, autoreset_mode=mode)
    single = partial(gym.make, "kkl_gym:kkl_gym/Own-v0", system=Cart(), max_episode_steps=50)
    ends = compare(ours, SyncVectorEnv([single] * n, autoreset_mode=mode), actions, mode)
    assert len({k for k, _ in ends}) > 2


@pytest.mark.parametrize("action", [1.0, -1.0])
def test_reward_and_end(action):
    env = KKLEnv(Cart(), process_noise=0.0)
    check_env(env, skip_render_check=True)
    env.reset(seed=0, options={"x0": [0.0, 0.0]})
    terminated = False
    while not terminated:
        _, reward, terminated, _, info = env.step(np.array([action]))
        x = info["x"][0]
        assert reward == pytest.approx(-abs(x - 0.7) - 0.4 + 5.0 * (x > 1.0))
        assert terminated == (x > 1.0 or info["escaped"])
    assert info["escaped"] == (action < 0)
    repeated = ActionRepeat(KKLEnv(Cart(), process_noise=0.0), 100)
    repeated.reset(seed=0, options={"x0": [0.0, 0.0]})
    assert repeated.step(np.array([action]))[2]


def changed(**methods):
    return type("Changed", (Cart,), {"name": "changed", **methods})()


@pytest.mark.parametrize(
    ("methods", "match"),
    [
        ({"reward": lambda self, x, u: -x[0] if x[0] > 0 else 0.0}, r"reward\(x, u\) of 'changed' .*elementary.where"),
        ({"reward": lambda self, x, u: (x[0],)}, r"reward\(x, u\) of 'changed' .* must return one number for each"),
        ({"reward": lambda self, x: x[0]}, r"must be defined as reward\(self, x, u\)"),
        ({"terminated": lambda self, x: x[0]}, r"terminated\(x\) of 'changed' .* must return a bool or a comparison"),
        ({"terminated": lambda self, x: None}, r"terminated\(x\) of 'changed' .* must return a bool or a comparison"),
        ({"reward": System.reward, "terminated": lambda self, x: np.any(np.abs(x) > 0.5)}, r"terminated\(x\) .* batch"),
        ({"terminated": lambda self, x: max(x) > 1}, r"terminated\(x\) of 'changed' .* use kkl_gym.elementary.maximum"),
    ],
)
def test_mistakes_are_named(methods, match):
    with pytest.raises(EquationError, match=match):
        KKLEnv(changed(**methods))


@pytest.mark.parametrize("make", [KKLEnv, partial(KKLVectorEnv, num_envs=2)])
def test_a_reward_that_is_not_finite_is_refused(make):
    env = make(changed(reward=lambda self, x, u: where(x[0] > 0.6, np.inf, 0.0)))
    env.reset(options={"x0": [0.5, 1.0]})
    while env.step(np.ones(env.action_space.shape))[-1]["x"].max() < 0.55:
        pass
    with pytest.raises(EquationError, match=r"reward\(x, u\) of 'changed' .* must return finite numbers; .*inf"):
        [env.step(np.ones(env.action_space.shape)) for _ in range(3)]
