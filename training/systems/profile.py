"""What the package knows of a system beyond its equations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from kkl_gym.system import System
from training.systems.task import Task
from training.trajectories.controllers import Controller, linear_quadratic


@dataclass(frozen=True)
class Profile:
    """What is chosen for one system; the defaults serve any.

    docs/guides/own_system.md explains them on an example.
    """

    eigenvalues: tuple[float, ...] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    large_settings: Mapping[str, Any] = field(default_factory=dict)
    uncertain_settings: Mapping[str, Any] = field(default_factory=dict)
    spinn_settings: Mapping[str, Any] = field(default_factory=dict)
    controller: Callable[[System], Controller] = linear_quadratic
    fault_deadline: float | None = None
    task: Task | None = None
    algorithm: Literal["ppo", "sac"] = "ppo"
    agent_observer: str | None = None
    second_noise: float | None = None
    printed: Mapping[str, float] = field(default_factory=dict)
