"""Agents learn with a memory from Dict observations: the state with a goal or with an image."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from kkl_gym import KKLMemory

pytestmark = pytest.mark.slow
DT = 0.2


class Mass(gym.Env):
    """A mass on a line, pushed to a goal; its position is measured, its velocity is hidden."""

    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, image=False):
        line = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        beside = {"image": spaces.Box(0, 255, (1, 36, 36), np.uint8)} if image else dict.fromkeys(GOALS, line)
        self.observation_space = spaces.Dict({"observation": line} | beside)
        self._image = image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.goal, self.k = np.array([self.np_random.uniform(-1, 1), 0.0]), self.np_random.uniform(-1, 1), 0
        return self._seen(), {}

    def step(self, action):
        self.x += DT * np.array([self.x[1], float(action[0])])
        self.k += 1
        seen, late = self._seen(), self.k == 40
        if self._image:
            return seen, -abs(self.x[0] - self.goal), False, late, {}
        return seen, float(self.compute_reward(self.x[:1], self.goal, {})[0]), False, late, {}

    def compute_reward(self, achieved, desired, info):
        return -(np.abs(achieved - desired) > 0.15).astype(np.float32).reshape(-1)

    def _seen(self):
        place, goal = np.float32(self.x[:1]), np.float32([self.goal])
        if not self._image:
            return {"observation": place, "achieved_goal": place, "desired_goal": goal}
        image = np.zeros((1, 36, 36), np.uint8)
        image[..., : round(18 * (1 + self.goal))] = 255  # a bar whose end is at the goal
        return {"observation": place, "image": image}


GOALS = ("achieved_goal", "desired_goal")


def play(agent, env, episodes=50):
    """Mean return, and mean distance to the goal in the last quarter of an episode."""
    returns, distances = 0.0, []
    for seed in range(episodes):
        obs, ended = env.reset(seed=1000 + seed)[0], False
        while not ended:
            obs, reward, _, ended, _ = env.step(agent.predict(obs, deterministic=True)[0])
            returns += reward / episodes
            if env.unwrapped.k > 30:
                distances.append(abs(env.unwrapped.x[0] - env.unwrapped.goal))
    return returns, float(np.mean(distances))


def test_hindsight_replay_learns_a_goal_with_a_memory():
    sb3 = pytest.importorskip("stable_baselines3")
    env = KKLMemory(Mass(), measured=["observation", *GOALS])
    assert set(env.observation_space) == {"observation", "memory", *GOALS}
    how = {"learning_starts": 400, "gamma": 0.95, "learning_rate": 2e-3, "policy_kwargs": {"net_arch": [64, 64]}}
    replay = {"replay_buffer_class": sb3.HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 4}}
    agent = sb3.SAC("MultiInputPolicy", env, seed=0, device="cpu", **how, **replay).learn(6_000)
    returns, distance = play(agent, env)
    print(f"HER: return {returns:.1f}, distance {distance:.3f}")
    assert distance < 0.2


def test_ppo_learns_from_an_image_and_a_memory():
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env(lambda: KKLMemory(Mass(image=True)), 8, seed=0)
    how = {"features_extractor_kwargs": {"cnn_output_dim": 8}, "net_arch": [64, 64]}
    agent = sb3.PPO("MultiInputPolicy", envs, n_steps=80, batch_size=160, gamma=0.9, learning_rate=1e-3, seed=0,
                    policy_kwargs=how, device="cpu").learn(40_000)  # fmt: skip
    returns, distance = play(agent, KKLMemory(Mass(image=True)))
    print(f"PPO: return {returns:.1f}, distance {distance:.3f}")
    assert distance < 0.2
