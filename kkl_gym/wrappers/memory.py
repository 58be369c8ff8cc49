"""A memory around any environment: filtered outputs and actions beside what is measured, without training."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from kkl_gym.identity import source_of
from kkl_gym.memory import Memory
from kkl_gym.signals import Angles, Entries, Inputs, Outputs
from kkl_gym.turning import TurningMemory
from kkl_gym.vector import Infos, with_mask
from kkl_gym.wrappers.vector import Step, VectorEnv, VectorWrapper, autoreset_mode_in
from observers.checks import shown


class _Remembering:
    """A memory between the spaces of an environment, for one of them or a batch; arguments are the wrappers'."""

    def __init__(
        self,
        env: Any,
        action_space: gym.Space[Any],
        observation_space: gym.Space[Any],
        measured: Entries | None,
        angles: Angles,
        time_constants: Sequence[float],
        input_time_constants: Sequence[float],
    ) -> None:
        source = source_of(env)
        self.outputs = Outputs(observation_space, measured, angles, source=source)
        self.inputs = Inputs(action_space, source=source)
        sizes, turning = (len(self.outputs.low), len(self.inputs.low)), self.outputs.turning
        how: dict[str, Any] = {"time_constants": time_constants, "input_time_constants": input_time_constants}
        self.memory = TurningMemory(*sizes, turning, **how) if turning else Memory(*sizes, **how)
        with np.errstate(over="ignore"):  # what floats cannot hold is unbounded
            low, high = self.memory.bounds(self.outputs.low, self.outputs.high, self.inputs.low, self.inputs.high)
            self.space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


class KKLMemory(gym.Wrapper[np.ndarray, Any, Any, Any], RecordConstructorArgs):
    """Shows what is measured and a memory of it and of the actions, around any environment.

    With it an agent without memory of its own, such as an MLP, can act where part of the state is hidden. The memory is
    linear, stable and fixed: filters of the outputs and inputs, the linear half of a KKL observer. Nothing is
    trained, and there is no file.

    The observation is [y, memory of y, memory of u], float32. y are the entries that are measured. For each of
    them and each time constant follows what a first-order filter keeps of its changes, 0 where y rests; for each input
    and time constant a running mean. An angle's cosine and sine have one memory, of how far it has turned. The
    coordinates are about as large as y once the memory has filled, see :class:`kkl_gym.memory.Memory`. At reset the
    memory is that of an output at rest and of no action. From the first step on, outputs are taken to have changed
    before it as they have since, for 64 steps. ``info`` is left alone.

    Parameters
    ----------
    env : gymnasium.Env
        Any environment whose observations and actions are boxes, discrete, or Dict and Tuple spaces of these, but not
        images.
    measured : sequence of int or of str, optional
        What the agent may see: indices in the flattened observation, or keys of a Dict. None is all.
    angles : sequence of int or of str, or of pairs of these
        Which of these are angles in rad; each is replaced by its cosine and sine. A pair such as (0, 1) names the
        cosine and the sine of an angle that is measured by them. An angle is taken to turn by less than half a turn in
        a step, see :class:`kkl_gym.turning.TurningMemory`.
    time_constants : sequence of float
        Of the outputs' filters, in steps, from 0.5 to 10,000, each at least 1.5 times the one before. Longer ones
        remember longer.
    input_time_constants : sequence of float
        Of the filters of actions, in steps, likewise; none leave actions out. Boxes with bounds are scaled to [-1, 1],
        discrete actions are one-hot.

    Raises
    ------
    ValueError
        If the environment is none, or of other spaces; if an argument is not as described. At reset and at a step, if
        something measured is NaN, infinite or beyond 1e15, which the memory would keep; at a step, if the action is.

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
        time_constants: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
        input_time_constants: Sequence[float] = (1.0, 4.0),
    ) -> None:
        if not isinstance(env, gym.Env):
            other = "for vectors there is KKLVectorMemory, and make_vec_env of stable-baselines3 takes wrapper_class"
            raise ValueError(f"KKLMemory needs a gymnasium.Env ({other}), got {shown(env)}")
        found = _Remembering(
            env, env.action_space, env.observation_space, measured, angles, time_constants, input_time_constants
        )
        # As the specification can write them down, once they are known to be what they should.
        RecordConstructorArgs.__init__(
            self,
            measured=found.outputs.measured,
            angles=found.outputs.angles,
            time_constants=found.memory.time_constants,
            input_time_constants=found.memory.input_time_constants,
        )
        gym.Wrapper.__init__(self, env)
        self._outputs, self._inputs, self._memory = found.outputs, found.inputs, found.memory
        self.observation_space = found.space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment and the memory: what is measured, with the memory of an output at rest."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self._memory.reset(self._outputs(obs)), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and remember the action and what is measured then."""
        u = self._inputs(action)
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._memory.advance(self._outputs(obs), u), reward, terminated, truncated, info


