"""Wrappers that add a memory of filtered outputs and actions to any environment's observations, without training."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from kkl_gym.identity import check_autoreset, source_of
from kkl_gym.memory import Memory
from kkl_gym.prediction import PredictiveMemory
from kkl_gym.signals import Angles, Entries, Inputs, Outputs
from kkl_gym.vector import Infos, with_mask
from kkl_gym.wrappers.vector import Step, VectorEnv, VectorWrapper, autoreset_mode_in
from observers.checks import choice, integer, shown

Weights = Sequence[Sequence[float]] | np.ndarray


class _Remembering:
    """The memory within both wrappers, for one environment or a batch; it takes the arguments of the wrappers."""

    def __init__(
        self,
        env: Any,
        action_space: gym.Space[Any],
        observation_space: gym.Space[Any],
        measured: Entries | None,
        *,
        angles: Angles = (),
        period: float | None = None,
        missing: str = "error",
        weights: Weights | None = None,
        time_constants: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
        input_time_constants: Sequence[float] = (1.0, 4.0),
    ) -> None:
        source = source_of(env)
        self._hold = choice("missing", missing, ("error", "hold")) == "hold"
        self.outputs = Outputs(observation_space, measured, angles, period=period, source=source)
        self.inputs = Inputs(action_space, source=source)
        low, high = self.outputs.low, self.outputs.high
        sizes = (len(low), len(self.inputs.low), self.outputs.pairs)
        how: dict[str, Any] = {"time_constants": time_constants, "input_time_constants": input_time_constants}
        self.memory = Memory(*sizes, **how) if weights is None else PredictiveMemory(*sizes, weights, **how)
        # These are the checked arguments, in types that the environment's specification can store.
        self.arguments: dict[str, Any] = {
            "measured": self.outputs.measured,
            "angles": self.outputs.angles,
            "period": self.outputs.period,
            "missing": missing,
            "weights": self.memory.weights.tolist() if isinstance(self.memory, PredictiveMemory) else None,
            "time_constants": self.memory.time_constants,
            "input_time_constants": self.memory.input_time_constants,
        }
        unbounded, keys = np.full(self.memory.size - len(low), np.inf), self.outputs.keys
        if weights is not None:  # predictions of outputs may exceed the bounds of outputs
            high = np.where(np.isin(range(len(low)), self.outputs.pairs), 1.0, np.inf)
            low = -high
        low, high = np.append(low, -unbounded), np.append(high, unbounded)
        self._beside = [] if keys is None else [*self.outputs.unseen, *range(len(self.outputs.low), self.memory.size)]
        if keys is not None:
            if weights is not None or "memory" in keys:
                raise ValueError(
                    f"{source}: with weights or a key named memory, measured must hold indices, such as [0, 1]"
                )
            low, high = low[self._beside], high[self._beside]
        with np.errstate(over="ignore"):  # bounds beyond float32 become infinite
            flat = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.space: gym.Space[Any] = flat if keys is None else spaces.Dict(keys | {"memory": flat})

    def read(self, obs: Any, batch: tuple[int, ...] = (), before: np.ndarray | None = None) -> np.ndarray:
        """Read the measured entries; with "hold", ``before`` replaces NaN. Shapes: returns (*batch, entries)."""
        flat = self.outputs.flat(obs, batch)
        return np.where(np.isnan(flat), before, flat) if self._hold and before is not None else flat

    def show(self, obs: Any, flat: np.ndarray, shown: np.ndarray) -> Any:
        """Return the observation: the memory's output ``shown``, or a Dict of the measured keys and "memory"."""
        return self.outputs.kept(obs, flat) | {"memory": shown[..., self._beside]} if self._beside else shown


