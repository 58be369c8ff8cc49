"""Observers that are refitted on an agent's own episodes while it learns, with stable-baselines3."""

import math
import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from kkl_gym import KKLObservation, KKLVectorObservation
from observers import Artifact, KKLObserver
from observers.checks import integer, shown
from observers.replacement import check_replacement
from training.config import Config, settings_of
from training.maps.coordinates import settling_time
from training.presets import OF_THE_FILTER, OF_THE_MAPS
from training.records import Record
from training.rollouts.gathering import Gathering
from training.sources.errors import RecordedErrors, recorded_errors
from training.sources.recorded import RecordedSource
from training.train_observer import train

QUICK = {"members": 1, "inverse_steps": 1000}  # a refit comes again and again


@dataclass(frozen=True)
class Refit:
    """What came of a refit."""

    artifact: Artifact
    taken: bool
    before: float
    error: float
    steps: int
    seconds: float

    def __str__(self) -> str:
        """For people, on one line."""
        found = f"error {self.error:.3g} after {self.before:.3g}" if self.taken else f"error still {self.error:.3g}"
        return f"refitted the observer at step {self.steps}: {found} ({self.seconds:.2g} s)"


class KKLTrainingCallback(BaseCallback):
    """Refits the observer in :class:`kkl_gym.KKLObservation` on the episodes of the agent that is being trained.

    Estimates are good where the rollouts have been that the observer was learned from. An agent in training goes
    elsewhere, and in a simulator its hidden signals are seen: every step serves the agent and the observer. The
    environments keep their filters and what these hold; T_inv is replaced, and with it the covariances and the flow.

    A refit fits T_inv anew to all episodes that are kept, but for a share that is held out for good. An observer that
    is worse on that share than the one in use is not taken. Refits take place where an algorithm begins to collect:
    an on-policy one never learns from a batch of two observers, and without ``rehearsal`` there is none after the last
    batch. One is left out while no episode is as long as the filter remembers.

    Logged are ``kkl/error``, the error on held-out episodes of the observer in use (root mean square over standard
    deviation), ``kkl/error_before``, that of the one before, and ``kkl/refit_seconds``.

    Parameters
    ----------
    every : int, default 5000
        Environment steps, of all environments together, from refit to refit.
    first : int, optional
        Steps before the first one; by default ``every``.
    keep : int, default 100_000
        Steps that are kept; older ones are forgotten.
    records : sequence of training.records.Record, optional
        Episodes from before, the oldest first, such as those that the observer was learned from, as
        :func:`training.records.read_records` reads them. They are kept beside the agent's own, and none of them is held
        out. A refit is then left out while no episode that is held out is as long as the filter remembers.
    rehearsal : int, default 0
        Further steps at the end of each call of ``learn``, in which the agent acts without exploration, as it will when
        it is used, and which end in a last refit. An agent that explores goes elsewhere.
    outputs : str, default "y"
        What of ``info`` is recorded as outputs: by default what the observer saw, with whatever noise there was. Where
        an environment tells them without noise, the key under which it does.
    path : str or path, optional
        A ``.safetensors`` file that receives the observer in use at each refit, whole or not at all.
    on_refit : callable, optional
        Told of each :class:`Refit`.
    verbose : int, default 0
        Whether refits are printed, as for other callbacks.
    **settings : object
        Of :class:`training.Config`, where they are to differ from those that the observer was learned with; by default
        one network and 1,000 batches. What makes the filter stays: eigenvalues, dt and inputs.

    Attributes
    ----------
    artifact : Artifact
        The observer in use, from the beginning of the training on.

    Raises
    ------
    ValueError
        If an argument makes no sense. At the beginning of the training, if an environment has no KKLObservation, an
        observer that was not learned from rollouts, or another one than the others, or if a record is of another plant.
        At a step, if ``info`` lacks the hidden signals, or a wrapper skips samples.

    Notes
    -----
    Records hold what the observer saw. Noise that an environment adds is therefore that of the records, to which the
    map's level 0 refers, as for :func:`training.learn`; with ``outputs`` level 0 is no noise.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import KKLObservation
    >>> from stable_baselines3 import PPO
    >>> from training import KKLTrainingCallback
    >>> def learn(path):
    ...     env = KKLObservation(gym.make("Pendulum-v1"), path)
    ...     return PPO("MlpPolicy", env).learn(50_000, KKLTrainingCallback(every=5000, path="newer.safetensors"))
    """

    artifact: Artifact
    _config: Config
    _level: float | tuple[float, ...]
    _gathering: Gathering

    def __init__(
        self,
        every: int = 5000,
        *,
        first: int | None = None,
        keep: int = 100_000,
        records: Sequence[Record] = (),
        rehearsal: int = 0,
        outputs: str = "y",
        path: str | os.PathLike[str] | None = None,
        on_refit: Callable[[Refit], object] | None = None,
        verbose: int = 0,
        **settings: Any,
    ) -> None:
        super().__init__(verbose)
        self._every = integer("every", every, 1)
        self._next = self._every if first is None else integer("first", first, 1)
        self._keep, self._outputs = integer("keep", keep, 1), outputs
        if not isinstance(records, Sequence) or not all(isinstance(record, Record) for record in records):
            raise ValueError(f"records must be a list of training.records.Record, got {shown(records)}")
        self._before = tuple(records)
        self._rehearsal = integer("rehearsal", rehearsal, 0)
        if path is not None and not (isinstance(path, str | os.PathLike) and os.fspath(path).endswith(".safetensors")):
            raise ValueError(f"path must end in .safetensors, got {shown(path)}")
        self._path = None if path is None else Path(path)
        if on_refit is not None and not callable(on_refit):
            raise ValueError(f"on_refit must be a function of a Refit, got {shown(on_refit)}")
        self._on_refit = on_refit
        if fixed := [name for name in OF_THE_FILTER if name in settings]:
            raise ValueError(
                f"{', '.join(fixed)} cannot change: the filter in use stays; learn another observer instead"
            )
        if unknown := [name for name in settings if name not in OF_THE_MAPS]:
            raise ValueError(f"there is no setting {', '.join(unknown)}; there are {', '.join(OF_THE_MAPS)}")
        self._settings = settings

    def _init_callback(self) -> None:
        used = _observers(self.training_env)
        artifact = used[0].artifact
        if artifact.environment is None or artifact.signals is None:
            raise ValueError(
                f"the observer {artifact.system!r} in use was not learned from rollouts, and is not refitted to any; "
                "learn one by training.learn, or by kkl-gym record and kkl-gym train"
            )
        config = settings_of(artifact.training, **QUICK | self._settings | {"tracking": artifact.motion is not None})
        if artifact.inverse.error_covariance is not None and not config.held_out:
            raise ValueError(
                "covariances are calibrated on episodes that are held out: held_out must be positive, got 0"
            )
        for observer in used:
            check_replacement(artifact, observer.artifact)
            level = observer.measurement_noise
            if np.any(np.asarray(level) > np.asarray(config.measurement_noise_max)):
                raise ValueError(
                    f"measurement_noise_max = {config.measurement_noise_max} is less than the noise {level} that the "
                    "observer in use assumes"
                )
        if not hasattr(self, "_gathering"):
            self._gathering = Gathering(
                artifact, keep=self._keep, held_out=config.held_out, outputs=self._outputs, before=self._before
            )
        else:
            check_replacement(self.artifact, artifact)
        self.artifact, self._config = artifact, config
        # An observer that tracks is judged under the noise that it sees, where outputs are recorded without.
        seen = self._outputs != "y" and artifact.motion is not None
        self._level = used[0].measurement_noise if seen else 0.0

    def _on_training_start(self) -> None:
        for row in range(self.training_env.num_envs):
            self._begin(row, goes_on=True)

    def _on_step(self) -> bool:
        self._took(self.locals["infos"], self.locals["dones"])
        return True

    def _took(self, infos: Sequence[dict[str, Any]], dones: Iterable[bool]) -> None:
        """Take in a step of all environments."""
        for row, (info, done) in enumerate(zip(infos, dones, strict=True)):
            self._gathering.add(row, info)
            if done:
                self._begin(row)

    def _on_rollout_start(self) -> None:
        if self._gathering.steps >= self._next:
            self._refit_where_possible()

    def _on_training_end(self) -> None:
        if self._rehearsal:
            for infos, dones in rehearsed(self.model, self._rehearsal):
                if infos:
                    self._took(infos, dones)
                else:
                    for row in range(self.training_env.num_envs):
                        self._begin(row)
            self._refit_where_possible()

    def _refit_where_possible(self) -> None:
        self._next = self._gathering.steps + self._every
        train, held_out = self._gathering.records()
        memory = settling_time(self.artifact.filter)
        # Records from before are long enough to learn from, but not from where the agent is now.
        needed = (train, held_out) if self._before and self._config.held_out else (train,)
        if all(any(record.duration >= memory for record in records) for records in needed):
            self._refit(train, held_out)

    def _begin(self, row: int, *, goes_on: bool = False) -> None:
        """Begin an episode with what its reset said, or with its first step where that is not known."""
        inside = self.training_env.unwrapped  # what lies around does not pass the infos of resets on
        known = _vector_wrapper(self.training_env) is None
        self._gathering.begin(row, inside.reset_infos[row] if known else {}, goes_on=goes_on)

    def _refit(self, train_on: list[Record], held_out: list[Record]) -> None:
        began, old = time.monotonic(), self.artifact
        with torch.random.fork_rng():  # the agent's random numbers stay its own
            source = RecordedSource(train_on, self._config, old.system, held_out=held_out, C=old.C)
            new = train(source).artifact
        lost = (old.motion is not None and new.motion is None) or (
            old.inverse.error_covariance is not None and new.inverse.error_covariance is None
        )
        if lost:
            warnings.warn("the observer in use stays: too little is held out so far to calibrate another", stacklevel=2)
            return
        before, after = (
            _together(recorded_errors(each, held_out, measurement_noise=self._level)) for each in (old, new)
        )
        taken = not after > before
        if taken:
            self.artifact = new
            self._replace()
        if self._path is not None:
            self.artifact.save(self._path)
        found = Refit(
            self.artifact, taken, before, after if taken else before, self._gathering.steps, time.monotonic() - began
        )
        scalars = {"error": found.error, "error_before": before, "refit_seconds": found.seconds}
        for name, value in scalars.items():
            self.logger.record(f"kkl/{name}", value)
        if self.verbose:
            print(found)
        if self._on_refit is not None:
            self._on_refit(found)

    def _replace(self) -> None:
        vector = _vector_wrapper(self.training_env)
        if vector is None:
            self.training_env.env_method("replace_observer", self.artifact)
        else:
            vector.replace_observer(self.artifact)


