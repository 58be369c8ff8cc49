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

    eigenvalues : real eigenvalues of A for an input-aware map, in 1/s; None follows from how fast f changes in X.
    settings : of :class:`training.config.Config`, where an input-aware map's differ from the preset's.
    controller : makes the feedback that drives closed-loop data and that agents are measured against.
    fault_deadline : seconds within which a faulty sensor should be noticed; None is a fifth of the run.
    task : what agents are to do; None is :class:`ControlTask` with its defaults.
    algorithm : what agents are trained with.
    agent_observer : shipped map on which agents act; None is the system's newest.
    second_noise : a further level of measurement noise at which agents are compared.
    printed : component-wise SMAPE in % after the first 20 %, without noise, from starts in 1.5X \\ X, by method: what
        the notebooks print that were released with the paper.
    """

    eigenvalues: tuple[float, ...] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    controller: Callable[[System], Controller] = linear_quadratic
    fault_deadline: float | None = None
    task: ControlTask | None = None
    algorithm: Literal["ppo", "sac"] = "ppo"
    agent_observer: str | None = None
    second_noise: float | None = None
    printed: Mapping[str, float] = field(default_factory=dict)
