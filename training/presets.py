"""Choices for each system: its profile, its controller, and the configuration that the commands' options select."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.loading import load_function
from kkl_gym.system import NOISE_SHARE, System
from observers.checks import noise_levels
from observers.names import suggestion
from training.config import Config, Pipeline
from training.spectrum import FASTEST_MODE, evenly_spaced, papers_spectrum, smooth_spectrum
from training.trajectories.motions import Controller, checked_policy, linear_quadratic

Preset = Literal["fast", "paper"]
Size = Literal["default", "large"]
# A T_inv for use without a tracker needs more neurons, more trajectories and longer training.
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
NOISE_RANGE = 2.0  # largest measurement noise in training, in multiples of the system's default
# Bound of |eigenvalue| * dt in discrete time, above FASTEST_MODE, as a step may change all of x: the past matters less.
FASTEST_OF_STEPS = 3.0


@dataclass(frozen=True)
class Profile:
    """Choices for one system; the defaults suit any system. docs/guides/own_system.md explains them by an example."""

    eigenvalues: tuple[float, ...] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    large_settings: Mapping[str, Any] = field(default_factory=dict)
    uncertain_settings: Mapping[str, Any] = field(default_factory=dict)
    spinn_settings: Mapping[str, Any] = field(default_factory=dict)
    controller: Callable[[System, float], Controller] = linear_quadratic
    fault_deadline: float | None = None


def homogeneous(system: System, dt: float) -> Controller:
    """Return the saturated u / u_max with u = b x1 - 2 (x2 + cbrt(a x1)), for the system x1' = a x2^3, x2' = -b x1 + u.

    There is no linear-quadratic regulator, as the linearisation at the origin cannot be stabilised. This feedback
    cancels -b x1 and makes x2 follow -cbrt(a x1), for which x1' = -a^2 x1.
    """
    (u_max,) = system.u_max
    a, b = (system.parameters[name] for name in ("a", "b"))

    def act(x: np.ndarray) -> np.ndarray:
        x1, x2 = x[:, :1], x[:, 1:]
        return np.asarray(np.clip((b * x1 - 2.0 * (x2 + np.cbrt(a * x1))) / u_max, -1.0, 1.0))

    return act


def _spaced(n: int, slowest: float, fastest: float) -> tuple[float, ...]:
    """Space eigenvalues evenly in the logarithm, and round them to six decimals, as in the shipped maps."""
    return tuple(np.round(evenly_spaced(n, slowest, fastest), 6).tolist())


PROFILES: dict[str, Profile] = {
    "reverse_duffing": Profile(
        eigenvalues=_spaced(13, -0.2, -8.0),
        # Neighbouring motions neither separate nor approach fast: T is smooth even with the paper's slow eigenvalues.
        spinn_settings={"eigenvalues": tuple(np.linspace(-1.5, -3.0, 5).tolist())},
        controller=homogeneous,
        fault_deadline=10.0,  # longer than the period of motions from (1, 0), 6.2 s, and from (0, 1), 7.4 s
    ),
    "van_der_pol": Profile(
        # Fast modes follow the jumps of y, and slow ones average its noise; this range gave the smallest errors.
        eigenvalues=_spaced(15, -0.4, -20.0),
        # Slower modes would make T rougher; fewer modes would average less of the noise.
        spinn_settings={"eigenvalues": _spaced(11, -4.0, -16.0), "noise_free_share": 0.2, "high_noise_emphasis": 4.5},
        # High noise levels are drawn more often, as they make the phase hard to estimate. Inputs within their bound
        # cannot drive the oscillator out of X, so stronger inputs before some trajectories do.
        settings={"lead_in_input": 4.0, "noise_free_share": 0.05, "high_noise_emphasis": 4.0},
        # Without a tracker, slow complex modes at frequencies of y average the noise of y.
        large_settings={
            "pairs": ((-0.1, 0.718), (-0.1, 2.128), (-0.1, 0.6836), (-0.3, 0.718)),
            "inverse_steps": 32_000,
            "learning_rate": 2.5e-3,
        },
        fault_deadline=8.9,  # a period of the limit cycle
    ),
    "rossler": Profile(
        eigenvalues=_spaced(13, -0.4, -8.0),
        # Under noise, real modes hardly distinguish the parameters; slow pairs at frequencies of y do. For parameters
        # 10 % off, two pairs lower the error predicted for the best T_inv from 2.3 to 1.9 %; a third lowers it little.
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
        eigenvalues=_spaced(13, -1.5, -25.0),  # this system is faster than the others
        spinn_settings={"eigenvalues": _spaced(9, -9.0, -40.0)},
        settings={"measurement_noise_max": 3.0},  # its output is the largest of the four systems'
        large_settings={"inverse_steps": 24_000},
        fault_deadline=2.0,
    ),
}


def profile(system: System) -> Profile:
    """Return the system's entry in ``PROFILES``, or else the default profile."""
    return PROFILES.get(system.name, Profile())


