"""The interface of all sources of motions, which are simulated, recorded, or rollouts of an environment."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from observers import Artifact, Equations, LinearFilter
from training.config import Config
from training.trajectories.motions import Pairs as Pairs
from training.trajectories.motions import Report as Report

OF_MEDIAN = 1.4826  # ratio of a normal distribution's standard deviation to the median of its absolute deviations


@dataclass(frozen=True)
class Runs:
    """Motions to calibrate on, without added measurement noise, at one or two levels of process noise.

    ``sound`` is True if the plant certainly had no faults.

    Shapes: ``x`` (steps + 1, n, nx), NaN where unknown, ``y`` (steps + 1, n, ny), ``u`` (steps, n, nu),
    ``process_noise`` (n,), ``usual`` (n,): True for starts in X, and for all recorded motions.
    """

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray
    process_noise: np.ndarray
    usual: np.ndarray
    sound: bool = False


class TooFewRunsError(ValueError):
    """Too few motions are held out for calibration."""


@dataclass(frozen=True)
class Increments:
    """States (n, nx), inputs (n, nu), and changes of the states over one sampling interval (n, nx)."""

    x: np.ndarray
    u: np.ndarray
    change: np.ndarray


class Source(Protocol):
    """The interface by which a training gets motions: simulated, recorded, or rollouts of an environment.

    Motions for calibration are never those for training.

    Attributes
    ----------
    name : str
        Name of the observer.
    config : Config
        Settings of the training.
    nx, ny, nu : int
        Numbers of states, of outputs, and of the inputs that the observer takes.
    dt : float
        Sampling interval in seconds.
    pace : float
        Time scale of the signals in seconds.
    process_noise : float
        Largest level of process noise in training; 0 if T_inv takes no level of process noise.
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
        """Return the values that identify the source in fingerprints and in the files of a run."""

    def facts(self) -> dict[str, Any]:
        """Return the arguments of :class:`observers.Artifact` that describe the source."""

    def sampling(self, linear: LinearFilter) -> dict[str, Any]:
        """Return arguments of :class:`training.maps.inverse.TrajectorySampler` that depend on the source."""

    def pairs(self, linear: LinearFilter, *, free: bool = False, report: Report) -> Pairs:
        """Return states of training motions and of a filter along them; ``free``: simulated motions without inputs."""

    def runs(self, *, report: Report) -> Runs:
        """Return motions for calibration; raise TooFewRunsError if too few are held out."""

    def equations(self) -> Equations:
        """Return the equations of motion; raise ValueError with the reason if a learned Flow must replace them."""

    def increments(self, *, report: Report) -> tuple[Increments, Increments]:
        """Return changes of the state over one sampling interval: for learning a flow, and for measuring its error."""

    def tracking(self) -> dict[str, Any]:
        """Return arguments of observers.Motion that the source fixes; raise ValueError if tracking is impossible."""

    def judged(self, artifact: Artifact) -> dict[str, Any]:
        """Return errors on held-out motions, for the training metadata of the artifact."""
