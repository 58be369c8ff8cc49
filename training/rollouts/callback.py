"""A callback of stable-baselines3 that refits an observer on an agent's own episodes while the agent learns."""

import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from kkl_gym import KKLObservation, KKLVectorObservation
from observers import Artifact, KKLObserver
from observers.checks import integer, shown
from observers.samples import check_replacement
from training.config import Config, settings_of
from training.lessons import train
from training.maps.coordinates import settling_time
from training.records import Record, Signals, check_dt, resampled
from training.records.checks import check_alike
from training.records.record import ROLES
from training.sources.recorded import OF_THE_FILTER, RecordedSource, recorded_errors

QUICK = {"members": 1, "inverse_steps": 1000}  # a shorter training than the first, as there are many refits
LONGEST = 250  # most steps in a piece of an episode (two settling times if longer); whole pieces are held out


@dataclass(frozen=True)
class Refit:
    """A refit: the observer in use afterwards, whether it is new, held-out errors before and after, steps so far."""

    artifact: Artifact
    taken: bool
    before: float
    error: float
    steps: int

    def __str__(self) -> str:
        """Format the errors on one line."""
        errors = f"error {self.error:.3g}, before {self.before:.3g}" if self.taken else f"error still {self.error:.3g}"
        return f"refitted the observer at step {self.steps}: {errors}"


