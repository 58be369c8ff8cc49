"""Choices for a system: its profile, its controller, and the configurations behind the commands' options.

docs/guides/own_system.md shows how to add a profile.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.loading import load_function
from kkl_gym.system import NOISE_SHARE, System
from observers.names import suggestion
from training.config import Config, Pipeline
from training.spectrum import FASTEST_MODE, evenly_spaced, papers_spectrum, smooth_spectrum
from training.trajectories.motions import Controller, checked_policy, linear_quadratic

Preset = Literal["fast", "paper"]
Size = Literal["default", "large"]
# A T_inv that stands alone. By default a tracker does what width, slow complex modes and long training do here.
LARGE: dict[str, Any] = {"width": 128, "trajectories": 4000, "inverse_steps": 18_000}
PAPER: dict[str, Any] = {
    "width": 512, "depth": 4, "activation": "silu", "optimiser": "adam", "batch": 4096, "learning_rate": 1e-3
}  # fmt: skip
SPINN: dict[str, Any] = {
    **LARGE, "forward_steps": 6000, "inverse_steps": 12_000, "box_factor": 2.0, "noise_free_share": 0.35
}  # fmt: skip
PAPER_SPINN: dict[str, Any] = {
    **PAPER, "trajectories": 500, "samples": 5001,
    "forward_steps": 200 * 3_000_000 // 4096, "inverse_steps": 200 * 5_000_000 // 4096,
    "collocation": "box", "scaling": "range", "solved_output_layer": False, "transients": False,
}  # fmt: skip
NOISE_RANGE = 2.0  # largest measurement noise that maps are trained for, over the system's default
# FASTEST_MODE in discrete time, where a step may change everything and the last samples matter most.
FASTEST_OF_STEPS = 3.0


@dataclass(frozen=True)
class Profile:
    """Choices for one system; the defaults serve any. docs/guides/own_system.md explains them on an example."""

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


def _spaced(n: int, slowest: float, fastest: float) -> tuple[float, ...]:
    """Eigenvalues as the shipped maps have them."""
    return tuple(np.round(evenly_spaced(n, slowest, fastest), 6).tolist())


PROFILES: dict[str, Profile] = {
    "reverse_duffing": Profile(
        eigenvalues=_spaced(13, -0.2, -8.0),
        # The paper's: no two of its motions part or fall together.
        spinn_settings={"eigenvalues": tuple(np.linspace(-1.5, -3.0, 5).tolist())},
        controller=homogeneous,
        fault_deadline=10.0,  # about a period at amplitude 1
    ),
    "van_der_pol": Profile(
        # Fast ones follow the jumps of y, slow ones average its noise; number and ends by errors of trained observers.
        eigenvalues=_spaced(15, -0.4, -20.0),
        # Slower modes have a rougher T; more of them average more of the noise.
        spinn_settings={
            "eigenvalues": _spaced(11, -4.0, -16.0),
            "noise_free_share": 0.2,
            "high_noise_emphasis": 4.5,
        },
        # Noise hides its phase most of all: more samples at high noise help. No input within its bound leads the
        # oscillator out of X, so stronger ones do.
        settings={"lead_in_input": 4.0, "noise_free_share": 0.05, "high_noise_emphasis": 4.0},
        # Of a T_inv that stands alone. Slow complex modes at frequencies of y average its noise.
        large_settings={
            "pairs": ((-0.1, 0.718), (-0.1, 2.128), (-0.1, 0.6836), (-0.3, 0.718)),
            "inverse_steps": 32_000,
            "learning_rate": 2.5e-3,
        },
        fault_deadline=8.9,  # a period
    ),
    "rossler": Profile(
        eigenvalues=_spaced(13, -0.4, -8.0),
        # Real modes hardly separate its three parameters under noise; slow pairs at frequencies of y do. The best
        # decoder's error on plants 10 % off falls from 2.3 to 1.9 % by two of them; batches and trajectories add 3 %.
        uncertain_settings={
            "pairs": ((-0.1, 1.05), (-0.1, 0.81), (-0.3, 1.05)),
            "width": 192,
            "inverse_steps": 48_000,
            "trajectories": 8000,
        },
        spinn_settings={"eigenvalues": _spaced(9, -3.0, -20.0)},
        fault_deadline=2.0,
    ),
    "lorenz": Profile(
        eigenvalues=_spaced(13, -1.5, -25.0),  # faster than the others', as its flow is
        spinn_settings={"eigenvalues": _spaced(9, -9.0, -40.0)},
        settings={"measurement_noise_max": 3.0},  # its output is the largest of the four
        large_settings={"inverse_steps": 24_000},
        fault_deadline=2.0,
    ),
}


def profile(system: System) -> Profile:
    """The choices for a system."""
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
    try:
        policy = controller(system) if name == "controller" else load_function(name)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"no linear-quadratic regulator holds {system.name} at its target {system.target} ({error}): set the "
            "target, or give a policy of your own as script.py:function"
        ) from error
    return checked_policy(policy, system, name)


def preset(
    system: System,
    pipeline: Pipeline = "input-aware",
    name: Preset = "fast",
    *,
    size: Size = "default",
    changes: Mapping[str, Any] | None = None,
) -> Config:
    """Return the configuration behind ``--pipeline``, ``--preset`` and ``--size`` for a system.

    "fast" is what ships: about half a minute of CPU time, or ten minutes for the size "large" and five for spinn.
    "paper" has the sizes of the paper's sec. 8, which leaves open the batch (here 4,096), the spacing of the
    eigenvalues (even) and the decay of the learning rate (a cosine).

    Parameters
    ----------
    system : System
        Any system.
    pipeline : {"input-aware", "spinn"}
        How T_inv is learned.
    name : {"fast", "paper"}
        The preset.
    size : {"default", "large"}
        Of an input-aware T_inv: large is one that stands alone, for use without a model.
    changes : mapping of str to object, optional
        Settings that are to differ, but for those of None. A spectrum that is not given suits them.

    Returns
    -------
    Config
        For :func:`training.train`.

    Raises
    ------
    ValueError
        If a name is unknown, or no spectrum follows from the system's rate.
    """
    for what, value, known in (("pipeline", pipeline, Pipeline), ("preset", name, Preset), ("size", size, Size)):
        if value not in get_args(known):
            raise ValueError(f"there is no {what} {value!r}; there are {', '.join(get_args(known))}")
    given = {key: value for key, value in (changes or {}).items() if value is not None}
    own, paper, uncertain = profile(system), name == "paper", given.get("uncertain")
    chosen: dict[str, Any] = {
        "dt": system.dt,
        "duration": system.duration,
        "measurement_noise_max": _largest_noise(system),
    }
    if pipeline == "input-aware":
        chosen |= own.settings
        if size == "large":
            chosen |= LARGE | dict(own.large_settings)
        if isinstance(uncertain, Mapping) and any(uncertain.values()):
            chosen |= LARGE | dict(own.uncertain_settings)
        if paper:
            chosen |= PAPER | {"trajectories": 4000, "inverse_steps": 244_140}
    else:
        chosen |= PAPER_SPINN if paper else SPINN | dict(own.spinn_settings)
    chosen |= given
    if "eigenvalues" not in chosen:
        if pipeline == "input-aware":
            chosen["eigenvalues"] = eigenvalues(system, chosen["dt"])
        elif paper:
            chosen["eigenvalues"] = papers_spectrum(system)
        else:
            chosen["eigenvalues"] = smooth_spectrum(system, chosen["dt"], chosen["duration"]).eigenvalues
    return Config(pipeline, **chosen)


def eigenvalues(system: System, dt: float) -> tuple[float, ...]:
    """Return real eigenvalues of A for an input-aware map.

    The system's profile gives them, or they follow from how fast f changes in X and from how often y is sampled.
    """
    chosen = profile(system).eigenvalues
    if chosen is not None:
        return chosen
    fastest = min(1.5 * system.typical_rate, (FASTEST_OF_STEPS if system.discrete else FASTEST_MODE) / dt)
    spaced = evenly_spaced(4 * system.nx + 3, -fastest / 22.5, -fastest)
    return tuple(float(f"{value:.6g}") for value in spaced)


def _largest_noise(system: System) -> float | tuple[float, ...]:
    """A multiple of the usual noise, of all outputs or each; of a share of the range where the system declares none."""
    usual = zip(np.broadcast_to(system.measurement_noise, system.ny).tolist(), system.output_range, strict=True)
    levels = [NOISE_RANGE * (level or NOISE_SHARE * size) for level, size in usual]
    return levels[0] if len(set(levels)) == 1 else tuple(levels)
