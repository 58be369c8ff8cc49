"""Observers learned from rollouts of an environment, and run inside the same environment."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym.identity import check_autoreset, check_identity, source_of
from kkl_gym.named import InputReader, Reader, observed, resolved
from kkl_gym.signals import Inputs
from kkl_gym.wrappers.estimator import KKLEstimator, with_deviations
from observers import Artifact, ArtifactError
from observers.checks import choice, flag


class NamedEstimator(KKLEstimator):
    """An observer from rollouts; its observations hold the measured outputs beside its estimates."""

    def __init__(
        self,
        env: Any,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        artifact: Artifact,
        *,
        estimate: str = "x",
        uncertainty: bool = False,
        **how: Any,
    ) -> None:
        choice("estimate", estimate, ("x", "z"))
        uncertainty = flag("uncertainty", uncertainty)
        check_autoreset(env)
        check_identity(artifact, env)
        try:
            _check_actions(env, action_space)
            self.samples = Samples(artifact, observation_space, action_space, source=source_of(env))
        except ValueError as error:
            raise ArtifactError(f"the observer {artifact.system!r} does not fit: {error}") from error
        measured, high = self.samples.outputs, np.full(artifact.filter.size, np.inf)
        low, high = _bounds(artifact, observation_space) if estimate == "x" else (-high, high)
        if uncertainty:
            low, high = with_deviations(low, high)
        low, high = np.concatenate([measured.low, low]), np.concatenate([measured.high, high])
        with np.errstate(over="ignore"):  # bounds beyond float32 become infinite
            space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        super().__init__(artifact, space, estimate=estimate, uncertainty=uncertainty, **how)

    def reset(self, y0: np.ndarray, x0: np.ndarray) -> None:
        """Begin an episode with its first samples; see :class:`KKLEstimator`."""
        self._check_start(x0)
        super().reset(y0, x0)
        self._y, self._held = y0.copy(), y0.copy()

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray) -> None:
        """Begin episodes in some rows; see :class:`KKLEstimator`."""
        self._check_start(x0)
        super().restart(y0, rows, x0)
        self._y[rows] = self._held[rows] = y0

    def _check_start(self, x0: np.ndarray) -> None:
        known = x0.shape[-1] == self.observer.artifact.nx and np.isfinite(x0).all()
        if self._known_start and not known:
            hidden = ", ".join((self.observer.artifact.signals or {})["hidden"])
            raise ValueError(f"known_start: the environment does not show {hidden} at its reset; leave known_start out")

    def advance(self, y: np.ndarray, u: np.ndarray | None, rows: np.ndarray | None = None) -> None:
        """Process samples and the inputs that led to them; see :class:`KKLEstimator`."""
        super().advance(y, u, rows)
        self._y = y.copy() if rows is None else np.where(rows[..., None], y, self._y)
        self._held = np.where(np.isnan(self._y), self._held, self._y)

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the entries that :class:`KKLEstimator` adds to ``info``, and the measured ``y``, NaN where missing."""
        return super().report(rows) | {"y": self._y.copy() if rows is None else self._y[rows]}

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return a report's observations: y or its last value, then either z or x_hat with any standard deviations."""
        y = report["y"]
        # A report of some rows has fewer rows than _held, but its y holds no NaN: it is of complete first samples.
        if np.isnan(y).any():
            y = np.where(np.isnan(y), self._held, y)
        return np.concatenate([y, super().shown(report)], axis=-1)

    def listed(self, report: Mapping[str, np.ndarray]) -> list[float]:
        """Return the same as :meth:`shown` for a single sample, as a list."""
        return [*self._held.tolist(), *super().listed(report)]


class Samples:
    """The signals that an observer from rollouts reads from an environment."""

    def __init__(
        self, artifact: Artifact, observation_space: gym.Space[Any], action_space: gym.Space[Any], *, source: str
    ) -> None:
        signals = artifact.signals or {}
        names = resolved(signals["measured"], observation_space, role="measured", source=source)
        self.outputs = Reader(observation_space, names, source=source, missing=True)
        self.inputs = InputReader(action_space, signals["inputs"], source=source)
        self.hidden = _reader_of_hidden(observation_space, signals["hidden"], source)
        self.nx, self._nothing = artifact.nx, np.full(artifact.nx, np.nan)
        self.count = 0

    def first(self, observation: Any, info: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return outputs and hidden signals after a reset; the hidden ones are NaN unless the environment shows all.

        Sets ``sample`` and, if shown, ``x`` in ``info``, as in a KKLEnv.
        """
        self.count = 0
        y, x = self.outputs(observation, info), self.states(observation, info)
        info.pop("x", None)  # the environment's own key may mean something else
        info |= x | {"sample": np.array(0)}
        return y, x.get("x", self._nothing)

    def next(self, observation: Any, info: dict[str, Any], action: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return outputs and inputs of a step; sets ``u``, ``sample`` and, if shown, ``x`` in ``info``."""
        y, u = self.outputs(observation, info), self.inputs(action)
        x = self.states(observation, info)
        info.pop("x", None)
        info |= x | {"u": u, "sample": np.array(self.count + 1)}
        return y, u

    def states(self, observation: Any, info: Mapping[str, Any], batch: tuple[int, ...] = ()) -> dict[str, np.ndarray]:
        """Return the true hidden signals as ``{"x": ...}``; empty unless the environment shows them all."""
        if self.hidden is None:
            return {}
        try:
            return {"x": self.hidden(observation, info, batch)}
        # ValueError: a wrapper inside replaces hidden signals by NaN, or ``info`` lacks them at this step.
        except ValueError:
            return {}


def _reader_of_hidden(space: gym.Space[Any], names: Sequence[str], source: str) -> Reader | None:
    """Return the reader of the hidden signals, or None if the environment does not show them all."""
    try:
        return Reader(space, resolved(names, space, role="hidden", source=source), source=source)
    except ValueError:
        return None


def _check_actions(env: Any, space: gym.Space[Any]) -> None:
    """Raise ValueError if a wrapper inside changes how inputs are scaled, as ClipAction does by its infinite box."""
    base, source = env.unwrapped, source_of(env)
    own = base.single_action_space if isinstance(base, gym.vector.VectorEnv) else base.action_space
    here, there = (Inputs(one, source=source) for one in (space, own))
    if not (np.array_equal(here.low, there.low) and np.array_equal(here.high, there.high)):
        raise ValueError(
            f"{source} takes actions in {own}, but a wrapper between it and the observer takes {space}: the observer "
            "would misread them; put that wrapper outside the observer's"
        )


def _bounds(artifact: Artifact, space: gym.Space[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of the hidden signals: the observation space's, -1 and 1 for cos and sin, else infinite."""
    low, high = np.full(artifact.nx, -np.inf), np.full(artifact.nx, np.inf)
    there = observed(space)
    for i, name in enumerate((artifact.signals or {})["hidden"]):
        if name in there or name.startswith(("cos(", "sin(")):
            of = Reader(space, [name], source="") if name in there else None
            low[i], high[i] = (-1.0, 1.0) if of is None else (of.low[0], of.high[0])
    return low, high