class KKLMemory(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Wraps any environment: an agent then sees the measured entries, and a memory of them and of its actions.

    With it an agent without its own memory, such as an MLP, can act where part of the state is hidden. The memory is
    linear, stable and fixed: filters of the outputs and inputs, the linear half of a KKL observer.

    The observation is [y, memory of y, memory of u], float32, where y are the measured entries. The memory of y has one
    number for each entry and time constant: a combination of filters of the entry's changes, 0 if y is constant. The
    memory of u has a running mean for each input and time constant. The cosine and sine of an angle share one memory,
    that of the unwrapped angle. Once the memory has filled, its numbers are about as large as y, see
    :class:`kkl_gym.memory.Memory`. At reset it assumes that y was constant and that no input acted. From the first step
    on, it assumes that y changed in the 64 steps before the reset at the mean rate that y has had since the reset.
    ``info`` is unchanged.

    Unless ``measured`` holds indices, a Dict stays a Dict of its measured keys; the new key ``"memory"`` holds the
    memory, and the cosine and sine of angles. Images are not remembered.

    Parameters
    ----------
    env : gymnasium.Env
        Any environment whose observations and actions are Box, Discrete, MultiDiscrete or MultiBinary, or Dict and
        Tuple spaces of these. Images may only be keys of a Dict.
    measured : sequence of int or of str, optional
        Entries that the agent sees: keys of a Dict, or indices in the flattened observation. With indices the
        observation is flat. None is all entries.
    angles : sequence of int or of str, or of pairs of these
        The measured entries that are angles; each is replaced by its cosine and sine. A pair such as (0, 1) names two
        entries that are the cosine and the sine of one angle. An angle must turn by less than half a turn in a step.
    period : float, optional
        Length of a turn, for all angles that are not pairs. None: 360 if the bounds are 360 or 720 apart, 2 pi if they
        are infinite or at most 4 pi apart (except 1, 2 and 4). For all other bounds the period is required.
    missing : {"error", "hold"}
        On NaN among the measured entries, raise an error, or hold the last value. The first sample must be complete.
    weights : array_like, optional
        Return value of :meth:`learn_weights`, for noisy outputs. The observation is then [prediction of y one step
        ahead, predictions of later y], see :class:`kkl_gym.prediction.PredictiveMemory`.
    time_constants : sequence of float
        Time constants of the outputs' filters in steps, from 0.5 to 10,000, each at least 1.5 times the one before.
    input_time_constants : sequence of float
        The same for the filters of actions; an empty sequence leaves actions out. Actions in a bounded Box are scaled
        to [-1, 1], discrete actions are one-hot.

    Raises
    ------
    ValueError
        If the environment is not a gymnasium.Env, has other spaces or is under ``Autoreset``, if an argument is not as
        described, or if the period of an angle is unknown. At a reset or step, if a measured entry is infinite, beyond
        1e15, or NaN (with "hold", NaN only at a reset). At a step, if the action is infinite, beyond 1e15, or NaN.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import KKLMemory
    >>> env = KKLMemory(gym.make("Pendulum-v1"), measured=[0, 1])  # cosine and sine of the angle, without its rate
    >>> obs, info = env.reset(seed=0)
    >>> obs.shape
    (12,)
    >>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        measured: Entries | None = None,
        *,
        angles: Angles = (),
        period: float | None = None,
        missing: Literal["error", "hold"] = "error",
        weights: Weights | None = None,
        time_constants: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
        input_time_constants: Sequence[float] = (1.0, 4.0),
    ) -> None:
        if not isinstance(env, gym.Env):
            other = "for vectors there is KKLVectorMemory, and make_vec_env of stable-baselines3 takes wrapper_class"
            raise ValueError(f"KKLMemory needs a gymnasium.Env ({other}), got {shown(env)}")
        check_autoreset(env)
        how: dict[str, Any] = {"angles": angles, "period": period, "missing": missing, "weights": weights}
        how |= {"time_constants": time_constants, "input_time_constants": input_time_constants}
        self._of = _Remembering(env, env.action_space, env.observation_space, measured, **how)
        RecordConstructorArgs.__init__(self, **self._of.arguments)
        gym.Wrapper.__init__(self, env)
        self.observation_space = self._of.space
        self._flat = np.empty(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and the memory. Returns the first observation, as if y had been constant before."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._flat = self._of.read(obs)
        return self._of.show(obs, self._flat, self._of.memory.reset(self._of.outputs.of_flat(self._flat))), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and update the memory with the action and the new measured entries."""
        u = self._of.inputs(action)
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._flat = self._of.read(obs, before=self._flat)
        shown = self._of.memory.advance(self._of.outputs.of_flat(self._flat), u)
        return self._of.show(obs, self._flat, shown), reward, terminated, truncated, info

    def learn_weights(self, steps: int = 4_000, *, seed: int = 0) -> list[list[float]]:
        """Fit the weights by which the memory predicts later outputs.

        All environments of an agent need the same weights. This method resets the environment.

        Parameters
        ----------
        steps : int
            Steps with random actions; more are needed under strong noise or with short episodes.
        seed : int
            Seed of the environment and of the actions.

        Returns
        -------
        list of list of float
            The argument ``weights`` of the wrappers.

        Raises
        ------
        ValueError
            If the episodes have too few samples for the fit.
        """
        # With empty weights, a memory computes the features of the fit.
        env = KKLMemory(self.env, **self._of.arguments | {"weights": ()})
        memory, actions = cast(PredictiveMemory, env._of.memory), copy.deepcopy(self.action_space)
        actions.seed(seed)
        env.reset(seed=seed)
        episodes = [[memory.features()]]
        for _ in range(integer("steps", steps, 1)):
            _, _, terminated, truncated, _ = env.step(actions.sample())
            episodes[-1].append(memory.features())
            if terminated or truncated:
                env.reset()
                episodes.append([memory.features()])
        weights: list[list[float]] = memory.fit([np.array(episode) for episode in episodes]).tolist()
        return weights


class KKLVectorMemory(VectorWrapper):
    """:class:`KKLMemory` for vector environments: one batched memory, reset row by row in every autoreset mode.

    It wraps Gymnasium's Sync and Async vectors, and environments that are natively vectors.
    ``info["final_obs"]`` holds the last observations with their memory; the rest of ``info`` is unchanged. In the mode
    SAME_STEP, vectors return an episode's last observation after the next reset. If the environments overwrite it by
    then, because they reuse one array, wrap each in :class:`KKLMemory` instead.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Any vector environment with the spaces that :class:`KKLMemory` takes.
    measured : sequence of int or of str, optional
        As for :class:`KKLMemory`; indices count within one environment's observation.
    **arguments
        All other arguments of :class:`KKLMemory`.

    Attributes
    ----------
    autoreset_mode : gymnasium.vector.AutoresetMode
        The mode of the environment.

    Raises
    ------
    ValueError
        As for :class:`KKLMemory`, and if the environment's metadata has no autoreset mode.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import KKLVectorMemory
    >>> envs = KKLVectorMemory(gym.make_vec("CartPole-v1", num_envs=64), measured=[0, 2])  # positions only
    >>> obs, info = envs.reset(seed=0)
    >>> obs.shape
    (64, 14)
    >>> obs, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    """

    def __init__(self, env: VectorEnv, measured: Entries | None = None, **arguments: Any) -> None:
        if not isinstance(env, gym.vector.VectorEnv):
            raise ValueError(
                "KKLVectorMemory needs a gymnasium.vector.VectorEnv, such as gym.make_vec makes (for one environment "
                f"there is KKLMemory), got {shown(env)}"
            )
        super().__init__(env)
        check_autoreset(env)
        spaces_of_one = env.single_action_space, env.single_observation_space
        self._of = _Remembering(env, *spaces_of_one, measured, **arguments)
        self.autoreset_mode = autoreset_mode_in(env)
        self.single_observation_space = self._of.space
        self.observation_space = batch_space(self._of.space, env.num_envs)
        self._ended, self._flat = np.zeros(env.num_envs, dtype=bool), np.empty(0)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, Infos]:
        """Reset environments and memories, all or the rows of ``options["reset_mask"]``."""
        options, mask = with_mask(options, self.num_envs)
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._ended = self._ended & ~mask
        before = None if mask.all() else np.where(mask[:, None], np.nan, self._flat)
        self._flat = self._of.read(obs, (self.num_envs,), before)
        y, memory = self._of.outputs.of_flat(self._flat), self._of.memory
        if mask.all():
            return self._of.show(obs, self._flat, memory.reset(y)), info
        memory.restart(y[mask], mask)
        return self._of.show(obs, self._flat, memory.shown()), info

    def step(self, actions: Any) -> Step:
        """Step the environments, and update the memories with the actions and the new measured entries."""
        batch, of, memory, before = (self.num_envs,), self._of, self._of.memory, self._ended
        u = of.inputs(actions, batch)
        obs, reward, terminated, truncated, info = self.env.step(actions)
        ended, same = terminated | truncated, self.autoreset_mode is AutoresetMode.SAME_STEP
        resting = self.autoreset_mode is AutoresetMode.DISABLED  # ended rows wait for a reset
        fresh = ended if same else before & (not resting)
        last, flat = self._flat, of.read(obs, batch, np.where(fresh[:, None], np.nan, self._flat))
        self._flat, self._ended = flat, ended & (not same)
        y = of.outputs.of_flat(flat)
        # The memory takes the last outputs of ended episodes, and then restarts with the first outputs of the next.
        if same and ended.any():
            rows, final, ends = np.flatnonzero(ended), np.full(self.num_envs, None, dtype=object), flat.copy()
            for row in rows:
                ends[row] = of.read(info["final_obs"][row], before=last[row])
            shown = memory.advance(of.outputs.of_flat(ends), u)
            for row in rows:
                final[row] = of.show(info["final_obs"][row], ends[row], shown[row].copy())
            info["final_obs"] = final
        else:
            shown = memory.advance(y, u, ~before if resting and before.any() else None)
        if fresh.any():
            shown[fresh] = memory.restart(y[fresh], fresh)
        return of.show(obs, flat, shown), reward, terminated, truncated, info


__all__ = ["KKLMemory", "KKLVectorMemory"]
