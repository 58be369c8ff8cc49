"""A memory around any environment: filtered outputs and actions beside the measured entries, without training."""

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
    """A memory between the spaces of an environment, for one of them or a batch; arguments are the wrappers'."""

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
        # As the specification can write it down, once it is known to be what it should.
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
        if weights is not None:  # expected outputs may leave all other bounds
            high = np.where(np.isin(range(len(low)), self.outputs.pairs), 1.0, np.inf)
            low = -high
        low, high = np.append(low, -unbounded), np.append(high, unbounded)
        self._beside = [] if keys is None else [*self.outputs.unseen, *range(len(self.outputs.low), self.memory.size)]
        if keys is not None:
            if weights is not None or "memory" in keys:
                raise ValueError(f"{source}: weights, and a key that is named memory, need entries, measured=[0, 1]")
            low, high = low[self._beside], high[self._beside]
        with np.errstate(over="ignore"):  # what floats cannot hold is unbounded
            flat = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.space: gym.Space[Any] = flat if keys is None else spaces.Dict(keys | {"memory": flat})

    def read(self, obs: Any, batch: tuple[int, ...] = (), before: np.ndarray | None = None) -> np.ndarray:
        """Read the measured entries; the last value replaces a NaN that is held. Shapes: returns (*batch, entries)."""
        flat = self.outputs.flat(obs, batch)
        return np.where(np.isnan(flat), before, flat) if self._hold and before is not None else flat

    def show(self, obs: Any, flat: np.ndarray, shown: np.ndarray) -> Any:
        """The observation: what the memory shows, beside the keys of a Dict."""
        return self.outputs.kept(obs, flat) | {"memory": shown[..., self._beside]} if self._beside else shown


class KKLMemory(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Shows the measured entries and a memory of them and of the actions, around any environment.

    With it an agent without memory of its own, such as an MLP, can act where part of the state is hidden. The memory is
    linear, stable and fixed: filters of the outputs and inputs, the linear half of a KKL observer.

    The observation is [y, memory of y, memory of u], float32. y are the entries that are measured. For each of
    them and each time constant follows what a first-order filter keeps of its changes, 0 where y rests; for each input
    and time constant a running mean. An angle's cosine and sine have one memory, of how far it has turned. The
    coordinates are about as large as y once the memory has filled, see :class:`kkl_gym.memory.Memory`. At reset the
    memory is that of an output at rest and of no action. From the first step on, outputs are taken to have changed
    before it as they have since, for 64 steps. ``info`` is left alone.

    A Dict stays a Dict: its keys are as before, and ``"memory"`` holds the memory, and cosine and sine of angles.
    Images are not remembered.

    Parameters
    ----------
    env : gymnasium.Env
        Any environment whose observations and actions are boxes, discrete, or Dict and Tuple spaces of these; images
        only as keys of a Dict.
    measured : sequence of int or of str, optional
        What the agent may see: keys of a Dict, or indices in the flattened observation, which is then shown flat. None
        is all.
    angles : sequence of int or of str, or of pairs of these
        Which of these are angles; each is replaced by its cosine and sine. A pair such as (0, 1) names the cosine and
        the sine of an angle that is measured by them. An angle is taken to turn by less than half a turn in a step.
    period : float, optional
        A turn of all angles but pairs. None: 360 where the bounds are one or two turns in degrees, 2 pi where they are
        at most two turns in rad or infinite. It must be given for other bounds, and for those 1, 2 or 4 apart.
    missing : {"error", "hold"}
        How to treat NaN among the measured entries: an error, or the value before. The first sample must be whole.
    weights : array_like, optional
        Under noise: what :meth:`learn_weights` returns. The observation is then [y as expected in the next step,
        what else predicts y], see :class:`kkl_gym.prediction.PredictiveMemory`.
    time_constants : sequence of float
        Of the outputs' filters, in steps, from 0.5 to 10,000, each at least 1.5 times the one before. Longer ones
        remember longer.
    input_time_constants : sequence of float
        Of the filters of actions, in steps, likewise; none leave actions out. Boxes with bounds are scaled to [-1, 1],
        discrete actions are one-hot.

    Raises
    ------
    ValueError
        If the environment is not a gymnasium.Env, has other spaces or is under ``Autoreset``; if an argument is not as
        described, or the period of an angle is unknown. At reset and at a step, if something measured is infinite,
        beyond 1e15, or NaN that is not held, which the memory would keep; at a step, if the action is.

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
        """Reset the environment and the memory: the measured entries, with the memory of an output at rest."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._flat = self._of.read(obs)
        return self._of.show(obs, self._flat, self._of.memory.reset(self._of.outputs.of_flat(self._flat))), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and remember the action and the entries measured then."""
        u = self._of.inputs(action)
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._flat = self._of.read(obs, before=self._flat)
        shown = self._of.memory.advance(self._of.outputs.of_flat(self._flat), u)
        return self._of.show(obs, self._flat, shown), reward, terminated, truncated, info

    def learn_weights(self, steps: int = 4_000, *, seed: int = 0) -> list[list[float]]:
        """Learn what of the memory predicts the next outputs, from random actions: pass it to wrappers as ``weights``.

        All environments of an agent need the same. The environment is reset, with ``seed``.

        Parameters
        ----------
        steps : int
            Steps with random actions; noise or short episodes ask for more.
        seed : int
            Of the environment and of the actions.
        """
        env = KKLMemory(self.env, **self._of.arguments | {"weights": ()})  # of which the features are recorded
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

    Works on Gymnasium's Sync and Async vectors and on environments that are vectors by themselves.
    ``info["final_obs"]`` holds the last observations with their memory; else ``info`` is left alone. In the mode
    SAME_STEP, vectors hand out the last observation after the reset: around environments that write into the same array
    again, put :class:`KKLMemory` into each.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Any vector environment with the spaces that :class:`KKLMemory` takes.
    measured : sequence of int or of str, optional
        As for :class:`KKLMemory`, of one environment's observation.
    **arguments
        All other arguments of :class:`KKLMemory`.

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
        """Step the environments, and remember the actions and the entries measured then."""
        batch, of, memory, before = (self.num_envs,), self._of, self._of.memory, self._ended
        u = of.inputs(actions, batch)
        obs, reward, terminated, truncated, info = self.env.step(actions)
        ended, same = terminated | truncated, self.autoreset_mode is AutoresetMode.SAME_STEP
        resting = self.autoreset_mode is AutoresetMode.DISABLED  # rows that have ended wait for their reset
        fresh = ended if same else before & (not resting)
        last, flat = self._flat, of.read(obs, batch, np.where(fresh[:, None], np.nan, self._flat))
        self._flat, self._ended = flat, ended & (not same)
        y = of.outputs.of_flat(flat)
        if same and ended.any():  # the last outputs of these episodes come first, then the first ones of the next
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
