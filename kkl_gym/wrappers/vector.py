"""Wrappers for vector environments: a batched learned observer, and actions that are held over several steps."""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from kkl_gym.identity import how_to_make_one
from kkl_gym.plant import Plant
from kkl_gym.rendering import Trails
from kkl_gym.vector import Infos, KKLVectorEnv, autoreset_mode_of, last_of_episodes, with_mask
from kkl_gym.wrappers.estimator import Estimates, KKLEstimator, check_untouched, observation
from kkl_gym.wrappers.rollouts import NamedEstimator, Samples
from observers import Artifact
from observers.checks import flag, integer, shown
from observers.names import resolve

VectorEnv = gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]
if TYPE_CHECKING:
    VectorWrapper = gym.vector.VectorWrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
else:  # before gymnasium 1.4 the class is not generic
    VectorWrapper = gym.vector.VectorWrapper
Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]


class VectorEstimate(VectorWrapper):
    """Replaces observations by the estimates of a batch of observers, which read ``info["y"]`` and ``info["u"]``.

    ``info`` gains the observers' reports, with a row for each environment. In the autoreset mode SAME_STEP,
    ``info["final_info"]`` gains them too, and ``info["final_obs"]`` holds the last estimates.
    """

    def __init__(self, env: VectorEnv, estimator: Estimates | KKLEstimator) -> None:
        super().__init__(env)
        self.autoreset_mode = autoreset_mode_in(env)
        self._estimator = estimator
        self.single_observation_space: gym.spaces.Box = estimator.space
        self.observation_space: gym.spaces.Box = batch_space(estimator.space, env.num_envs)  # type: ignore[assignment]
        self._ended = np.zeros(env.num_envs, dtype=bool)
        self._sample = np.zeros(env.num_envs, dtype=np.int64)
        self.emitted = b""  # bytes of the last observations, as in KKLVectorEnv
        # The KKLVectorEnv or VectorEstimate inside; None for Sync and Async vectors, and for observers from rollouts.
        self._inside: Any = None if isinstance(env, _SignalsInInfo) else env
        while self._inside is not None and not isinstance(self._inside, KKLVectorEnv | VectorEstimate):
            self._inside = getattr(self._inside, "env", None)
        rendering = isinstance(env.unwrapped, KKLVectorEnv) and env.render_mode is not None
        self._trails = Trails(env.num_envs) if rendering else None  # trails of the estimates

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Reset environments and observers, all or the rows of ``options["reset_mask"]``."""
        options, mask = with_mask(options, self.num_envs)
        inner, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._check_untouched(inner, at_reset=True)
        if not isinstance(info, dict) or not isinstance(info.get("y"), np.ndarray):
            raise ValueError(
                f"the observer reads info['y'] as an array, but {shown(self.env)} changes info: put wrappers such as "
                "DictInfoToList and NumpyToTorch outside"
            )
        if mask.all():
            self._estimator.reset(info["y"], _states(info, mask))
        else:
            self._estimator.restart(info["y"][mask], mask, _states(info, mask))
        self._ended = self._ended & ~mask
        self._sample = np.where(mask, info["sample"], self._sample)
        obs = self._show(info, mask)
        self._trace(info)
        return obs, info

    def step(self, actions: np.ndarray) -> Step:
        """Step the environments, and update the observers with the new samples and the inputs that led to them."""
        inner, reward, terminated, truncated, info = self.env.step(actions)
        self._check_untouched(inner)
        before, ended = self._ended, terminated | truncated
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = ended
        elif ended.any():
            return self._show_and_restart(info, ended), reward, terminated, truncated, info
        y, u = info["y"], info["u"]
        disabled = self.autoreset_mode is AutoresetMode.DISABLED
        expected = self._sample + 1
        over = bool(before.any())
        if over:  # the previous step ended these rows; this one reset them or, in mode DISABLED, left them as they were
            expected[before] = self._sample[before] if disabled else 0
        self._check(expected, info["sample"], before)
        if over and disabled:
            self._estimator.advance(y, u, ~before)
        else:
            self._estimator.advance(y, u)
            if over:
                self._estimator.restart(y[before], before, _states(info, before))
        self._sample = expected
        obs = self._show(info, np.ones_like(ended))
        self._trace(info)
        return obs, reward, terminated, truncated, info

    def _show_and_restart(self, info: Infos, ended: np.ndarray) -> np.ndarray:
        """In SAME_STEP, process the last samples of the episodes that ended, and then the first samples of the next."""
        final = info["final_info"]
        expected = self._sample + 1
        self._check(expected, np.where(ended, final["sample"], info["sample"]), np.zeros_like(ended))
        y, u = (np.where(ended[:, None], final[key], info[key]) for key in ("y", "u"))
        self._estimator.advance(y, u)
        y0 = info["y"][ended]  # a copy, because the report may replace y in info
        shown = self._show(info, np.ones_like(ended))
        for row in np.flatnonzero(ended):
            info["final_obs"][row] = shown[row].copy()
        self._estimator.restart(y0, ended, _states(info, ended))
        self._sample = np.where(ended, 0, expected)
        first = self._estimator.report(ended)
        for key, values in first.items():
            final |= {key: info[key] * column(ended, info[key]), f"_{key}": ended.copy()}
            info[key][ended] = values
        shown[ended] = observation(self._estimator.shown(first), self.single_observation_space)
        self.emitted = shown.tobytes()
        self._trace(info)
        return shown

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw the phase portrait of each row with states and estimates so far.

        Estimates are drawn only if the vector inside is a :class:`kkl_gym.KKLVectorEnv` and the observers report
        ``x_hat``. For Sync and Async vectors put :class:`kkl_gym.KKLObservation` into each environment.
        """
        env: Any = self.env
        return env.render() if self._trails is None else env.unwrapped.draw(self._trails)

    def _trace(self, info: Infos) -> None:
        if self._trails is not None and "x_hat" in info:
            self._trails.add(info["x_hat"], info["sample"])

    def _check(self, expected: np.ndarray, seen: np.ndarray, ended: np.ndarray) -> None:
        if (seen != expected).any():
            row = int(np.flatnonzero(seen != expected)[0])
            if ended[row]:
                raise ValueError(f"the episode of environment {row} has ended: reset it before the next step")
            raise ValueError(
                f"the observer expected sample {expected[row]} of environment {row} and received {seen[row]}: put "
                "wrappers that skip steps, such as VectorActionRepeat, outside KKLVectorObservation, and reset after "
                "an error"
            )

    def _check_untouched(self, obs: Any, *, at_reset: bool = False) -> None:
        """Raise ValueError if a wrapper inside changes observations; for Sync and Async vectors only at resets."""
        if self._inside is not None:
            check_untouched(obs, self._inside.emitted, self.env, self._inside)
        elif at_reset and not isinstance(self.env, _SignalsInInfo):
            base: Any = self.env.unwrapped
            check_untouched(obs, b"".join(base.get_attr("emitted")), self.env, base)

    def _show(self, info: Infos, rows: np.ndarray) -> np.ndarray:
        """Add the observers' report to ``info``, with the mask ``rows`` of its valid rows. Returns all observations."""
        report = self._estimator.report()
        for key, values in report.items():
            info |= {key: values, f"_{key}": rows.copy()}
        obs = observation(self._estimator.shown(report), self.single_observation_space)
        self.emitted = obs.tobytes()
        return obs


