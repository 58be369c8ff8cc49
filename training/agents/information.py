"""What an agent may know: the information sets that are compared, as vector environments of normalised observations."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from kkl_gym import KKLVectorObservation, get_system
from kkl_gym.system import System
from kkl_gym.vector import with_mask
from kkl_gym.wrappers.estimator import Estimates
from kkl_gym.wrappers.vector import VectorEnv, VectorEstimate, VectorWrapper, column, plant_of
from observers import KKLObserver, load, shipped
from observers.factors import standard_deviations
from training.agents.tasks import ControlTask, deviation
from training.kalman import ExtendedKalmanFilter, measurement_covariance
from training.trajectories.equations import linearised

Information = Literal["state", "x_hat", "x_hat_std", "z", "y", "stacked", "ekf"]
INFORMATION: tuple[Information, ...] = get_args(Information)
OBSERVED = ("x_hat", "x_hat_std", "z")  # what a learned observer tells
STACKED = 8  # outputs, each with the action before it
# Standard deviation in multiples of a state's scale, below which agents see no difference. Files of agents rely on it.
SUREST = 1e-6
EKF_PROCESS_NOISE = 1e-2  # in multiples of each state's scale per square root of a second of its pace

Infos = dict[str, Any]
Feature = Callable[[Mapping[str, np.ndarray]], np.ndarray]


class Features(VectorWrapper):
    """Shows features of what ``info`` holds, float32, optionally of several steps with the actions that led to them."""

    def __init__(
        self,
        env: VectorEnv,
        keys: Sequence[str],
        *,
        feature: Feature,
        width: int,
        stacked: int = 1,
        with_action: bool = False,
    ) -> None:
        super().__init__(env)
        if env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
            raise ValueError("Features needs an environment that resets in the same step or not at all")
        self._keys, self._feature, self._stacked = tuple(keys), feature, stacked
        (nu,) = env.single_action_space.shape or (0,)
        self._taken = nu if with_action else 0
        width = stacked * (width + self._taken)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._history = np.empty((env.num_envs, stacked, 0))
        self._still = np.zeros(env.num_envs, dtype=bool)  # rows whose episodes have ended, where nobody resets them

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Reset the environments and what is remembered of them; returns (n, stacked * (width + actions))."""
        options, mask = with_mask(options, self.num_envs)
        _, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        first = self._first(info)
        self._history = first if mask.all() else np.where(mask[:, None, None], first, self._history)
        self._still = self._still & ~mask
        return self._shown(), info

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Step the environments. Shapes: ``actions`` (n, nu)."""
        _, reward, terminated, truncated, info = self.env.step(actions)
        values = {key: info[key] for key in self._keys}
        ended = info.get("_final_info", np.zeros(self.num_envs, dtype=bool))
        if ended.any():
            for key, value in values.items():
                values[key] = np.where(column(ended, value), info["final_info"][key], value)
        taken = np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)[:, : self._taken]
        latest = np.concatenate([self._feature(values), taken], axis=1)
        history = np.concatenate([self._history[:, 1:], latest[:, None]], axis=1)
        self._history = np.where(self._still[:, None, None], self._history, history)
        if ended.any():
            last = self._shown()
            for row in np.flatnonzero(ended):
                info["final_obs"][row] = last[row].copy()
            self._history[ended] = self._first({key: info[key][ended] for key in self._keys})
        else:
            self._still = terminated | truncated
        return self._shown(), reward, terminated, truncated, info

    def _first(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        feature = self._feature(values)
        one = np.concatenate([feature, np.zeros((len(feature), self._taken))], axis=1)
        return np.repeat(one[:, None], self._stacked, axis=1)

    def _shown(self) -> np.ndarray:
        return self._history.reshape(self.num_envs, -1).astype(np.float32)


def kalman_filters(env: VectorEnv) -> Estimates:
    """Extended Kalman filters that know model, noise level and input, as VectorEstimate drives them."""
    plant = plant_of(env)
    system = plant.system
    Q = np.diag((EKF_PROCESS_NOISE * np.array(system.scale)) ** 2 / system.pace)
    R = measurement_covariance(system, plant.measurement_noise)
    return Estimates(ExtendedKalmanFilter(system, plant.dt, Q=Q, R=R), plant.state_space)


def make(
    task: ControlTask,
    information: Information,
    num_envs: int,
    *,
    autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    observer: str | None = None,
    with_action: bool = False,
) -> Features:
    """Make a task in which the agent knows what ``information`` says, in units of about one, taken from the target."""
    if information not in INFORMATION:
        raise ValueError(f"unknown information {information!r}; there are {', '.join(INFORMATION)}")
    system = get_system(task.system)

    def of(key: str) -> Feature:
        return lambda info: deviation(system, info[key])

    if information == "state":
        env = task.make(num_envs, None, autoreset_mode)
        return Features(env, ["x"], feature=of("x"), width=system.nx, with_action=with_action)
    if information in ("y", "stacked"):
        stacked = STACKED if information == "stacked" else 1
        env = task.make(num_envs, None, autoreset_mode)
        return Features(
            env,
            ["y"],
            feature=output_deviation(system),
            width=system.ny,
            stacked=stacked,
            with_action=with_action or stacked > 1,
        )
    if information == "ekf":
        env = task.make(num_envs, lambda env: VectorEstimate(env, kalman_filters(env)), autoreset_mode)
        return Features(env, ["x_hat"], feature=of("x_hat"), width=system.nx)
    observer = observer or observer_of(system)
    if load(observer).artifact.nx > system.nx:
        raise ValueError(f"the observer {observer} estimates a bias too, which agents do not know; take one without")
    if information == "x_hat":
        env = task.make(num_envs, partial(KKLVectorObservation, observer=observer), autoreset_mode)
        return Features(env, ["x_hat"], feature=of("x_hat"), width=system.nx)
    if information == "x_hat_std":
        env = task.make(num_envs, partial(KKLVectorObservation, observer=observer, uncertainty=True), autoreset_mode)
        return Features(env, ["x_hat", "x_cov"], feature=estimate_and_spread(system), width=2 * system.nx)
    env = task.make(num_envs, partial(KKLVectorObservation, observer=observer, estimate="z"), autoreset_mode)
    feature, width = modes(load(observer, task.measurement_noise), system)
    return Features(env, ["z", "sample"], feature=feature, width=width)


def observer_of(system: System) -> str:
    """Name of the shipped map of a system."""
    if system.name not in shipped():
        raise ValueError(f"no observer ships for {system.name!r}: name a .safetensors file (--observer FILE)")
    return system.name


def estimate_and_spread(system: System) -> Feature:
    """Make the feature of an estimate from the target, and of its standard deviations, both in units of the scale.

    Standard deviations differ by orders of magnitude in the course of an episode, so that their logarithms are shown.
    """
    scale = np.array(system.scale)

    def feature(info: Mapping[str, np.ndarray]) -> np.ndarray:
        sizes = np.log10(np.maximum(standard_deviations(info["x_cov"]) / scale, SUREST))
        return np.concatenate([deviation(system, info["x_hat"]), sizes], axis=1)

    return feature


def output_deviation(system: System) -> Feature:
    """Make the feature (y - h(target)) over the size that the states' scales give to y, to first order."""
    _, _, C = linearised(system, system.target)
    y, size = np.array(system.h(system.target)), np.abs(C) @ np.array(system.scale)
    size = np.where(size > 0, size, 1.0)  # an output that is flat at the target
    return lambda info: (info["y"] - y) / size


def modes(observer: KKLObserver, system: System) -> tuple[Feature, int]:
    """Make the feature of z as the observer's network sees it, but from its value at the target, and of the age."""
    inverse, linear = observer.artifact.inverse, observer.artifact.filter
    matrix = (inverse.gain(observer.measurement_noise)[:, None] * inverse.whiten).T
    rest = linear.start(np.array(system.h(system.target), dtype=float))

    def feature(info: Mapping[str, np.ndarray]) -> np.ndarray:
        shown: np.ndarray = (info["z"] - rest) @ matrix
        if inverse.features[-1] != "age":
            return shown
        return np.column_stack([shown, inverse.age_feature(info["sample"] * linear.dt)])

    return feature, matrix.shape[1] + (inverse.features[-1] == "age")
