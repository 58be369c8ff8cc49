"""What the package knows of a system beyond its equations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from kkl_gym.system import System
from training.systems.task import ControlTask
from training.trajectories.controllers import Controller, linear_quadratic


@dataclass(frozen=True)
class Profile:
    """What is chosen for one system; the defaults serve any.

    docs/guides/own_system.md explains them on an example.

    Parameters
    ----------
    eigenvalues : tuple of float, optional
        Real eigenvalues of A for an input-aware map, in 1/s; by default they follow from how fast f changes in X, see
        :func:`training.presets.eigenvalues`.
    settings : mapping of str to object
        Settings of :class:`training.config.Config`, where an input-aware map's differ from the preset's.
    uncertain_settings : mapping of str to object
        The same where parameters are uncertain, beside those of ``settings`` and before them.
    spinn_settings : mapping of str to object
        Those of a map of the paper's pipeline, its eigenvalues among them. These must be fast enough for T to be
        smooth; by default :func:`training.smoothness.smooth_spectrum` finds them.
    controller : callable
        Makes of the system the feedback that drives closed-loop data and that agents are measured against.
    fault_deadline : float, optional
        Seconds within which a faulty sensor should be noticed; by default a fifth of the run.
    task : ControlTask, optional
        What agents are to do; by default a task with the defaults of its class.
    algorithm : {"ppo", "sac"}
        What agents are trained with.
    agent_observer : str, optional
        Shipped map on which agents act; by default the system's newest.
    second_noise : float, optional
        A further level of measurement noise at which agents are compared; by default there is none.
    printed : mapping of str to float
        For some methods, the component-wise SMAPE in % that the notebooks print that were released with the paper:
        after the first 20 %, without noise, from starts in 1.5X without X.
    """

    eigenvalues: tuple[float, ...] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    uncertain_settings: Mapping[str, Any] = field(default_factory=dict)
    spinn_settings: Mapping[str, Any] = field(default_factory=dict)
    controller: Callable[[System], Controller] = linear_quadratic
    fault_deadline: float | None = None
    task: ControlTask | None = None
    algorithm: Literal["ppo", "sac"] = "ppo"
    agent_observer: str | None = None
    second_noise: float | None = None
    printed: Mapping[str, float] = field(default_factory=dict)