def rehearsed(model: BaseAlgorithm, steps: int) -> Iterator[tuple[Sequence[dict[str, Any]], np.ndarray]]:
    """Play an agent as it will act, without exploration, in the environments in which it has learned."""
    env: Any = model.get_env()
    with _as_it_is(model.get_vec_normalize_env()):
        observations, state, dones = env.reset(), None, np.ones(env.num_envs, dtype=bool)
        yield (), dones
        for _ in range(math.ceil(steps / env.num_envs)):
            actions, state = model.predict(observations, state, dones, deterministic=True)
            observations, _, dones, infos = env.step(actions)
            yield infos, dones
    model.set_env(env)  # which makes a training that goes on reset it


@contextmanager
def _as_it_is(scaling: VecNormalize | None) -> Iterator[None]:
    """What scales observations learns nothing inside."""
    if scaling is None:
        yield
        return
    before, scaling.training = scaling.training, False
    try:
        yield
    finally:
        scaling.training = before


def _observers(env: VecEnv) -> list[KKLObserver]:
    """The observers in use, ValueError where there are none."""
    vector = _vector_wrapper(env)
    if vector is not None:
        return [vector.observer]
    if not all(env.env_is_wrapped(KKLObservation)):
        raise ValueError(
            "KKLTrainingCallback refits the observers of kkl_gym.KKLObservation, and the environment has none: put "
            'KKLObservation(gym.make(ID), "observer.safetensors") around each'
        )
    return env.get_attr("observer")


def _vector_wrapper(env: VecEnv) -> KKLVectorObservation | None:
    """The wrapper around a vector environment of Gymnasium's under one of stable-baselines3."""
    inside = getattr(env.unwrapped, "env", None)
    while isinstance(inside, gym.vector.VectorWrapper):
        if isinstance(inside, KKLVectorObservation):
            return inside
        inside = inside.env
    return None


def _together(errors: RecordedErrors) -> float:
    """Root mean square of the errors of all hidden signals that move; NaN if none does."""
    known = [error for error in errors.relative.values() if not math.isnan(error)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else math.nan


__all__ = ["KKLTrainingCallback", "Refit", "rehearsed"]