class _SignalsInInfo(VectorWrapper):
    """Adds the keys of a KKLVectorEnv to the ``info`` of any vector environment: y, u, sample and, if known, x."""

    def __init__(self, env: VectorEnv, samples: Samples) -> None:
        super().__init__(env)
        self._mode, self._read, n = autoreset_mode_in(env), samples, env.num_envs
        if samples.outputs.keys:
            raise ValueError(
                f"the observer measures info[{samples.outputs.keys[0]}], which vectors do not report at each step: put "
                "KKLObservation into each environment"
            )
        self._asked = () if samples.hidden is None else samples.hidden.keys
        self._ended, self._count = np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, Infos]:
        options, mask = with_mask(options, self.num_envs)
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        if not isinstance(info, dict):
            return obs, info  # the observers then raise an error that names the cause
        self._ended, self._count = self._ended & ~mask, np.where(mask, 0, self._count)
        signals = {"y": self._read.outputs(obs, info, (self.num_envs,)), "sample": self._count.copy()}
        signals |= self._states(obs, info)
        return obs, info | signals

    def step(self, actions: Any) -> Step:
        batch = (self.num_envs,)
        u = self._read.inputs(actions, batch)
        obs, reward, terminated, truncated, info = self.env.step(actions)
        y, before, ended = self._read.outputs(obs, info, batch), self._ended, terminated | truncated
        count = self._count + 1
        if self._mode is AutoresetMode.SAME_STEP:
            if ended.any():
                last, final = y.copy(), np.full(self.num_envs, None, dtype=object)
                reported = info.get("final_info", {})
                asked = [key for key in self._asked if key in reported]
                x, known = np.full((self.num_envs, self._read.nx), np.nan), np.zeros(self.num_envs, dtype=bool)
                for row in np.flatnonzero(ended):
                    final[row] = info["final_obs"][row]
                    last[row] = self._read.outputs(final[row], {})
                    there = {key: reported[key][row] for key in asked if reported.get(f"_{key}", ended)[row]}
                    shown = self._read.states(final[row], there)
                    x[row], known[row] = shown.get("x", np.nan), bool(shown)
                signals = {"y": last, "u": u, "sample": count, "x": x, "_x": known}
                info = info | {"final_obs": final, "final_info": {**reported, **signals}}
            self._count = np.where(ended, 0, count)
        else:
            waits = self._count if self._mode is AutoresetMode.DISABLED else 0
            self._ended, self._count = ended, np.where(before, waits, count)
        signals = {"y": y, "u": u, "sample": self._count.copy()} | self._states(obs, info)
        return obs, reward, terminated, truncated, info | signals

    def _states(self, obs: Any, info: Infos) -> dict[str, np.ndarray]:
        """Return the true hidden signals, and a mask of the rows that show them; empty if they cannot be read."""
        found = self._read.states(obs, info, (self.num_envs,))
        if found:
            known = np.ones(self.num_envs, dtype=bool)
            for key in self._asked:
                known &= info.get(f"_{key}", True)
            found = {"x": np.where(known[:, None], found["x"], np.nan), "_x": known}
        for key in ("x", "_x"):  # the environment's own keys may mean something else
            info.pop(key, None)
        return found