def controller(system: System, dt: float) -> Controller:
    """Return the feedback that drives a system to its target: the profile's, or else a saturated LQ regulator."""
    if not system.nu:
        raise ValueError(f"{system.name} has no inputs to control it by")
    return profile(system).controller(system, dt)


def named_policy(system: System, name: str, dt: float | None) -> Controller:
    """Load and check a policy: a script's function, or the system's controller for ``dt`` (by default system.dt)."""
    if ":" not in name and name != "controller":
        similar = suggestion(name, ["controller"])
        raise ValueError(f"unknown policy {name!r}{similar}: give controller, or script.py:function")
    try:
        policy = controller(system, dt or system.dt) if name == "controller" else load_function(name)
    except np.linalg.LinAlgError as error:
        text = f"no linear-quadratic regulator holds {system.name} at its target {system.target} ({error})"
        raise ValueError(f"{text}: set another target, reduce dt, or give a policy as script.py:function") from error
    return checked_policy(policy, system, name)


def preset(
    system: System,
    pipeline: Pipeline = "input-aware",
    name: Preset = "fast",
    *,
    size: Size = "default",
    changes: Mapping[str, Any] | None = None,
) -> Config:
    """Return the configuration that ``--pipeline``, ``--preset`` and ``--size`` select for a system.

    Maps that ship were trained with "fast", which takes about half a minute of CPU time, ten minutes for the size
    "large", and five for spinn. "paper" takes its sizes from the paper's sec. 8, which does not state the batch (here
    4,096), the spacing of the eigenvalues (here even, for spinn) or the decay of the learning rate (here a cosine).

    Parameters
    ----------
    system : System
        The system to observe.
    pipeline : {"input-aware", "spinn"}
        How T_inv is learned.
    name : {"fast", "paper"}
        The preset.
    size : {"default", "large"}
        Size of an input-aware T_inv; "large" is for use without a tracker.
    changes : mapping of str to object, optional
        Settings to replace; None keeps a setting. Eigenvalues not given follow from the system and the other settings.

    Returns
    -------
    Config
        The configuration, for :func:`training.train`.

    Raises
    ------
    ValueError
        If a name is unknown, a setting is invalid, or no spectrum follows from the system's rate.
    """
    for what, value, known in (("pipeline", pipeline, Pipeline), ("preset", name, Preset), ("size", size, Size)):
        if value not in get_args(known):
            raise ValueError(f"there is no {what} {value!r}; there are {', '.join(get_args(known))}")
    given = {key: value for key, value in (changes or {}).items() if value is not None}
    own, paper, uncertain = profile(system), name == "paper", given.get("uncertain")
    usual = zip(np.broadcast_to(system.measurement_noise, system.ny).tolist(), system.output_range, strict=True)
    largest = [NOISE_RANGE * (level or NOISE_SHARE * size) for level, size in usual]  # the system's noise may be 0
    levels = noise_levels("measurement_noise_max", largest, system.ny)
    chosen: dict[str, Any] = {"dt": system.dt, "duration": system.duration, "measurement_noise_max": levels}
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
    """Return an input-aware map's real eigenvalues of A: the profile's, or else ones from the system's rate and dt."""
    if (chosen := profile(system).eigenvalues) is not None:
        return chosen
    fastest = min(1.5 * system.typical_rate, (FASTEST_OF_STEPS if system.discrete else FASTEST_MODE) / dt)
    spaced = evenly_spaced(4 * system.nx + 3, -fastest / 22.5, -fastest)
    return tuple(float(f"{value:.6g}") for value in spaced)
