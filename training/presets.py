"""The configurations behind ``--pipeline`` and ``--preset``.

What differs from system to system, the spectrum above all, comes from the system's profile in
:mod:`training.systems`.
"""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.system import System
from training.config import Config, Pipeline, override
from training.smoothness import smooth_spectrum
from training.spectrum import evenly_spaced, papers_spectrum, typical_rate
from training.systems import profile

Preset = Literal["fast", "paper"]
LARGE: dict[str, Any] = {
    "width": 512,
    "depth": 4,
    "activation": "silu",
    "optimiser": "adam",
    "batch": 4096,
    "learning_rate": 1e-3,
}
CLOSED_LOOP = 2000  # trajectories of ``kkl-gym train --closed-loop``


def preset(system: System, pipeline: Pipeline, name: Preset, *, changes: Mapping[str, Any] | None = None) -> Config:
    """The configuration behind ``--pipeline`` and ``--preset`` for a system.

    "paper" has the sizes of the paper's sec. 8: 500 trajectories of 50 s, SiLU networks of 4 x 512, 200 epochs over
    3 million and 5 million points, physics weight 0.1, and nz = ny (2 nx + 1) eigenvalues in [-3, -1.5].
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
    if pipeline == "input-aware":
        config = override(Config(pipeline, eigenvalues(system)), profile(system).settings)
        sizes = {**LARGE, "inverse_steps": 244_140}
        return override(override(config, sizes if name == "paper" else {}), changes)
    if name == "paper":
        config = Config(
            pipeline,
            papers_spectrum(system),
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
    chosen: dict[str, Any] = {"box_factor": 2.0, "forward_steps": 10_000, "noise_free_share": 0.35}
    chosen |= {**profile(system).spinn_settings, **{key: value for key, value in changes.items() if value is not None}}
    if "eigenvalues" not in chosen:
        dt, duration = (chosen.get(key, getattr(Config, key)) for key in ("dt", "duration"))
        chosen["eigenvalues"] = smooth_spectrum(system, dt, duration).eigenvalues
    return Config(pipeline, **{**chosen, "eigenvalues": tuple(np.round(chosen["eigenvalues"], 6).tolist())})


def eigenvalues(system: System) -> tuple[float, ...]:
    """Real eigenvalues of A for an input-aware map.

    The system's profile says them, or they follow from how fast f changes in X.

    Parameters
    ----------
    system : System
        Any system.

    Returns
    -------
    tuple of float
        In 1/s, from the slowest to the fastest.

    Raises
    ------
    ValueError
        If there is no profile and the system does not say how fast f changes.
    """
    chosen = profile(system).eigenvalues
    if chosen is None:
        rate = typical_rate(system)
        chosen = evenly_spaced(4 * system.nx + 3, -rate / 15, -1.5 * rate)
    return tuple(np.round(chosen, 6).tolist())
