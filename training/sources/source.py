"""Where motions come from: what every source gives, whichever it is."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from observers import Artifact, Equations, LinearFilter
from training.config import Config
from training.trajectories.motions import Pairs

Report = Callable[[float], object]
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

    def part(self, rows: slice) -> "Increments":
        """Some of them."""
        return replace(self, x=self.x[rows], u=self.u[rows], change=self.change[rows])


class Source(Protocol):
    """Simulated motions of a system, recorded ones, or rollouts of an environment.

    Lessons take motions from a source and never ask where these come from. Motions to calibrate on are not those to
    train on.

    Attributes
    ----------
    name : str
        Of the observer.
    nx, ny, nu : int
        Numbers of states, of outputs, and of the inputs that the observer takes.
    dt : float
        Sampling interval in seconds.
    pace : float
        Seconds in which signals change.
    process_noise : float
        Usual level of process noise, of which T_inv is informed; 0 where there is none.
    config : Config
        How the observer is learned.
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
        """What identifies the source, for fingerprints and the files of a run."""
        ...

    def facts(self) -> dict[str, Any]:
        """Arguments of :class:`observers.Artifact` that describe the source."""
        ...

    def sampling(self, linear: LinearFilter) -> dict[str, Any]:
        """How batches are drawn: arguments of :class:`training.maps.inverse.TrajectorySampler`."""
        ...

    def pairs(self, linear: LinearFilter, *, free: bool = False, report: Report) -> Pairs:
        """Motions to train T_inv on, with a filter beside them; ``free`` ones without input."""
        ...

    def runs(self, *, report: Report) -> Runs:
        """Motions to calibrate on."""
        ...

    def equations(self) -> Equations:
        """The equations of motion; ValueError with the reason where a flow is to be learned in their place."""
        ...

    def increments(self, *, report: Report) -> tuple[Increments, Increments]:
        """Pairs of states a sample apart, to learn a flow from and to judge it by."""
        ...

    def tracking(self) -> dict[str, Any]:
        """Arguments of :class:`observers.Motion`, but for equations and flow; ValueError where nothing can track."""
        ...

    def judged(self, artifact: Artifact) -> dict[str, Any]:
        """Errors on motions that are held out, for the artifact's account of its training."""
        ...


__all__ = ["OF_MEDIAN", "Increments", "Pairs", "Report", "Runs", "Source", "TooFewRunsError"]
