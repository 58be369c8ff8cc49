"""What is known of each shipped system beyond its equations: spectra, settings, controllers.

docs/guides/own_system.md says how to add one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kkl_gym.loading import load_function
from kkl_gym.system import System
from observers.names import suggestion
from training.spectrum import evenly_spaced
from training.trajectories.policies import Controller, checked_policy, linear_quadratic


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
    ),
    "lorenz": Profile(
        eigenvalues=evenly_spaced(13, -1.5, -25.0),  # faster than the others', as its flow is
        spinn_settings={"eigenvalues": evenly_spaced(9, -9.0, -40.0)},
        settings={"measurement_noise_max": 3.0},  # its output is the largest of the four
        fault_deadline=2.0,
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
    if ":" not in name and name != "controller":
        raise ValueError(
            f"unknown policy {name!r}{suggestion(name, ['controller'])}: it is controller, or script.py:function"
        )
    if name != "controller":
        return checked_policy(load_function(name), system, name)
    try:
        return checked_policy(controller(system), system, name)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"no linear-quadratic regulator holds {system.name} at its target {system.target} ({error}): set the "
            "target, or give a policy of your own as script.py:function"
        ) from error