def _states(info: Infos, rows: np.ndarray) -> np.ndarray:
    """Return true states of the environments in the mask ``rows``; without columns if ``info`` does not hold them."""
    return info["x"][rows] if "x" in info else np.full((int(rows.sum()), 0), np.nan)


class KKLVectorObservation(VectorEstimate):
    """:class:`kkl_gym.KKLObservation` for vector environments: one batched observer, reset row by row.

    It wraps :class:`kkl_gym.KKLVectorEnv`, and Gymnasium's Sync and Async vectors of
    :class:`kkl_gym.KKLEnv`, in every autoreset mode. Vectors of another environment need an observer from its rollouts.
    Observations then hold the measured outputs beside the estimates, as in :class:`kkl_gym.KKLObservation`.

    ``info`` and ``info["final_info"]`` gain ``z``, with ``estimate="x"`` also ``x_hat``, and with ``monitor`` also
    ``score``, each with a row for each environment. ``info["final_obs"]`` holds the last estimates. Around vectors of
    another environment ``info`` also gains ``y``, ``u``, ``sample`` and ``x``.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        A vector of :class:`kkl_gym.KKLEnv`, bare or under wrappers that change neither observations nor ``info``, or a
        vector of the environment that the observer's file names.
    observer : str or path, optional
        As for :class:`kkl_gym.KKLObservation`.
    **options
        All other arguments of :class:`kkl_gym.KKLObservation`. With ``known_start`` the observer starts at the true
        initial state of every episode. ``info["x_cov"]`` has the shape (num_envs, nx, nx).

    Attributes
    ----------
    observer : KKLObserver
        The observer of all rows.
    estimate : str
        The argument ``estimate``.
    autoreset_mode : gymnasium.vector.AutoresetMode
        The mode of the environment.

    Raises
    ------
    ValueError
        As for :class:`kkl_gym.KKLObservation`, and if the environments of a Sync or Async vector differ in a setting
        that the observer needs; the level of process noise counts only if T_inv takes it or the map has a motion model.

    Examples
    --------
    >>> import gymnasium as gym
    >>> import numpy as np
    >>> from kkl_gym import KKLVectorObservation
    >>> envs = KKLVectorObservation(gym.make_vec("KKLRossler-v0", num_envs=4, autoreset_mode="SameStep"))
    >>> x_hat, info = envs.reset(seed=0)
    >>> x_hat.shape, info["x_hat"].shape
    ((4, 3), (4, 3))
    >>> x_hat, reward, terminated, truncated, info = envs.step(np.zeros((4, 1)))
    """

    def __init__(self, env: VectorEnv, observer: str | os.PathLike[str] | None = None, **options: Any) -> None:
        artifact = None if observer is None else Artifact.read(resolve(observer))
        estimator: KKLEstimator
        if artifact is not None and artifact.environment is not None and isinstance(env, gym.vector.VectorEnv):
            flag("ignore_input", options.pop("ignore_input", False))
            estimator = NamedEstimator(env, env.single_observation_space, env.single_action_space, artifact, **options)
            env = _SignalsInInfo(env, estimator.samples)
        else:
            estimator = KKLEstimator.of_plant(plant_of(env), artifact, **options)
            _check_process_noise(env, estimator.observer.artifact)
        super().__init__(env, estimator)
        self._estimator: KKLEstimator = estimator
        self.observer = estimator.observer
        self.estimate = estimator.estimate

    def replace_observer(self, observer: str | os.PathLike[str] | Artifact) -> None:
        """Like :meth:`kkl_gym.KKLObservation.replace_observer`, in all rows at once. The filters' states stay."""
        asked = self._estimator.asked(observer)
        if self.observer.artifact.environment is None:  # a vector of KKLEnv
            _check_process_noise(self.env, asked)
        self.observer.replace(asked)