class KKLVectorMemory(VectorWrapper):
    """:class:`KKLMemory` for vector environments: one batched memory, reset row by row in every autoreset mode.

    Works on Gymnasium's Sync and Async vectors and on environments that are vectors by themselves.
    ``info["final_obs"]`` holds the last observations with their memory; else ``info`` is left alone.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Any vector environment with the spaces that :class:`KKLMemory` takes.
    measured : sequence of int or of str, optional
        As for :class:`KKLMemory`, of one environment's observation.
    angles : sequence of int or of str, or of pairs of these
        As for :class:`KKLMemory`.
    time_constants : sequence of float
        As for :class:`KKLMemory`.
    input_time_constants : sequence of float
        As for :class:`KKLMemory`.

    Attributes
    ----------
    autoreset_mode : gymnasium.vector.AutoresetMode
        The environment's.

    Raises
    ------
    ValueError
        As :class:`KKLMemory`, and if the environment does not say its autoreset mode.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import KKLVectorMemory
    >>> envs = KKLVectorMemory(gym.make_vec("CartPole-v1", num_envs=64), measured=[0, 2])  # positions alone
    >>> obs, info = envs.reset(seed=0)
    >>> obs.shape
    (64, 14)
    >>> obs, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    """

    def __init__(
        self,
        env: VectorEnv,
        measured: Entries | None = None,
        *,
        angles: Angles = (),
        time_constants: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
        input_time_constants: Sequence[float] = (1.0, 4.0),
    ) -> None:
        if not isinstance(env, gym.vector.VectorEnv):
            raise ValueError(
                "KKLVectorMemory needs a gymnasium.vector.VectorEnv, such as gym.make_vec makes (for one environment "
                f"there is KKLMemory), got {shown(env)}"
            )
        found = _Remembering(
            env,
            env.single_action_space,
            env.single_observation_space,
            measured,
            angles,
            time_constants,
            input_time_constants,
        )
        super().__init__(env)
        self.autoreset_mode = autoreset_mode_in(env)
        self._outputs, self._inputs, self._memory = found.outputs, found.inputs, found.memory
        self.single_observation_space: gym.spaces.Box = found.space
        self.observation_space: gym.spaces.Box = batch_space(found.space, env.num_envs)  # type: ignore[assignment]
        self._ended = np.zeros(env.num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Reset environments and memories, all or the rows of ``options["reset_mask"]``."""
        options, mask = with_mask(options, self.num_envs)
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._ended = self._ended & ~mask
        y = self._outputs(obs, (self.num_envs,))
        if mask.all():
            return self._memory.reset(y), info
        self._memory.restart(y[mask], mask)
        return self._memory.shown(), info

    def step(self, actions: Any) -> Step:
        """Step the environments, and remember the actions and what is measured then."""
        batch = (self.num_envs,)
        u = self._inputs(actions, batch)
        obs, reward, terminated, truncated, info = self.env.step(actions)
        y, before, ended = self._outputs(obs, batch), self._ended, terminated | truncated
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = ended
            resting = before.any() and self.autoreset_mode is AutoresetMode.DISABLED  # rows that wait for their reset
            out = self._memory.advance(y, u, ~before if resting else None)
            if before.any() and not resting:
                out[before] = self._memory.restart(y[before], before)
        elif ended.any():  # the last outputs of these episodes come first, then the first ones of the next
            rows, final = np.flatnonzero(ended), np.full(self.num_envs, None, dtype=object)
            last = y.copy()
            last[ended] = [self._outputs(info["final_obs"][row]) for row in rows]
            out = self._memory.advance(last, u)
            for row in rows:
                final[row] = out[row].copy()
            info["final_obs"] = final
            out[ended] = self._memory.restart(y[ended], ended)
        else:
            out = self._memory.advance(y, u)
        return out, reward, terminated, truncated, info


__all__ = ["KKLMemory", "KKLVectorMemory"]
