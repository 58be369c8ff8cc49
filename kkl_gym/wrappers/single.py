"""Wrappers: a learned observer inside the environment, and an agent that acts more slowly than it samples."""

import os
from collections import deque
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from kkl_gym.envs import TRAIL, KKLEnv
from kkl_gym.wrappers.estimator import KKLEstimator, observation


class KKLObservation(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Shows a learned observer's estimate in place of the state.

    The observer sees only ``info["y"]`` and the input ``info["u"]`` that the environment applied. ``info`` gains
    ``x_hat`` (nx,) and ``z``, the filter's state, both float64, and with ``monitor`` ``score``, above 1 where the
    samples do not fit the estimates (a faulty sensor, states that the map was not made for).

    Parameters
    ----------
    env : a :class:`KKLEnv`, bare or under wrappers that leave ``info`` alone.
    observer : a shipped name, or a path if it ends in ``.safetensors``; None takes the map shipped for the
        environment's system.
    estimate : "x" shows the state estimate, clipped to the system's declared bounds; "z" the filter's state
        [z_y, z_u], within the bounds that bounded outputs and inputs imply.
    measurement_noise : the noise level that the observer assumes; None takes the environment's. (Process noise is
        taken from the environment always, by maps that ask for it.)
    ignore_input : use a map that knows no inputs (the paper's) although the agent acts.
    monitor : whether to keep the score, see :attr:`observers.KKLObserver.score`.

    Raises
    ------
    ValueError : (ArtifactError where the file is at fault) if the observer does not exist, was made for another
        system, other parameters, another dt, or not for this noise level; or, at a step, if the agent acts on a map
        that knows no inputs and ``ignore_input`` is false, or a wrapper inside hides samples from the observer.
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, np.ndarray],
        observer: str | os.PathLike[str] | None = None,
        *,
        estimate: Literal["x", "z"] = "x",
        measurement_noise: float | None = None,
        ignore_input: bool = False,
        monitor: bool = False,
    ) -> None:
        observer = None if observer is None else os.fspath(observer)
        RecordConstructorArgs.__init__(
            self,
            observer=observer,
            estimate=estimate,
            measurement_noise=measurement_noise,
            ignore_input=ignore_input,
            monitor=monitor,
        )
        gym.Wrapper.__init__(self, env)
        base = env.unwrapped
        if not isinstance(base, KKLEnv):
            raise ValueError(f"KKLObservation needs a kkl_gym environment, got {base}")
        self._estimator = KKLEstimator(
            base.plant,
            observer,
            estimate=estimate,
            measurement_noise=measurement_noise,
            ignore_input=ignore_input,
            monitor=monitor,
        )
        self.observer = self._estimator.observer
        self.estimate = estimate
        self._monitor = monitor
        self._trail: deque[list[float]] = deque(maxlen=TRAIL)  # of estimates
        self.observation_space = self._estimator.space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment, and the observer to its first sample."""
        _, info = self.env.reset(seed=seed, options=options)
        self._sample = info["sample"]
        self._trail.clear()
        return self._show(self.observer.reset(info["y"]), info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the environment, and the observer with the new sample and the input that led to it."""
        _, reward, terminated, truncated, info = self.env.step(action)
        if info["sample"] != self._sample + 1:
            raise ValueError(
                f"the observer was to see sample {self._sample + 1} and was shown sample {info['sample']}: put "
                "wrappers that skip steps or reset by themselves, such as ActionRepeat, outside KKLObservation, and "
                "reset after an error"
            )
        x_hat = self.observer.step(info["y"], self._estimator.known(info["u"]))
        self._sample += 1
        return self._show(x_hat, info), float(reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The phase portrait with state and estimate as an RGB image, or None without ``render_mode``."""
        base: KKLEnv = self.unwrapped  # type: ignore[assignment]
        return base.draw(self._trail)

    def _show(self, x_hat: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        z = self.observer.z
        info["x_hat"], info["z"] = x_hat, z
        if self._monitor:
            info["score"] = float(self.observer.score)
        if self.render_mode is not None:
            self._trail.append(x_hat.tolist())
        return observation(self._estimator.shown(info), self._estimator.space)


class ActionRepeat(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Holds each action for ``repeat`` steps and sums their rewards; put it outside :class:`KKLObservation`.

    The observer then sees every sample while the agent acts more slowly. Stops early where the episode ends.
    Raises ValueError unless ``repeat`` is a positive integer.
    """

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], repeat: int) -> None:
        RecordConstructorArgs.__init__(self, repeat=repeat)
        gym.Wrapper.__init__(self, env)
        if not isinstance(repeat, int) or isinstance(repeat, bool) or repeat < 1:
            raise ValueError(f"repeat must be a positive integer, got {repeat!r}")
        self.repeat = repeat

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply ``action`` for ``repeat`` steps; the observation and info are those of the last one."""
        total = 0.0
        for _ in range(self.repeat):
            obs, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return obs, total, terminated, truncated, info


__all__ = ["ActionRepeat", "KKLObservation"]
