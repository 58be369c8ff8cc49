"""The configurations of a system behind ``--pipeline``, ``--preset`` and ``--size``."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.system import NOISE_SHARE, System
from training.config import Config, Pipeline, override
from training.smoothness import smooth_spectrum
from training.spectrum import FASTEST_MODE, evenly_spaced, papers_spectrum
from training.systems import profile

Preset = Literal["fast", "paper"]
Size = Literal["default", "large"]
# A T_inv that stands alone. By default a tracker does what width, slow complex modes and long training do here.
LARGE: dict[str, Any] = {"width": 128, "trajectories": 4000, "inverse_steps": 18_000}
PAPER: dict[str, Any] = {
    "width": 512, "depth": 4, "activation": "silu", "optimiser": "adam", "batch": 4096, "learning_rate": 1e-3
}  # fmt: skip
NOISE_RANGE = 2.0  # largest measurement noise that maps are trained for, over the system's default
# FASTEST_MODE in discrete time, where a step may change everything and the last samples say most.
FASTEST_OF_STEPS = 3.0


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
        Settings that are to differ, as for :func:`training.config.override`. A spectrum that is not given suits them.

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
    changes = changes or {}
    given = {key: value for key, value in changes.items() if value is not None}
    noise = _largest_noise(system)
    sizes: dict[str, Any] = {"dt": system.dt, "duration": system.duration, "measurement_noise_max": noise}
    if pipeline == "input-aware":
        spectrum = given.get("eigenvalues") or eigenvalues(system, given.get("dt", system.dt))
        config = override(Config(pipeline, eigenvalues=spectrum, **sizes), profile(system).settings)
        if size == "large":
            config = override(config, LARGE | dict(profile(system).large_settings))
        if any(override(config, changes).uncertain.values()):
            config = override(config, LARGE | dict(profile(system).uncertain_settings))
        if name == "paper":
            config = override(config, {**PAPER, "trajectories": 4000, "inverse_steps": 244_140})
        return override(config, changes)
    if name == "paper":
        config = Config(
            pipeline,
            eigenvalues=papers_spectrum(system),
            **sizes,
            trajectories=500,
            samples=5001,
            **PAPER,
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
        **LARGE,
        "forward_steps": 6_000,
        "inverse_steps": 12_000,
        "box_factor": 2.0,
        "noise_free_share": 0.35,
    }
    chosen |= {**profile(system).spinn_settings, **given}
    if "eigenvalues" not in chosen:
        chosen["eigenvalues"] = smooth_spectrum(system, chosen["dt"], chosen["duration"]).eigenvalues
    elif "eigenvalues" not in given:
        chosen["eigenvalues"] = _rounded(chosen["eigenvalues"])
    return Config(pipeline, **chosen)


def eigenvalues(system: System, dt: float) -> tuple[float, ...]:
    """Return real eigenvalues of A for an input-aware map.

    The system's profile gives them, or they follow from how fast f changes in X and from how often y is sampled.
    """
    chosen = profile(system).eigenvalues
    if chosen is not None:
        return _rounded(chosen)
    fastest = min(1.5 * system.typical_rate, (FASTEST_OF_STEPS if system.discrete else FASTEST_MODE) / dt)
    spaced = evenly_spaced(4 * system.nx + 3, -fastest / 22.5, -fastest)
    return tuple(float(f"{value:.6g}") for value in spaced)


def _largest_noise(system: System) -> float | tuple[float, ...]:
    """A multiple of the usual noise, of all outputs or each; of a share of the range where the system declares none."""
    usual = zip(np.broadcast_to(system.measurement_noise, system.ny).tolist(), system.output_range, strict=True)
    levels = [NOISE_RANGE * (level or NOISE_SHARE * size) for level, size in usual]
    return levels[0] if len(set(levels)) == 1 else tuple(levels)


def _rounded(eigenvalues: Sequence[float]) -> tuple[float, ...]:
    """As the shipped maps have them."""
    return tuple(np.round(eigenvalues, 6).tolist())
