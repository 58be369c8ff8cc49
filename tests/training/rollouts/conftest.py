"""An environment whose observations contain the last action, and an observer for it."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from rollout_observers import observer_of


class Spy(gym.Env):
    """Observations contain the last action; episodes end after seven steps."""

    observation_space = spaces.Box(-99.0, 99.0, (2,))
    action_space = spaces.Box(np.float32([-1.0]), np.float32([3.0]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.float32([self.np_random.uniform(50, 60), -50]), {}

    def step(self, action):
        self.steps += 1
        return np.float32([self.steps, action[0]]), 0.0, self.steps == 7, False, {}


@pytest.fixture
def register():
    """Register environments for the duration of a test."""
    names = []

    def registered(env_id, entry_point, **options):
        gym.register(env_id, entry_point=entry_point, disable_env_checker=True, **options)
        names.append(env_id)
        return env_id

    yield registered
    for name in names:
        gym.registry.pop(name)


@pytest.fixture
def spy(tmp_path, register):
    """Path of an observer for Spy-v0."""
    register("Spy-v0", Spy)
    training = {"pipeline": "input-aware", "eigenvalues": [-1.2, -2.4, -4.8], "dt": 1.0, "held_out": 0.5}
    rates = (1.2, 2.4, 4.8)  # the filter settles within an episode
    artifact = observer_of("Spy-v0", ["obs[0]"], ["obs[1]"], ["action[0]"], rates=rates)
    dataclasses.replace(artifact, training=training).save(tmp_path / "spy.safetensors")
    return tmp_path / "spy.safetensors"
