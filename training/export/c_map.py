"""T_inv in C99: constants, of which some depend on levels of noise that the compiler may be told, and functions."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from observers.inverse import InverseMap
from training.export.c_text import array, block, comment, network_arrays, network_calls, number
from training.export.exported import Exported

_MAP = """\
static void {map}_map(const {name}_observer *observer, real *x_hat)
{{
    real a[{width}], b[{width}];
    for (int i = 0; i < {modes}; i++) {{
        double mode = 0.0;
        for (int j = 0; j < {size}; j++)
            mode += {map}_whiten[i][j] * (observer->z[j] - {map}_z_offset[j]);
        a[i] = (real)({map}_gain[i] * mode);
    }}
{conditions}    {layers}
    for (int i = 0; i < NX; i++)
        x_hat[i] = (real)({map}_x_offset[i] + {map}_x_scale[i] * {last}[i]);
}}

"""


@dataclass(frozen=True)
class Level:
    """A level of noise as a macro."""

    macro: str
    meaning: str
    value: float
    end: float

    @property
    def cut(self) -> str:
        """The level, cut at its end."""
        end = number(self.end)
        return f"(({self.macro}) < {end} ? ({self.macro}) : {end})" if math.isfinite(self.end) else f"({self.macro})"


def measurement_levels(exported: Exported) -> list[Level]:
    """Levels of measurement noise: none, one for all outputs, or one for each of several."""
    inverse = exported.artifact.inverse
    end = inverse.measurement_noise_max if "measurement_noise" in inverse.features else np.inf
    ends, several = np.broadcast_to(end, len(exported.levels)).tolist(), len(exported.levels) > 1
    levels = []
    for i, (value, end) in enumerate(zip(exported.levels, ends, strict=True)):
        of = f"of {comment(exported.outputs[i])}" if several else "of y"
        meaning = f"the standard deviation of the noise on each sample {of}"
        macro = f"{exported.name.upper()}_MEASUREMENT_NOISE{f'_{i + 1}' * several}"
        levels.append(Level(macro, meaning, value, end))
    return levels


def process_level(exported: Exported) -> Level | None:
    """The level of process noise, where T_inv or a motion depends on it."""
    if not exported.told_process_noise and exported.artifact.motion is None:
        return None
    end, meaning = exported.artifact.process_noise_max, "the level of process noise that is assumed"
    macro = f"{exported.name.upper()}_PROCESS_NOISE"
    return Level(macro, meaning, exported.process_noise, math.inf if end is None else float(end))


def map_constants(exported: Exported, label: str, inverse: InverseMap) -> str:
    """The arrays of a map."""
    arrays = ("z_offset", "whiten", "x_offset", "x_scale")
    parts = [array("double", f"{label}_{name}", getattr(inverse, name)) for name in arrays]
    levels, gains = measurement_levels(exported), np.atleast_2d(inverse.noise_gain).T.tolist()
    words = [
        " + ".join(
            ["1.0", *(f"SQUARE({level.cut} * {number(each)})" for level, each in zip(levels, gain, strict=False))]
        )
        for gain in gains
    ]
    parts.append(block("double", f"{label}_gain", f"[{len(words)}]", [f"1.0 / ({word})" for word in words]))
    return f"\n/* The map of {label} motion. */\n" + "".join(parts) + network_arrays(label, inverse.mlp)


def map_function(exported: Exported, label: str, inverse: InverseMap) -> str:
    """T_inv as a function."""
    modes, size = inverse.whiten.shape
    width, layers, last = network_calls(label, inverse.mlp)
    conditions = "".join(
        f"    a[{modes + i}] = (real)log1p({term}); /* {feature} */\n"
        for i, (feature, term) in enumerate(_conditions(exported, inverse))
    )
    return _MAP.format(
        map=label,
        name=exported.name,
        width=width,
        modes=modes,
        size=size,
        conditions=conditions,
        layers=layers,
        last=last,
    )


def _conditions(exported: Exported, inverse: InverseMap) -> Iterable[tuple[str, str]]:
    """What else the network depends on: each feature with the argument of its log1p."""
    if "measurement_noise" in inverse.features:
        units = np.atleast_1d(inverse.measurement_noise_unit).tolist()
        for level, unit in zip(measurement_levels(exported), units, strict=True):
            yield "measurement noise", f"{level.cut} / {number(unit)}"
    process = process_level(exported)
    if "process_noise" in inverse.features and process is not None:
        yield "process noise", f"{process.cut} / {number(inverse.process_noise_unit)}"
    if "age" in inverse.features:
        age = f"(double)observer->age * {exported.name.upper()}_DT"
        yield (
            "age",
            f"({age} < {number(inverse.age_max)} ? {age} : {number(inverse.age_max)}) / {number(inverse.age_unit)}",
        )
