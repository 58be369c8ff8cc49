"""The configurations behind ``--pipeline`` and ``--preset``.

What differs from system to system, the spectrum above all, comes from the system's profile in
:mod:`training.systems`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.system import NOISE_SHARE, System
from training.config import Config, Pipeline, override
from training.smoothness import smooth_spectrum
from training.spectrum import evenly_spaced, papers_spectrum
from training.systems import profile

Preset = Literal["fast", "paper"]
Size = Literal["default", "small"]
SMALL = "small"  # what names of small maps end in
# Of small maps: hidden layers of a twentieth of the multiplications, and none of the slow modes that average noise. A
# tracker does that by itself.
SMALL_SETTINGS: dict[str, Any] = {"width": 20, "pairs": ()}
LARGE: dict[str, Any] = {
    "width": 512,
    "depth": 4,
    "activation": "silu",
    "optimiser": "adam",
    "batch": 4096,
    "learning_rate": 1e-3,
}
NOISE_RANGE = 2.0  # largest measurement noise that maps are trained for, over the system's default
FASTEST_MODE = 0.5  # bound of |eigenvalue| * dt: a faster mode holds no more than the last samples
FASTEST_OF_STEPS = 3.0  # the same in discrete time, where a step may change everything and the last samples say most
CLOSED_LOOP = 2000  # trajectories of ``kkl-gym train --closed-loop``


def preset(system: System, pipeline: Pipeline, name: Preset, *, changes: Mapping[str, Any] | None = None) -> Config:
    """The configuration behind ``--pipeline`` and ``--preset`` for a system.

    "paper" has the sizes of the paper's sec. 8: 500 trajectories of 50 s, SiLU networks of 4 x 512, 200 epochs over
    3 million and 5 million points, physics weight 0.1, and nz = ny (2 nx + 1) eigenvalues in [-3, -1.5] at the pace
    of the shipped systems.
    The paper leaves open the batch (here 4,096), the spacing of the eigenvalues (even) and the decay of
    the learning rate (a cosine). "fast" is what ships: at most ten minutes.

    Parameters
    ----------
    system : System
        Any system.
    pipeline : {"input-aware", "spinn"}
        How the observer is learned.
    name : {"fast", "paper"}
        The sizes.
    changes : mapping of str to object, optional
        Settings that are to differ, as for :func:`training.config.override`. Where a spectrum has to be found, it suits
        them; where one is given, none is looked for.

    Returns
    -------
    Config
        For :func:`training.train`.

    Raises
    ------
    ValueError
        If a name is unknown, or no spectrum follows from the system's rate.
    """
    if pipeline not in get_args(Pipeline) or name not in get_args(Preset):
        raise ValueError(
            f"no preset {name!r} for pipeline {pipeline!r}; there are {get_args(Preset)}, {get_args(Pipeline)}"
        )
    changes = changes or {}
    given = {key: value for key, value in changes.items() if value is not None}
    sizes: dict[str, Any] = {
        "dt": system.dt,
        "duration": system.duration,
        "measurement_noise_max": _largest_noise(system),
    }
    if pipeline == "input-aware":
        spectrum = given.get("eigenvalues") or eigenvalues(system, given.get("dt", system.dt))
        config = override(Config(pipeline, eigenvalues=spectrum, **sizes), profile(system).settings)
        if any(override(config, changes).uncertain.values()):
            config = override(config, profile(system).uncertain_settings)
        larger = {**LARGE, "inverse_steps": 244_140}
        return override(override(config, larger if name == "paper" else {}), changes)
    if name == "paper":
        config = Config(
            pipeline,
            eigenvalues=papers_spectrum(system),
            **sizes,
            trajectories=500,
            samples=5001,
            **LARGE,
            forward_steps=200 * 3_000_000 // 4096,
            inverse_steps=200 * 5_000_000 // 4096,
            collocation="box",
            scaling="range",
            solved_output_layer=False,
            transients=False,
        )
        return override(config, changes)
    chosen = {
        **sizes,
        "box_factor": 2.0,
        "forward_steps": 6_000,
        "inverse_steps": 12_000,
        "noise_free_share": 0.35,
    }
    settings = dict(profile(system).spinn_settings)
    if "eigenvalues" in settings:
        settings["eigenvalues"] = _rounded(settings["eigenvalues"])
    chosen |= {**settings, **given}
    if "eigenvalues" not in chosen:
        chosen["eigenvalues"] = smooth_spectrum(system, chosen["dt"], chosen["duration"]).eigenvalues
    return Config(pipeline, **chosen)


def eigenvalues(system: System, dt: float) -> tuple[float, ...]:
    """Real eigenvalues of A for an input-aware map.

    The system's profile says them, or they follow from how fast f changes in X and from how often y is sampled.
    """
    chosen = profile(system).eigenvalues
    if chosen is not None:
        return _rounded(chosen)
    fastest = min(1.5 * system.typical_rate, (FASTEST_OF_STEPS if system.discrete else FASTEST_MODE) / dt)
    spaced = evenly_spaced(4 * system.nx + 3, -fastest / 22.5, -fastest)
    return tuple(float(f"{value:.6g}") for value in spaced)


def _largest_noise(system: System) -> float | tuple[float, ...]:
    """Of all outputs or each: a multiple of what is usual, or of what would be where the system says that none is."""
    usual = zip(np.broadcast_to(system.measurement_noise, system.ny).tolist(), system.output_range, strict=True)
    levels = [NOISE_RANGE * (level or NOISE_SHARE * size) for level, size in usual]
    return levels[0] if len(set(levels)) == 1 else tuple(levels)


def _rounded(eigenvalues: Sequence[float]) -> tuple[float, ...]:
    """As the shipped maps have them."""
    return tuple(np.round(eigenvalues, 6).tolist())
