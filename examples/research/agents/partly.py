"""An environment with one of five kinds of partial observability; it shows the sensor's outputs and the state."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

ENV_ID = "KKLPartly-v0"
# Velocities are hidden in every kind.
KINDS: dict[str, dict[str, Any]] = {
    "masked": {},
    "noise": {"noise": 0.1},
    "delay": {"delay": 5},
    "drop-out": {"drop_out": 0.3},
    "parameters": {"vary": True},
}
MEASURED = {"Pendulum-v1": [0, 1], "CartPole-v1": [0, 2], "InvertedDoublePendulum-v5": [0, 1, 2, 3, 4]}
ANGLES = {"Pendulum-v1": ((0, 1),), "InvertedDoublePendulum-v5": ((3, 1), (4, 2))}  # indices in y of (cosine, sine)
# Each episode multiplies each parameter by its own log-uniform number between 1/f and f, where f is given here.
FACTORS: dict[str, dict[str, float]] = {
    "Pendulum-v1": {"m": 1.3, "l": 1.3},
    "CartPole-v1": {"masspole": 2.0, "length": 2.0, "force_mag": 2.0},
}


class Partly(gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """Shows [y, state]: the outputs of a faulty sensor, then the whole observation and the parameters' factors.

    With ``hold``, the last sample that arrived replaces a lost one. Without it, a lost sample is NaN.
    """

    def __init__(
        self,
        env_id: str,
        *,
        noise: float = 0.0,
        delay: int = 0,
        drop_out: float = 0.0,
        vary: bool = False,
        hold: bool = True,
    ) -> None:
        super().__init__(gym.make(env_id))
        if vary and env_id not in FACTORS:
            raise ValueError(f"{env_id} has no parameters to vary; {', '.join(FACTORS)} have some")
        self._noise, self._drop_out, self._hold = noise, drop_out, hold
        self._measured, self._late = list(MEASURED[env_id]), deque[np.ndarray](maxlen=delay + 1)
        self._factors: Mapping[str, float] = FACTORS[env_id] if vary else {}
        self._nominal = {name: getattr(self.env.unwrapped, name) for name in self._factors}
        self._parameters, self._rng = np.ones(len(self._factors)), np.random.default_rng()
        size = len(self._measured) + gym.spaces.flatdim(self.env.observation_space) + len(self._factors)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def exact(self) -> None:
        """Remove the sensor's faults, for the simulator in which an observer is learned."""
        self._noise, self._drop_out, self._late = 0.0, 0.0, deque(maxlen=1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode, with new parameters if they vary; its first sample is never late or lost."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])
        if self._factors:
            self._draw_parameters()
        obs, info = self.env.reset(seed=seed, options=options)
        y = self._sample(obs)
        self._late.extend([y] * (self._late.maxlen or 1))
        self._held = y
        return np.concatenate([y, obs, self._parameters]).astype(np.float32), info

    def step(self, action: Any) -> Any:
        """Step the environment and read the sensor."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        y, lost = self._sample(obs), self._rng.random() < self._drop_out
        self._late.append(np.full_like(y, np.nan) if lost else y)
        y = self._late[0]
        if self._hold:
            self._held = y = np.where(np.isnan(y), self._held, y)
        return np.concatenate([y, obs, self._parameters]).astype(np.float32), reward, terminated, truncated, info

    def _sample(self, obs: np.ndarray) -> np.ndarray:
        return np.asarray(obs[self._measured] + self._noise * self._rng.standard_normal(len(self._measured)))

    def _draw_parameters(self) -> None:
        base: Any = self.env.unwrapped
        self._parameters = np.array([factor ** self._rng.uniform(-1, 1) for factor in self._factors.values()])
        for name, factor in zip(self._factors, self._parameters, strict=True):
            setattr(base, name, self._nominal[name] * factor)
        if hasattr(base, "polemass_length"):  # CartPole derives these from its parameters
            base.total_mass, base.polemass_length = base.masspole + base.masscart, base.masspole * base.length


gym.register(ENV_ID, f"{__name__}:Partly", disable_env_checker=True)
