"""Where motions come from: equations, records, or rollouts of an environment; and what every source gives."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from observers import Artifact, Equations, LinearFilter
from training.config import Config
from training.trajectories.motions import Pairs as Pairs
from training.trajectories.motions import Report as Report

OF_MEDIAN = 1.4826  # a normal distribution's standard deviation, over the median of its absolute values


@dataclass(frozen=True)
class Runs:
    """Whole motions, measured without noise.

    There are two levels of process noise at most. Usual motions start in X; a sound plant has no faults.

    Shapes: ``x`` (steps + 1, n, nx), NaN where unknown, ``y`` (steps + 1, n, ny), ``u`` (steps, n, nu),
    ``process_noise`` (n,), ``usual`` (n,): True from X, False from beyond.
    """

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray
    process_noise: np.ndarray
    usual: np.ndarray
    sound: bool = False


class TooFewRunsError(ValueError):
    """Too little is held out to calibrate on."""


@dataclass(frozen=True)
class Increments:
    """States (n, nx), inputs (n, nu), and how states change over a sample, (n, nx)."""

    x: np.ndarray
    u: np.ndarray
    change: np.ndarray


class Source(Protocol):
    """Simulated motions of a system, recorded ones, or rollouts of an environment.

    Lessons take motions from a source and never ask where these come from. Motions to calibrate on are not those to
    train on.

    Attributes
    ----------
    name : str
        Of the observer.
    config : Config
        How the observer is learned.
    nx, ny, nu : int
        Numbers of states, of outputs, and of the inputs that the observer takes.
    dt : float
        Sampling interval in seconds.
    pace : float
        Seconds in which signals change.
    process_noise : float
        Usual level of process noise, an input of T_inv; 0 without process noise.
    """

    name: str
    config: Config
    nx: int
    ny: int
    nu: int
    dt: float
    pace: float
    process_noise: float

    def identity(self) -> dict[str, Any]:
        """Return the values that identify the source, for fingerprints and the files of a run."""

    def facts(self) -> dict[str, Any]:
        """Return arguments of :class:`observers.Artifact` that describe the source."""

    def sampling(self, linear: LinearFilter) -> dict[str, Any]:
        """Return arguments of :class:`training.maps.inverse.TrajectorySampler`."""

    def pairs(self, linear: LinearFilter, *, free: bool = False, report: Report) -> Pairs:
        """Return motions to train T_inv on, with a filter beside them; ``free`` ones without input."""

    def runs(self, *, report: Report) -> Runs:
        """Return motions to calibrate on."""

    def equations(self) -> Equations:
        """Return the equations of motion; ValueError with the reason where a flow is to be learned in their place."""

    def increments(self, *, report: Report) -> tuple[Increments, Increments]:
        """Return pairs of states a sample apart, to learn a flow from and to judge it by."""

    def tracking(self) -> dict[str, Any]:
        """Return arguments of :class:`observers.Motion` beside equations or flow; ValueError if nothing can track."""

    def judged(self, artifact: Artifact) -> dict[str, Any]:
        """Return errors on motions that are held out, for the artifact's account of its training."""