class KKLTrainingCallback(BaseCallback):
    """Refits the observer in :class:`kkl_gym.KKLObservation` or KKLVectorObservation on the learning agent's episodes.

    An observer is accurate where its rollouts have been, but an agent in training goes elsewhere. A refit learns T_inv,
    the covariances and the model of the motion again, from all kept episodes but a held-out share. The new observer
    replaces the old one unless the new one's error on that share is larger. Filters keep their states. So that no
    on-policy batch mixes observers, refits take place only before a rollout or, with ``rehearsal``, as ``learn`` ends.
    A refit needs a kept and a held-out episode of at least the filter's settling time; else the callback warns.

    The logger receives ``kkl/error``, the held-out error of the observer in use (root mean square, in standard
    deviations of the signals), and ``kkl/error_before``, that of the observer before the refit.

    Parameters
    ----------
    every : int, default 5000
        Steps of all environments together between refits.
    keep : int, default 100_000
        Number of steps to keep; older steps are dropped.
    records : sequence of training.records.Record, optional
        Earlier episodes, the oldest first, such as those that the observer was learned from. Their steps count among
        the kept ones, but are never held out.
    rehearsal : int, default 0
        Further steps at the end of each call of ``learn``, without exploration; a last refit follows.
    outputs : str, default "y"
        Key of ``info`` that holds the outputs to learn from. By default these are the outputs that the observer saw,
        noise included, and the map's noise level 0 stands for that noise.
    path : str or path, optional
        A ``.safetensors`` file to which each refit writes the observer in use, whole or not at all.
    on_refit : callable, optional
        Called with each :class:`Refit`.
    verbose : int, default 0
        Whether refits are printed, as for other callbacks.
    **settings : object
        Settings of :class:`training.Config` that replace those of the observer's training; by default one network and
        1,000 batches. Settings of the filter, such as eigenvalues, dt and inputs, cannot change.

    Attributes
    ----------
    artifact : Artifact
        The observer in use, available once the training begins.

    Raises
    ------
    ValueError
        If an argument is invalid. At the beginning of the training, if an environment has no observer, if
        observers differ or were not learned from rollouts, or if a record is of another plant. At a step, if ``info``
        lacks the hidden signals, or a wrapper skips samples.
    """

    artifact: Artifact
    _gathering: "Gathering"

    def __init__(
        self,
        every: int = 5000,
        *,
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
        if not isinstance(records, Sequence) or not all(isinstance(record, Record) for record in records):
            raise ValueError(f"records must be a list of training.records.Record, got {shown(records)}")
        if path is not None and not (isinstance(path, str | os.PathLike) and os.fspath(path).endswith(".safetensors")):
            raise ValueError(f"path must end in .safetensors, got {shown(path)}")
        if on_refit is not None and not callable(on_refit):
            raise ValueError(f"on_refit must be a function of a Refit, got {shown(on_refit)}")
        if fixed := [name for name in OF_THE_FILTER if name in settings]:
            raise ValueError(f"{', '.join(fixed)} cannot change, as the filter stays: learn another observer instead")
        Config("input-aware", eigenvalues=(-1.0,), **settings)  # invalid settings raise here, not at the first refit
        self._every, self._keep = integer("every", every, 1), integer("keep", keep, 1)
        self._before, self._rehearsal, self._outputs = tuple(records), integer("rehearsal", rehearsal, 0), outputs
        self._path, self._on_refit, self._settings = path, on_refit, settings
        self._next = self._every

    def _init_callback(self) -> None:
        used, _ = _in_use(self.training_env)
        artifact = used[0].artifact
        if artifact.environment is None or artifact.signals is None:
            raise ValueError(
                f"the observer {artifact.system!r} in use was not learned from rollouts, and cannot be refitted; learn "
                "one by training.learn, or by kkl-gym record and kkl-gym train"
            )
        config = settings_of(artifact.training, **QUICK | self._settings | {"tracking": artifact.motion is not None})
        if artifact.inverse.error_covariance is not None and not config.held_out:
            raise ValueError("covariances are calibrated on held-out episodes: held_out must be positive, got 0")
        for observer in used:
            check_replacement(artifact, observer.artifact)
            level, largest = observer.measurement_noise, config.measurement_noise_max
            if np.any(np.asarray(level) > np.asarray(largest)):
                raise ValueError(f"measurement_noise_max = {largest} is less than the noise {level} in use")
        if hasattr(self, "_gathering"):
            check_replacement(self.artifact, artifact)
        else:
            self._gathering = Gathering(
                artifact, keep=self._keep, held_out=config.held_out, outputs=self._outputs, before=self._before
            )
        self.artifact, self._config = artifact, config
        # A tracking observer is judged under the noise that it sees, which the recorded outputs may lack.
        self._level = used[0].measurement_noise if self._outputs != "y" and artifact.motion is not None else 0.0

    def _on_training_start(self) -> None:
        for row in range(self.training_env.num_envs):
            self._gathering.begin(row, {})  # the next sample need not be an episode's first

    def _on_step(self) -> bool:
        self._add(self.locals["infos"], self.locals["dones"])
        return True

    def _on_rollout_start(self) -> None:
        if self._gathering.steps >= self._next:
            self._refit_where_possible()

    def _on_training_end(self) -> None:
        if not self._rehearsal:
            return
        env, scaling = self.training_env, self.model.get_vec_normalize_env()
        learns = scaling is not None and scaling.training
        if scaling is not None:
            scaling.training = False  # the scales of observations must stay those of the training
        try:
            observations, state, dones = env.reset(), None, np.ones(env.num_envs, dtype=bool)
            self._add((), dones)
            for _ in range(math.ceil(self._rehearsal / env.num_envs)):
                actions, state = self.model.predict(observations, state, dones, deterministic=True)  # type: ignore[arg-type]
                observations, _, dones, infos = env.step(actions)
                self._add(infos, dones)
        finally:
            if scaling is not None:
                scaling.training = learns
        self.model.set_env(env)  # makes the next call of learn reset the environment
        self._refit_where_possible()

    def _add(self, infos: Sequence[dict[str, Any]], dones: Sequence[bool] | np.ndarray) -> None:
        """Add a step of all environments, or their reset, for which ``infos`` is empty."""
        for row, done in enumerate(dones):
            if infos:
                self._gathering.add(row, infos[row])
            if done:
                self._gathering.begin(row, self.training_env.unwrapped.reset_infos[row])

    def _refit_where_possible(self) -> None:
        self._next = self._gathering.steps + self._every
        kept, held_out = self._gathering.records()
        memory = settling_time(self.artifact.filter)
        needed = (kept, held_out) if self._config.held_out else (kept,)
        if all(any(record.duration >= memory for record in records) for records in needed):
            self._refit(kept, held_out)
        else:
            warnings.warn(
                f"the observer in use stays: no kept or no held-out episode lasts {memory:.3g} s, the settling time of "
                "its filter; make episodes longer, or learn the first observer with faster eigenvalues",
                stacklevel=2,
            )

    def _refit(self, kept: list[Record], held_out: list[Record]) -> None:
        old = self.artifact
        with torch.random.fork_rng():  # a refit does not change the agent's random numbers
            new = train(RecordedSource(kept, self._config, old.system, held_out=held_out, C=old.C)).artifact
        if (old.motion is not None and new.motion is None) or (
            old.inverse.error_covariance is not None and new.inverse.error_covariance is None
        ):
            warnings.warn(
                "the observer in use stays: too few steps are held out, or the new one does not track", stacklevel=2
            )
            return
        before, after = (_rms(recorded_errors(each, held_out, measurement_noise=self._level)) for each in (old, new))
        taken = not after > before
        if taken:
            self.artifact = new
            _in_use(self.training_env)[1](new)
        if self._path is not None:
            self.artifact.save(self._path)
        refit = Refit(self.artifact, taken, before, after if taken else before, self._gathering.steps)
        self.logger.record("kkl/error", refit.error)
        self.logger.record("kkl/error_before", before)
        if self.verbose:
            print(refit)
        if self._on_refit is not None:
            self._on_refit(refit)


def _in_use(env: VecEnv) -> tuple[list[KKLObserver], Callable[[Artifact], object]]:
    """Return the observers in use and the function that replaces them; ValueError if an environment has none."""
    inside = getattr(env.unwrapped, "env", None)  # a vector environment of Gymnasium
    while isinstance(inside, gym.vector.VectorWrapper):
        if isinstance(inside, KKLVectorObservation):
            return [inside.observer], inside.replace_observer
        inside = inside.env
    if not all(env.env_is_wrapped(KKLObservation)):
        raise ValueError(
            "KKLTrainingCallback refits the observers of kkl_gym.KKLObservation, and the environment has none: wrap "
            'each environment, as in KKLObservation(gym.make(ID), "observer.safetensors")'
        )
    return env.get_attr("observer"), partial(env.env_method, "replace_observer")


def _rms(errors: Mapping[str, float]) -> float:
    """Return the root mean square of the errors of all hidden signals that move, or NaN."""
    known = [error for error in errors.values() if not math.isnan(error)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else math.nan


@dataclass
class _Piece:
    """Samples of one environment since a reset, or since its episode was cut."""

    name: str
    held_out: bool
    y: list[np.ndarray] = field(default_factory=list)
    x: list[np.ndarray] = field(default_factory=list)
    u: list[np.ndarray] = field(default_factory=list)
    sample: int = 0  # number of the last sample


class Gathering:
    """Collects episodes of several environments as records, from the signals in ``info``."""

    def __init__(
        self, artifact: Artifact, *, keep: int, held_out: float, outputs: str = "y", before: Sequence[Record] = ()
    ) -> None:
        names, self._environment = artifact.signals or {}, artifact.environment or {}
        self._signals = Signals("t", *(tuple(names[role]) for role in ROLES.values()))
        self._outputs, self._dt, self._nx = outputs, artifact.filter.dt, artifact.nx
        self._longest = longest = max(LONGEST, 2 * math.ceil(settling_time(artifact.filter) / self._dt))
        self._keep, self._share = keep, held_out
        self._pieces, self._open = list[_Piece](), dict[int, _Piece]()  # all, oldest first; open ones by environment
        self._made = self.steps = 0
        check_dt(before, self._dt)
        for record in before:
            if record.x is None:
                raise ValueError(f"{record.name}: no hidden states were recorded, but a refit needs them")
            known = {role: names[role] for role in ROLES.values() if artifact.nu or role != "inputs"}
            check_alike(record, known, self._environment, "the observer's rollouts")
            y, x, u = (getattr(resampled(record, self._dt), letter) for letter in "yxu")
            u = u if self._signals.inputs else np.zeros((len(y), 0))
            for begin in range(0, len(y) - 1, longest):
                rows, steps = slice(begin, begin + longest + 1), slice(begin, min(begin + longest, len(y) - 1))
                self._pieces.append(_Piece(record.name, False, [*y[rows]], [*x[rows]], [*u[steps]]))

    def begin(self, row: int, info: Mapping[str, Any]) -> None:
        """Begin an episode, with its first sample if ``info`` holds one."""
        piece = self._new(row)
        if self._outputs in info:
            piece.y, piece.x = [np.array(info[self._outputs])], [info.get("x", np.full(self._nx, np.nan))]

    def add(self, row: int, info: Mapping[str, Any]) -> None:
        """Add the sample after a step."""
        if missing := [key for key in (self._outputs, "u", "x", "sample") if key not in info]:
            raise ValueError(
                f"info of environment {row} has no {', '.join(map(repr, missing))}: KKLObservation gives the true "
                f"{', '.join(self._signals.hidden)} as 'x' if the environment inside provides them at each step; "
                f"training.agents.SB3VecEnv passes on only info_keys: make them {(self._outputs, 'u', 'x', 'sample')}"
            )
        piece, sample = self._open[row], int(info["sample"])
        if piece.y and sample != piece.sample + 1:
            raise ValueError(
                f"environment {row} showed sample {sample} after {piece.sample}: a refit needs all samples, so leave "
                "out wrappers that skip steps, such as ActionRepeat"
            )
        if len(piece.u) == self._longest:
            piece = self._new(row, piece.y[-1:], piece.x[-1:])
        if piece.y:
            piece.u.append(info["u"])
        piece.y.append(np.array(info[self._outputs]))
        piece.x.append(info["x"])
        piece.sample = sample
        self.steps += 1

    def records(self) -> tuple[list[Record], list[Record]]:
        """Drop the oldest closed pieces beyond ``keep`` steps; return kept and held-out records, open ones included."""
        total, first = 0, len(self._pieces)
        while first and (not total or total + len(self._pieces[first - 1].u) <= self._keep):
            first -= 1
            total += len(self._pieces[first].u)
        self._pieces[:first] = [each for each in self._pieces[:first] if id(each) in map(id, self._open.values())]
        known = [piece for piece in self._pieces if piece.u and not np.isnan(piece.x).all()]
        kept, held_out = ([self._record(piece) for piece in known if piece.held_out == held] for held in (False, True))
        return kept, held_out

    def _new(self, row: int, y: Sequence[np.ndarray] = (), x: Sequence[np.ndarray] = ()) -> _Piece:
        """Begin a piece, or restart the open one if it has no step yet."""
        if row not in self._open or self._open[row].u:
            held_out = math.ceil(self._made * self._share) > math.ceil((self._made - 1) * self._share)
            self._open[row] = _Piece(f"{self._environment['id']}, piece {self._made}", held_out)
            self._pieces.append(self._open[row])
            self._made += 1
        piece = self._open[row]
        piece.y, piece.x, piece.sample = [*y], [*x], 0
        return piece

    def _record(self, piece: _Piece) -> Record:
        t, y, x = self._dt * np.arange(len(piece.y)), np.stack(piece.y), np.stack(piece.x)
        u, env = np.stack([*piece.u, piece.u[-1]]) if self._signals.inputs else None, self._environment
        return Record(piece.name, t, y, u, x, self._signals, env["id"], env)


__all__ = ["KKLTrainingCallback", "Refit"]
