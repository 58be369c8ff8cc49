"""Wrappers: a learned observer inside the environment, and an agent that acts more slowly than it samples."""

import os
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from kkl_gym.envs import KKLEnv
from observers import KKLObserver, load, shipped


class KKLObservation(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Shows a learned observer's estimate in place of the state.

    The observer sees only ``info["y"]`` and the input ``info["u"]`` that the environment applied. ``info`` gains
    ``x_hat`` (nx,) and ``z``, the filter's state, both float64.

    Parameters
    ----------
    env : a :class:`KKLEnv`, bare or under wrappers that leave ``info`` alone.
    observer : a shipped name, or a path if it ends in ``.safetensors``; None takes the map shipped for the
        environment's system.
    estimate : "x" shows the state estimate, clipped to the system's declared bounds; "z" the filter's state
        [z_y, z_u], within the bounds that bounded outputs and inputs imply.
    measurement_noise : the noise level that the observer assumes; None takes the environment's.
    ignore_input : use a map that knows no inputs (the paper's) although the agent acts.

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
        estimate: Literal["x", "z"] = "x",
        measurement_noise: float | None = None,
        ignore_input: bool = False,
    ) -> None:
        observer = None if observer is None else os.fspath(observer)
        RecordConstructorArgs.__init__(
            self,
            observer=observer,
            estimate=estimate,
            measurement_noise=measurement_noise,
            ignore_input=ignore_input,
        )
        gym.Wrapper.__init__(self, env)
        base = env.unwrapped
        if not isinstance(base, KKLEnv):
            raise ValueError(f"KKLObservation needs a kkl_gym environment, got {base}")
        if estimate not in ("x", "z"):
            raise ValueError(f'estimate must be "x" or "z", got {estimate!r}')
        system = base.system
        if observer is None and system.name not in shipped():
            raise ValueError(f"no map ships for {system.name!r}: train one and pass observer='….safetensors'")
        self.observer: KKLObserver = load(
            system.name if observer is None else observer,
            base.measurement_noise if measurement_noise is None else measurement_noise,
        )
        self.observer.artifact.check(system.name, system.parameters, base.dt, system.ny, system.nu)
        self.estimate = estimate
        self._blind = self.observer.artifact.nu == 0 and system.nu > 0
        self._ignore_input = ignore_input
        space = base.state_space if estimate == "x" else _filter_space(base, self.observer)
        self.observation_space = space
        self._low, self._high = space.low.astype(float), space.high.astype(float)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment, and the observer to its first sample."""
        _, info = self.env.reset(seed=seed, options=options)
        self._sample = info["sample"]
        return self._show(self.observer.reset(info["y"]), info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the environment, and the observer with the new sample and the input that led to it."""
        _, reward, terminated, truncated, info = self.env.step(action)
        self._sample += 1
        if info["sample"] != self._sample:
            raise ValueError(
                f"the observer was to see sample {self._sample} and was shown sample {info['sample']}: put wrappers "
                "that skip steps or reset by themselves, such as ActionRepeat, outside KKLObservation"
            )
        u = info["u"]
        if self._blind:
            if not self._ignore_input and u.any():
                raise ValueError(
                    f"the map {self.observer.artifact.system!r} in use knows no inputs, but the agent applied u = {u}; "
                    "use the default map, keep the action at 0, or pass ignore_input=True"
                )
            u = None
        return self._show(self.observer.step(info["y"], u), info), float(reward), terminated, truncated, info

    def _show(self, x_hat: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        z = self.observer.z
        info["x_hat"], info["z"] = x_hat, z
        shown = np.maximum(x_hat if self.estimate == "x" else z, self._low)
        out: np.ndarray = np.minimum(shown, self._high).astype(np.float32)
        return out


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


def _filter_space(env: KKLEnv, observer: KKLObserver) -> gym.spaces.Box:
    """Bounds of the filter's state under outputs within the output space and inputs within their bounds.

    Each is the response to the worst signal, the L1 norm of its impulse response. The filter starts from where a
    constant output would have led, so that its start lies within as well.
    """
    linear = observer.artifact.filter
    y_max = np.maximum(np.abs(env.output_space.low), np.abs(env.output_space.high)).astype(float)
    driven = np.hstack([linear.early_y, linear.late_y, linear.held_u])
    limits = np.concatenate([y_max, y_max, env.system.u_max[: linear.nu]])
    forgetting = np.abs(np.linalg.eigvals(linear.transition)).max()
    bound = np.zeros(linear.size)
    for _ in range(int(np.ceil(np.log(1e-4) / np.log(forgetting)))):
        bound += np.abs(driven) @ limits
        driven = linear.transition @ driven
    bound = (1.001 * bound).astype(np.float32)  # for the tail of the sum
    return gym.spaces.Box(-bound, bound, dtype=np.float32)


__all__ = ["ActionRepeat", "KKLObservation"]
