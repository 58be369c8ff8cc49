"""Wrappers: a learned observer around an environment, and actions that are held over several steps."""

import os
from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from kkl_gym.envs import KKLEnv
from kkl_gym.identity import how_to_make_one, source_of
from kkl_gym.rendering import TRAIL
from kkl_gym.wrappers.estimator import KKLEstimator, check_untouched, observation
from kkl_gym.wrappers.rollouts import NamedEstimator, Samples
from observers import Artifact
from observers.checks import choice, flag, integer, shown
from observers.names import resolve

# Up to this length of an observation, comparisons one by one are faster than np.clip.
_FEW = 8
_FLOAT32 = np.dtype(np.float32)


class _SystemSamples:
    """Reads the samples of a :class:`KKLEnv` from its ``info``."""

    def __init__(self, env: Any) -> None:
        self.count = 0  # number of the last sample that the observer has seen
        self._env = self._inside = env
        while not isinstance(self._inside, KKLEnv | KKLObservation):
            self._inside = self._inside.env

    def first(self, observation: Any, info: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return output and state after a reset; ValueError if a wrapper inside changes observations."""
        check_untouched(observation, self._inside.emitted, self._env, self._inside)
        self.count = int(info["sample"])
        return info["y"], info["x"]

    def next(self, observation: Any, info: dict[str, Any], action: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return a step's output, and the input that led to it; ValueError if a wrapper skips or changes samples."""
        sample = int(info["sample"])
        if sample != self.count + 1:
            raise ValueError(
                f"the observer expected sample {self.count + 1} and received sample {sample}: put "
                "wrappers that skip steps or reset by themselves, such as ActionRepeat, outside KKLObservation, and "
                "reset after an error"
            )
        check_untouched(observation, self._inside.emitted, self._env, self._inside)
        return info["y"], info["u"]


class KKLObservation(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Wraps an environment: an agent then sees a learned observer's estimate in place of the state.

    Around a :class:`KKLEnv` the observer sees only the sensor's output ``info["y"]`` and the input ``info["u"]`` that
    the environment applied. ``info`` gains ``z``, the filter's state, and with ``estimate="x"`` also ``x_hat``, shape
    (nx,). Both are float64 and not clipped. With ``monitor``, ``info`` also has ``score``, of shape (). The score is
    above 1 where the samples do not fit the estimates, as with a faulty sensor or far outside the training box.
    Once ``observer.gate`` is set, ``rejected`` in ``info`` counts rejected outputs. If the map estimates parameters,
    the estimates are in ``parameters_hat``.

    With ``estimate="z"`` there is neither ``x_hat`` nor ``parameters_hat``, and :meth:`render` shows no estimate.
    Neither T_inv nor the tracker runs then, unless ``monitor`` or ``known_start`` is set.

    Any other environment needs an observer from its rollouts (``kkl-gym record`` and ``kkl-gym train``, or
    ``training.learn``). Such an observer sees the actions, and the measured signals that its file names. The
    observation is then [y, x_hat] or [y, z]: the measured outputs come first. ``info`` also gains ``y``, the inputs
    ``u`` that led to it, and ``sample``, the count of steps since reset. It gains ``x``, shape (nx,), the true hidden
    signals, where the environment inside shows them. ``x`` is privileged: it serves evaluation and
    ``training.KKLTrainingCallback``.

    Parameters
    ----------
    env : gymnasium.Env
        A :class:`KKLEnv`, bare or under wrappers that change neither observations nor ``info``; or the environment that
        the observer's file names, under wrappers that leave its measured signals, actions and steps unchanged.
    observer : str or path, optional
        A shipped name, or a path if it ends in ``.safetensors``; None takes the map shipped for the environment's
        system.
    estimate : {"x", "z"}
        The observation: "x" is the state estimate, clipped to the states' bounds. "z" is the filter's state
        [z_y, z_u]; y drives the first part, u the second.
    measurement_noise : float or sequence of float, length ny, optional
        The noise level that the observer assumes, one for all outputs or one for each. None takes the level of the
        :class:`KKLEnv`, or 0 for an observer from rollouts. Maps that need a process-noise level always take that
        of the :class:`KKLEnv`.
    ignore_input : bool
        Whether to use a map without inputs, such as the paper's, although the agent acts.
    monitor : bool
        Whether to compute the score, see :attr:`observers.KKLObserver.score`.
    known_start : bool
        Whether the observer is given the true state ``info["x"]`` at reset, and only there. It then has no transient.
        This needs a map that tracks, such as the default ones, or a forward map T, as in ``observer="SYSTEM-spinn"``.
    uncertainty : bool
        Whether x_hat in the observation is followed by std, the standard deviations of the estimation error.
        ``info`` then gains ``x_cov``, the covariance of x - x_hat, shape (nx, nx). This needs a map with a covariance,
        such as ``kkl-gym train`` makes.
    compiled : bool, optional
        Whether Numba compiles the observer's step, as in :class:`observers.KKLObserver`. None: if Numba is installed.

    Attributes
    ----------
    observer : KKLObserver
        The observer.
    estimate : str
        The argument ``estimate``.

    Raises
    ------
    ValueError
        If the environment is no :class:`KKLEnv` and the observer not from its rollouts, or if ``estimate`` is unknown,
        a flag is not a bool, no map ships for the system, or the noise level is beyond the map's range. At a step, if
        the agent acts, but the map has no inputs and ``ignore_input`` is false, or if a wrapper inside skips samples.
        At a reset or step, if a wrapper inside changes observations: the observer would not see the change.
    observers.ArtifactError
        A ValueError for a file that is missing or damaged, was made for another system, other parameters or another dt,
        or lacks what an option needs: a tracker's model or T for ``known_start``, a covariance for ``uncertainty``.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import KKLObservation
    >>> env = KKLObservation(gym.make("KKLLorenz-v0"))
    >>> x_hat, info = env.reset(seed=0)
    >>> x_hat.shape, info["x_hat"].shape
    ((3,), (3,))
    >>> for _ in range(500):
    ...     x_hat, reward, terminated, truncated, info = env.step([0.0])
    >>> bool((abs(x_hat - info["x"]) < 3).all())
    True
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, np.ndarray],
        observer: str | os.PathLike[str] | None = None,
        *,
        estimate: Literal["x", "z"] = "x",
        measurement_noise: float | Sequence[float] | None = None,
        ignore_input: bool = False,
        monitor: bool = False,
        known_start: bool = False,
        uncertainty: bool = False,
        compiled: bool | None = None,
    ) -> None:
        if not isinstance(env, gym.Env):
            raise ValueError(
                f"KKLObservation needs a gymnasium.Env (for vectors: KKLVectorObservation), got {shown(env)}"
            )
        base, artifact = env.unwrapped, None if observer is None else Artifact.read(resolve(observer))
        # These are the checked arguments, in types that the environment's specification can store.
        how: dict[str, Any] = {
            "estimate": choice("estimate", estimate, ("x", "z")),
            "measurement_noise": measurement_noise,
            "monitor": flag("monitor", monitor),
            "known_start": flag("known_start", known_start),
            "uncertainty": flag("uncertainty", uncertainty),
            "compiled": None if compiled is None else flag("compiled", compiled),
        }
        ignore_input = flag("ignore_input", ignore_input)
        estimator: KKLEstimator
        samples: Samples | _SystemSamples
        if artifact is not None and artifact.environment is not None:
            estimator = NamedEstimator(env, env.observation_space, env.action_space, artifact, **how)
            samples = estimator.samples
        elif isinstance(base, KKLEnv):
            estimator = KKLEstimator.of_plant(base.plant, artifact, ignore_input=ignore_input, **how)
            samples = _SystemSamples(env)
        else:
            raise ValueError(
                f"KKLObservation needs a kkl_gym environment, or an observer from rollouts of {source_of(env)}: "
                f"{how_to_make_one(source_of(env))}"
            )
        if measurement_noise is not None:
            how["measurement_noise"] = estimator.observer.measurement_noise
        observer = None if observer is None else os.fspath(observer)
        RecordConstructorArgs.__init__(self, observer=observer, ignore_input=ignore_input, **how)
        gym.Wrapper.__init__(self, env)
        self._estimator, self._samples = estimator, samples
        self.observer = self._estimator.observer
        self.estimate = estimate
        self._trail: deque[list[float]] = deque(maxlen=TRAIL)  # estimates
        # This is stored, because each access to render_mode passes through every wrapper.
        self._rendering = env.render_mode is not None
        # Observers around the environment are numbered from inside; the outermost, which has the last number, draws.
        self._draws = 0
        if isinstance(base, KKLEnv):
            base.drawn_by += 1
            self._draws = base.drawn_by
        self.observation_space = self._estimator.space
        self._low, self._high = estimator.space.low.tolist(), estimator.space.high.tolist()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment, and start the observer at the first sample. Returns the observation and ``info``."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._trail.clear()
        self._estimator.reset(*self._samples.first(obs, info))
        return self._show(info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the environment, and update the observer with the new sample and the input that led to it."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._estimator.advance(*self._samples.next(obs, info, action))
        self._samples.count += 1
        return self._show(info), float(reward), terminated, truncated, info

    def replace_observer(self, observer: str | os.PathLike[str] | Artifact) -> None:
        """From now on, use another map, which must have the same filter. The filter's state stays.

        The specification ``env.spec`` still names the observer with which the wrapper was made. In vectors of
        stable-baselines3, call ``env_method("replace_observer", artifact)``.

        Parameters
        ----------
        observer : str or path or Artifact
            A shipped name, a path if it ends in ``.safetensors``, or an artifact.

        Raises
        ------
        ValueError
            If the noise level is beyond the new map's range, or the monitor in use needs limits that the new map lacks.
        observers.ArtifactError
            If the new map differs in its system, A, B, dt or signals, or the file is missing or damaged.
        """
        self._estimator.replace(observer)

    def render(self) -> np.ndarray | None:
        """Draw the phase portrait with states and estimates so far; other environments render themselves as usual."""
        base = self.unwrapped
        return base.draw(self._trail) if isinstance(base, KKLEnv) else self.env.render()  # type: ignore[return-value]

    def _show(self, info: dict[str, Any]) -> np.ndarray:
        report = self._estimator.report()
        info.update(report)
        if self._rendering and "x_hat" in report:
            self._trail.append(report["x_hat"].tolist())
        if self._rendering and self.render_mode == "human":
            base = self.unwrapped
            if isinstance(base, KKLEnv) and base.drawn_by == self._draws:  # only the outermost observer draws
                base.animate(self._trail)
        if len(self._low) <= _FEW:
            values = self._estimator.listed(report)
            for value, low, high in zip(values, self._low, self._high):
                if not low <= value <= high:
                    break
            else:
                return self._emit(np.array(values, _FLOAT32))
        return self._emit(observation(self._estimator.shown(report), self._estimator.space))

    def _emit(self, obs: np.ndarray) -> np.ndarray:
        # An observer wrapper outside compares this with the observation that it receives.
        self.emitted = obs.tobytes()
        return obs


class ActionRepeat(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Holds each action for ``repeat`` steps and sums their rewards; put it outside :class:`KKLObservation`.

    The observer then sees every sample, while the agent acts less often. The repeat stops early if the episode ends.

    Parameters
    ----------
    env : gymnasium.Env
        The environment.
    repeat : int
        Number of steps for which an action is held.

    Raises
    ------
    ValueError
        If ``env`` is not a gymnasium.Env, or ``repeat`` not a positive integer.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import ActionRepeat, KKLObservation
    >>> env = ActionRepeat(KKLObservation(gym.make("KKLVanDerPol-v0")), 5)
    >>> obs, info = env.reset(seed=0)
    >>> obs, reward, terminated, truncated, info = env.step([0.2])
    >>> info["sample"]
    array(5)
    """

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], repeat: int) -> None:
        if not isinstance(env, gym.Env):
            raise ValueError(f"ActionRepeat needs a gymnasium.Env, got {shown(env)}")
        repeat = integer("repeat", repeat, 1)
        RecordConstructorArgs.__init__(self, repeat=repeat)
        gym.Wrapper.__init__(self, env)
        self.repeat = repeat
        frames = env.metadata.get("render_fps", 30)  # frames a second; 30 is Gymnasium's default
        self.metadata = {**env.metadata, "render_fps": max(1, round(frames / repeat))}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action for ``repeat`` steps. Returns the sum of their rewards, and all else from the last step."""
        total = 0.0
        for _ in range(self.repeat):
            obs, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return obs, total, terminated, truncated, info


__all__ = ["ActionRepeat", "KKLObservation"]
