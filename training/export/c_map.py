"""T_inv in C99: constants, of which some depend on levels of noise that the compiler may be told, and functions."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from observers.inverse import InverseMap
from training.export import c_templates
from training.export.c_text import array, block, comment, network_arrays, network_words, number
from training.export.exported import Exported

SQUARE = "#ifndef SQUARE\n#define SQUARE(a) ((a) * (a))\n#endif\n"


@dataclass(frozen=True)
class Level:
    """A level of noise as a macro."""

    macro: str
    meaning: str
    value: float
    end: float


def measurement_levels(exported: Exported) -> list[Level]:
    """Levels of measurement noise: none, one for all outputs, or one for each of several."""
    inverse = exported.artifact.inverse
    end = inverse.measurement_noise_max if "measurement_noise" in inverse.features else np.inf
    ends, several = np.broadcast_to(end, len(exported.levels)).tolist(), len(exported.levels) > 1
    found = []
    for i, (value, end) in enumerate(zip(exported.levels, ends, strict=True)):
        of = f"of {comment(exported.outputs[i])}" if several else "of y"
        meaning = f"the standard deviation of the noise on each sample {of}"
        macro = f"{exported.name.upper()}_MEASUREMENT_NOISE{f'_{i + 1}' * several}"
        found.append(Level(macro, meaning, value, end))
    return found


def process_level(exported: Exported) -> Level | None:
    """The level of process noise, where T_inv or a flow is told it."""
    if not exported.told_process_noise and exported.artifact.flow is None:
        return None
    end, meaning = exported.artifact.process_noise_max, "the level of process noise that is assumed"
    macro = f"{exported.name.upper()}_PROCESS_NOISE"
    return Level(macro, meaning, exported.process_noise, math.inf if end is None else float(end))


def levels(exported: Exported) -> list[Level]:
    """All of them."""
    process = process_level(exported)
    return measurement_levels(exported) + ([] if process is None else [process])


def map_constants(exported: Exported, label: str, inverse: InverseMap) -> list[str]:
    """The arrays of a map."""
    parts = [f"\n/* The map of {label} motion. */\n"]
    arrays = ("z_offset", "whiten", "x_offset", "x_scale")
    parts += [array("double", f"{label}_{name}", getattr(inverse, name)) for name in arrays]
    if inverse.noise_gain.any():
        macros, gains = [level.macro for level in measurement_levels(exported)], np.atleast_2d(inverse.noise_gain)
        squares = [
            " + ".join(f"SQUARE(CUT_{macro} * {number(gain)})" for macro, gain in zip(macros, column, strict=True))
            for column in gains.T.tolist()
        ]
        parts.append(SQUARE)
        parts.append(block("double", f"{label}_gain", f"[{len(squares)}]", [f"1.0 / (1.0 + {sum})" for sum in squares]))
    return parts + network_arrays(label, inverse.mlp)


def map_functions(exported: Exported, label: str, inverse: InverseMap) -> str:
    """What the network is given, and what it makes of it."""
    modes, size = inverse.whiten.shape
    told: list[str] = []
    for feature, terms in _told(exported, inverse):
        told.append(f"    a[{modes + len(told)}] = (real)log1p({terms}); /* {feature} */\n")
    return c_templates.MAP.format(
        NAME=exported.name,
        map=label,
        modes=modes,
        size=size,
        gain=f"{label}_gain[i] * " if inverse.noise_gain.any() else "",
        age=", unsigned long age" if "age" in inverse.features else "",
        age_now=", observer->age" if "age" in inverse.features else "",
        told="".join(told),
        nx=len(inverse.x_offset),
        **network_words(label, inverse.mlp),
    )


def _told(exported: Exported, inverse: InverseMap) -> Iterable[tuple[str, str]]:
    """What else the network is told: each feature with what is the argument of log1p."""
    if "measurement_noise" in inverse.features:
        units = np.atleast_1d(inverse.measurement_noise_unit).tolist()
        for level, unit in zip(measurement_levels(exported), units, strict=True):
            yield "measurement noise", f"CUT_{level.macro} / {number(unit)}"
    process = process_level(exported)
    if "process_noise" in inverse.features and process is not None:
        yield "process noise", f"CUT_{process.macro} / {number(inverse.process_noise_unit)}"
    if "age" in inverse.features:
        age = f"(double)age * {number(exported.artifact.filter.dt)}"
        end = number(inverse.age_max)
        yield "age", f"({age} < {end} ? {age} : {end}) / {number(inverse.age_unit)}"