def _check_process_noise(env: gym.vector.VectorEnv, artifact: Artifact) -> None:
    """Raise ValueError if the rows differ in the level of process noise, and T_inv or a motion model takes it."""
    if artifact.process_noise_max is not None or artifact.motion is not None:
        plant_of(env, "process_noise")


class VectorActionRepeat(VectorWrapper):
    """:class:`kkl_gym.ActionRepeat` for :class:`kkl_gym.KKLVectorEnv`, bare or under :class:`KKLVectorObservation`.

    It holds each action for ``repeat`` steps and sums the rewards. If a row's episode ends on the way, the row stays at
    that end for the rest of the repeat, so that its next episode begins with a new action. Therefore the environment
    inside must leave resets to this wrapper (``autoreset_mode="Disabled"``). The wrapper itself offers every mode.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        The vector environment, with ``autoreset_mode`` DISABLED.
    repeat : int
        Number of steps for which an action is held.
    autoreset_mode : str or gymnasium.vector.AutoresetMode
        The mode that this wrapper offers, by default NEXT_STEP.

    Raises
    ------
    ValueError
        If ``repeat`` is not a positive integer, the mode is unknown, or the environment is not as described.

    Examples
    --------
    >>> import numpy as np
    >>> from kkl_gym import KKLVectorEnv, VectorActionRepeat
    >>> envs = VectorActionRepeat(KKLVectorEnv("lorenz", 2, autoreset_mode="Disabled"), 5)
    >>> obs, info = envs.reset(seed=0)
    >>> obs, reward, terminated, truncated, info = envs.step(np.zeros((2, 1)))
    >>> info["sample"].tolist()
    [5, 5]
    """

    def __init__(
        self, env: VectorEnv, repeat: int, autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP
    ) -> None:
        repeat, mode = integer("repeat", repeat, 1), autoreset_mode_of(autoreset_mode)
        inside: VectorEnv = env
        while isinstance(inside, VectorEstimate | VectorActionRepeat):
            inside = inside.env
        if not isinstance(inside, KKLVectorEnv) or autoreset_mode_in(env) is not AutoresetMode.DISABLED:
            raise ValueError(
                'VectorActionRepeat resets rows itself, and needs a KKLVectorEnv made with autoreset_mode="Disabled": '
                "put other wrappers outside; in Sync and Async vectors put ActionRepeat into each environment; got "
                f"{shown(env)}"
            )
        super().__init__(env)
        self.repeat, self.autoreset_mode = repeat, mode
        frames = max(1, round(env.metadata["render_fps"] / repeat))
        self.metadata = {**env.metadata, "autoreset_mode": self.autoreset_mode, "render_fps": frames}
        self._ended = np.zeros(env.num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Reset the environments, or the rows of ``options["reset_mask"]``."""
        options, mask = with_mask(options, self.num_envs)
        obs, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._ended = self._ended & ~mask
        return obs, info

    def step(self, actions: np.ndarray) -> Step:
        """Hold actions for ``repeat`` steps. Returns each row's sum of rewards, and all else from its last step."""
        waiting = self._ended  # rows that ended in an earlier step; env.step leaves them unchanged
        total, info = np.zeros(self.num_envs), Infos()
        for _ in range(self.repeat):
            obs, reward, terminated, truncated, new = self.env.step(actions)
            total += reward
            info = _merged(info, new)
            if (terminated | truncated).all():
                break
        self._ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and waiting.any():
            obs, new = self.reset(options={"reset_mask": waiting})
            info = _merged(info, new)
            terminated, truncated = terminated & ~waiting, truncated & ~waiting
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            ended = self._ended.copy()
            final = last_of_episodes(obs, info, ended)
            obs, new = self.reset(options={"reset_mask": ended})
            info = _merged(info, new) | final
        return obs, total, terminated, truncated, info


def _merged(old: Infos, new: Infos) -> Infos:
    """Return ``old`` with the masked entries of ``new``; rows that the masks leave out keep the values of ``old``."""
    out = dict(old)
    for key, mask in new.items():
        if key.startswith("_") and key[1:] in new:
            values = new[key[1:]]
            if key in old and not mask.all():
                values = np.where(column(mask, values), values, old[key[1:]])
                mask = mask | old[key]
            out |= {key[1:]: values, key: mask}
    return out


def column(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Reshape a mask to broadcast against values. Shapes: ``mask`` (n,), ``values`` (n, ...); returns (n, 1, ...)."""
    return mask.reshape(-1, *(1,) * (values.ndim - 1))


def autoreset_mode_in(env: VectorEnv) -> AutoresetMode:
    """Return the autoreset mode in the metadata of a vector environment; ValueError without one."""
    mode = env.metadata.get("autoreset_mode")
    if not isinstance(mode, AutoresetMode):
        raise ValueError(
            f"{env} does not declare its autoreset mode: metadata['autoreset_mode'] is {mode!r}; "
            "set it to one of gymnasium.vector.AutoresetMode"
        )
    return mode


def plant_of(env: VectorEnv, *also: str) -> Plant:
    """Return the plant of row 0; ValueError if rows differ in system, dt, measurement noise or attributes ``also``."""
    base: Any = env.unwrapped if isinstance(env, gym.vector.VectorEnv) else env
    if isinstance(base, KKLVectorEnv):
        return base.plant
    try:
        plants: tuple[Plant, ...] = base.get_attr("plant")
    except AttributeError:
        raise ValueError(
            "KKLVectorObservation needs a vector of kkl_gym environments, or an observer from rollouts, got "
            f"{shown(base)}; "
            f"{how_to_make_one('ENV_ID')} (for vectors: KKLVectorMemory)"
        ) from None
    first = plants[0]
    for plant in plants:
        for name in ("system", "dt", "measurement_noise", *also):
            one, other = getattr(first, name), getattr(plant, name)
            if one != other:
                raise ValueError(
                    f"the environments differ in {name}, {shown(one)} and {shown(other)}: one observer cannot serve all"
                )
    return first


__all__ = ["KKLVectorObservation", "VectorActionRepeat", "VectorEstimate"]
