"""The configurations behind ``--pipeline``, ``--preset`` and ``--size``, and those that records decide."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np

from kkl_gym.system import NOISE_SHARE, System
from training.config import Config, Pipeline, override
from training.records import Record, check_dt, median_step, sampling_interval
from training.smoothness import smooth_spectrum
from training.sources.recorded import signal_rate
from training.spectrum import evenly_spaced, papers_spectrum
from training.systems import profile

Preset = Literal["fast", "paper"]
Size = Literal["default", "large"]
# A T_inv that stands alone. By default a tracker does what width, slow complex modes and long training do here.
LARGE: dict[str, Any] = {"width": 128, "trajectories": 4000, "inverse_steps": 18_000}
PAPER: dict[str, Any] = {
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

MODES, SLOWEST, FASTEST = 12, 0.15, 10.0  # of records: eigenvalues for each output, in multiples of the signals' rate
MEMORIES = 3.0  # of the filter in a record at least, unless its slowest mode were faster than the signals
# Of rollouts, whose hidden signals an agent wants within steps: how many modes, the slowest and the fastest per step.
# Few modes that are far apart forget the start soon, and tell single steps from each other.
EPISODE_MODES, EPISODE_SLOWEST, EPISODE_FASTEST = 6, 0.2, 4.0
EPISODE_MEMORIES = 1.5  # of the filter in an episode at least
RECORDED_NOISE = 0.1  # of an output's standard deviation: the largest noise beside that of the records
RECORDED: dict[str, Any] = {
    "samples": 60,
    "width": 96,
    "depth": 2,
    "learning_rate": 3e-3,
    "inverse_steps": 3000,
    "members": 3,
    "noise_free_share": 0.5,
    "scaling": "range",  # errors count by their own size, not the state's
}

# Settings with which maps of records may be fitted again, beside the same filter.
OF_THE_MAPS = (
    "samples", "windows", "width", "depth", "activation", "optimiser", "batch", "learning_rate", "inverse_steps",
    "members", "noise_free_share", "high_noise_emphasis", "untold_noise", "measurement_noise_max", "held_out",
    "flow_steps", "cpu_seconds", "seed",
)  # fmt: skip
OF_THE_FILTER = ("eigenvalues", "pairs", "dt", "inputs", "arbitrary_zero")


def preset(
    system: System,
    pipeline: Pipeline = "input-aware",
    name: Preset = "fast",
    *,
    size: Size = "default",
    changes: Mapping[str, Any] | None = None,
) -> Config:
    """Return the configuration behind ``--pipeline``, ``--preset`` and ``--size`` for a system.

    "fast" is what ships: about half a minute of CPU time, or ten for the size "large" and five for spinn. "paper" has
    the sizes of the paper's sec. 8: 500 trajectories of 50 s, SiLU networks of 4 x 512, 200 epochs over 3 million and 5
    million points, physics weight 0.1, and nz = ny (2 nx + 1) eigenvalues in [-3, -1.5] at the pace of the shipped
    systems. The paper leaves open the batch (here 4,096), the spacing of the eigenvalues (even) and the decay of the
    learning rate (a cosine).

    Parameters
    ----------
    system : System
        Any system.
    pipeline : {"input-aware", "spinn"}
        How T_inv is learned.
    name : {"fast", "paper"}
        The preset.
    size : {"default", "large"}
        Of an input-aware T_inv: large is one that stands alone, for certificates and for use without a model.
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
    sizes: dict[str, Any] = {
        "dt": system.dt,
        "duration": system.duration,
        "measurement_noise_max": _largest_noise(system),
    }
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
    batches = {"forward_steps": 6_000, "inverse_steps": 12_000}
    chosen = {**sizes, **LARGE, **batches, "box_factor": 2.0, "noise_free_share": 0.35}
    settings = dict(profile(system).spinn_settings)
    if "eigenvalues" in settings:
        settings["eigenvalues"] = _rounded(settings["eigenvalues"])
    chosen |= {**settings, **given}
    if "eigenvalues" not in chosen:
        chosen["eigenvalues"] = smooth_spectrum(system, chosen["dt"], chosen["duration"]).eigenvalues
    return Config(pipeline, **chosen)


def recorded_preset(records: Sequence[Record], changes: Mapping[str, Any] | None = None) -> Config:
    """Return a configuration for records, which decide dt, the eigenvalues of A, and the largest noise.

    dt is the median step, rounded where steps are uneven. The eigenvalues follow from the rate of the signals and from
    the length of the records; those of rollouts from dt and the length of episodes. The largest noise is a tenth of the
    standard deviation of each output.

    Parameters
    ----------
    records : sequence of Record
        Records of the same signals.
    changes : mapping of str to object, optional
        Settings that are to differ.

    Returns
    -------
    Config
        For :func:`training.train` with a :class:`training.RecordedSource`.

    Raises
    ------
    ValueError
        If dt does not suit the records, or an output never changes.
    """
    given = {name: value for name, value in (changes or {}).items() if value is not None}
    chosen: dict[str, Any] = {"dt": sampling_interval(*records), **RECORDED} | given
    check_dt(records, chosen["dt"])
    if records[0].environment is not None and not np.isclose(chosen["dt"], median_step(*records), rtol=1e-6):
        raise ValueError(
            f"dt = {chosen['dt']:g} s: an observer for {records[0].environment['id']} takes a sample at each step, "
            f"every {median_step(*records):g} s; leave dt out"
        )
    chosen.setdefault("duration", max(50.0, chosen["dt"]))
    if "eigenvalues" not in given:
        chosen["eigenvalues"] = _recorded_eigenvalues(records, chosen["dt"])
    if "measurement_noise_max" not in given:
        y = np.concatenate([record.y for record in records])
        levels = tuple(float(f"{RECORDED_NOISE * size:.3g}") for size in np.nanstd(y, 0))
        if still := [name for name, level in zip(records[0].signals.measured, levels) if not level]:
            raise ValueError(f"{', '.join(still)} never changes: leave it out of what is measured")
        chosen["measurement_noise_max"] = levels[0] if len(levels) == 1 else levels
    return Config("input-aware", **chosen)


def _recorded_eigenvalues(records: Sequence[Record], dt: float) -> tuple[float, ...]:
    if records[0].source:
        steps = float(np.median([len(record.t) for record in records]))
        slowest = min(max(EPISODE_SLOWEST, EPISODE_MEMORIES * np.log(1e3) / steps), EPISODE_FASTEST / 4)
        spaced = evenly_spaced(EPISODE_MODES, -slowest / dt, -EPISODE_FASTEST / dt)
    else:
        rate = signal_rate(records)
        length = np.median([record.duration for record in records])
        slowest = min(max(SLOWEST * rate, MEMORIES * np.log(1e3) / length), rate)
        spaced = evenly_spaced(MODES, -slowest, -min(FASTEST * rate, FASTEST_MODE / dt))
    return tuple(float(f"{value:.6g}") for value in spaced)


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
    """Of all outputs or each: a multiple of what is usual, or of what would be where the system says that none is."""
    usual = zip(np.broadcast_to(system.measurement_noise, system.ny).tolist(), system.output_range, strict=True)
    levels = [NOISE_RANGE * (level or NOISE_SHARE * size) for level, size in usual]
    return levels[0] if len(set(levels)) == 1 else tuple(levels)


def _rounded(eigenvalues: Sequence[float]) -> tuple[float, ...]:
    """As the shipped maps have them."""
    return tuple(np.round(eigenvalues, 6).tolist())
