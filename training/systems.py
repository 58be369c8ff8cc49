"""What is known of each shipped system beyond its equations: spectra, settings, controllers, control tasks.

docs/guides/own_system.md says how to add one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from gymnasium.vector import AutoresetMode

from kkl_gym import KKLVectorEnv, VectorActionRepeat
from kkl_gym.loading import load_function
from kkl_gym.system import Box, System
from kkl_gym.wrappers.vector import VectorEnv
from observers.checks import is_finite
from training.spectrum import evenly_spaced
from training.trajectories.controllers import Controller, linear_quadratic
from training.trajectories.policy import checked_policy

MOST_SAMPLES = 100_000  # of an episode: all of them are kept while it is played


@dataclass(frozen=True)
class ControlTask:
    """Bring a system to its target and hold it there."""

    system: str | System
    measurement_noise: float | tuple[float, ...] = 0.5
    period: float = 0.05
    duration: float = 20.0
    start_box: Box | None = None
    tolerance: float = 0.2
    dt: float = 0.01

    def __post_init__(self) -> None:
        for name in ("period", "duration", "tolerance", "dt"):
            if not is_finite(getattr(self, name)):
                raise ValueError(f"a task's {name} must be a finite number, got {getattr(self, name)!r}")
        if not self.tolerance > 0 or not 0 < self.dt <= self.period <= self.duration:
            raise ValueError(f"a task needs tolerance > 0 and 0 < dt <= period <= duration, got {self}")
        if self.duration / self.dt > MOST_SAMPLES:
            raise ValueError(
                f"an episode has at most {MOST_SAMPLES} samples, got {self.duration} s at dt = {self.dt} s"
            )
        for name, time, unit in (("period", self.period, self.dt), ("duration", self.duration, self.period)):
            if abs(time / unit - round(time / unit)) > 1e-6:
                raise ValueError(f"{name} = {time} s must be a whole multiple of {unit} s")

    @property
    def repeat(self) -> int:
        """Samples in a period."""
        return round(self.period / self.dt)

    @property
    def steps(self) -> int:
        """Actions in an episode."""
        return round(self.duration / self.period)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of ``gym.make`` for the system's environment as the task has it."""
        return {
            "dt": self.dt,
            "measurement_noise": self.measurement_noise,
            "start_box": self.start_box,
            "max_episode_steps": self.steps * self.repeat,
        }

    def make(
        self,
        num_envs: int,
        wrap: Callable[[VectorEnv], VectorEnv] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> VectorEnv:
        """The task as a vector environment that acts once a period."""
        env: VectorEnv = KKLVectorEnv(self.system, num_envs, **self.options, autoreset_mode=AutoresetMode.DISABLED)
        return VectorActionRepeat(env if wrap is None else wrap(env), self.repeat, autoreset_mode)


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
    task: ControlTask | None = None
    algorithm: Literal["ppo", "sac"] = "ppo"


def homogeneous(system: System) -> Controller:
    """The feedback u = b x1 - 2 (x2 + cbrt(a x1)), cut at the input bound, for x1' = a x2^3, x2' = -b x1 + u.

    The linearisation at the origin cannot be stabilised, so there is no linear law. With the drift's -b x1 cancelled,
    x2 follows -cbrt(a x1), on which x1' = -a^2 x1.
    """
    (u_max,) = system.u_max
    a, b = (system.parameters[name] for name in ("a", "b"))

    def act(x: np.ndarray) -> np.ndarray:
        x1, x2 = x[:, :1], x[:, 1:]
        action: np.ndarray = np.clip((b * x1 - 2.0 * (x2 + np.cbrt(a * x1))) / u_max, -1.0, 1.0)
        return action

    return act


PROFILES: dict[str, Profile] = {
    "reverse_duffing": Profile(
        eigenvalues=evenly_spaced(13, -0.2, -8.0),
        # The paper's: no two of its motions part or fall together.
        spinn_settings={"eigenvalues": tuple(np.linspace(-1.5, -3.0, 5).tolist())},
        controller=homogeneous,
        fault_deadline=10.0,  # about a period at amplitude 1
        # Marginally stable: an agent that does not know the state cannot take energy out.
        task=ControlTask("reverse_duffing", period=0.1),
        algorithm="sac",
    ),
    "van_der_pol": Profile(
        # Fast ones follow the jumps of y, slow ones average its noise. Their number and ends are as measured, by the
        # errors of trained observers.
        eigenvalues=evenly_spaced(15, -0.4, -20.0),
        # Slower modes have a rougher T; more of them average more of the noise.
        spinn_settings={
            "eigenvalues": evenly_spaced(11, -4.0, -16.0),
            "noise_free_share": 0.2,
            "high_noise_emphasis": 4.5,
        },
        # Noise hides its phase most of all: more samples at high noise help. No input within its bound leads the
        # oscillator out of X, so stronger ones do.
        settings={"lead_in_input": 4.0, "noise_free_share": 0.05, "high_noise_emphasis": 4.0},
        # Of a T_inv that stands alone. Slow complex modes at frequencies of y average its noise.
        large_settings={
            "pairs": ((-0.1, 0.718), (-0.1, 2.128), (-0.1, 0.6836), (-0.3, 0.718)),
            "inverse_steps": 24000,
            "learning_rate": 2.5e-3,
        },
        fault_deadline=8.9,  # a period
        # The target is unstable. Starts keep to |x1| < 3: beyond it a slow manifold holds the motion under any input.
        task=ControlTask("van_der_pol", start_box=((-3, 3), (-6, 6))),
    ),
    "rossler": Profile(
        eigenvalues=evenly_spaced(13, -0.4, -8.0),
        # Real modes hardly tell its three parameters apart under noise; slow pairs at frequencies of y do: with
        # parameters as states and all of them 10 % off, the error of the best decoder falls from 2.3 to 1.9 % by the
        # first two. On validation runs short trainings gained a little by the third, and by a wider network. More
        # batches and twice the trajectories are worth 3 % on plants that are 10 % off.
        uncertain_settings={
            "pairs": ((-0.1, 1.05), (-0.1, 0.81), (-0.3, 1.05)),
            "width": 192,
            "inverse_steps": 48_000,
            "trajectories": 8000,
        },
        spinn_settings={"eigenvalues": evenly_spaced(9, -3.0, -20.0)},
        fault_deadline=2.0,
        task=ControlTask("rossler", period=0.1, duration=30.0),
    ),
    "lorenz": Profile(
        eigenvalues=evenly_spaced(13, -1.5, -25.0),  # faster than the others', as its flow is
        spinn_settings={"eigenvalues": evenly_spaced(9, -9.0, -40.0)},
        settings={"measurement_noise_max": 3.0},  # its output is the largest of the four
        fault_deadline=2.0,
        task=ControlTask("lorenz", duration=5.0),  # the input is weak
    ),
}


def profile(system: System) -> Profile:
    """What is known of a system."""
    return PROFILES.get(system.name, Profile())


def controller(system: System) -> Controller:
    """A feedback that brings a system to its target.

    It is the saturated linear-quadratic regulator, or the law that the system's profile names.
    """
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs to control it by")
    return profile(system).controller(system)


def named_policy(system: System, name: str) -> Controller:
    """A policy under which motions of a system are simulated."""
    if name != "controller":
        return checked_policy(load_function(name), system, name)
    try:
        return checked_policy(controller(system), system, name)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"no linear-quadratic regulator holds {system.name} at its target {system.target} ({error}): set the "
            "target, or give a policy of your own as script.py:function"
        ) from error
