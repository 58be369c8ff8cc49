"""The step as C99: a header, a source without dependencies but math.h, and a program that shows how they are used.

A tracker's estimates and covariances are doubles whatever the precision is: P is what differences leave, and in floats
its factor would break down.
"""

from textwrap import fill
from typing import Any

import numpy as np

import kkl_gym
from observers.motion import Motion
from training.export.c_map import map_constants, map_function, measurement_levels, process_level
from training.export.c_text import (
    activations,
    array,
    block,
    comment,
    defined,
    function,
    network_arrays,
    network_calls,
    number,
    template,
)
from training.export.exported import Exported, output_expression, table, tracker_arrays, tracker_numbers

_LARGER = "#define LARGER(a, b) ((a) > (b) ? (a) : (b))\n"
_TABULATE = "tabulated(map##_covariance, map##_levels, map##_ROWS, map##_ages, map##_COLUMNS, age, P)"


def c_files(exported: Exported) -> dict[str, str]:
    """Write the observer in C."""
    artifact, name = exported.artifact, exported.name
    motion = artifact.motion
    equations = None if motion is None else motion.equations
    chosen = {
        "inputs": artifact.nu > 0,
        "autonomous": not artifact.nu,
        "free": "free" in exported.maps,
        "tracks": motion is not None,
        "static": motion is None,
        "flow": equations is None,
        "equations": equations is not None,
        "discrete": equations is not None and not equations.substeps,
        "continuous": equations is not None and equations.substeps > 0,
    }
    words = {"NAME": name, "MACRO": name.upper(), "OUTPUTS": ", ".join(exported.outputs)}
    words = {key: comment(text) for key, text in (words | {"INPUTS": ", ".join(exported.inputs)}).items()}
    source = words | _functions(exported) | {"/* CONSTANTS */\n": _constants(exported)}
    digits = "9" if exported.precision == "float" else "17"
    return {
        f"{name}.h": template("observer.h", words | _heading(exported), **chosen),
        f"{name}.c": template("observer.c", source, **chosen),
        f"{name}_main.c": template("main.c", words | {"DIGITS": digits}, **chosen),
    }


def _heading(exported: Exported) -> dict[str, str]:
    """Words of the header."""
    artifact, tracks = exported.artifact, exported.artifact.motion is not None
    finite = (
        "Where an output is missing, pass NaN: it is predicted. The first sample and inputs must be finite, and the "
        "compiler must know NaN, as it does without -ffast-math."
        if tracks
        else "Samples and inputs must be finite: a NaN stays until the next reset."
    )
    paragraphs = [
        f"{exported.name}_reset takes in the first sample, {exported.name}_step every later one. {finite} Nothing is "
        "allocated, and observers share constants alone."
    ]
    process = process_level(exported)
    for level in [*measurement_levels(exported), *([process] if process else [])]:
        value = number(level.value)
        to = " for T_inv" if tracks and level == process else ""  # the filter takes any level
        beyond = f"; what is beyond {number(level.end)} counts as that{to}" if np.isfinite(level.end) else ""
        paragraphs.append(
            f"{level.macro} is {level.meaning}, {value} unless the compiler is told otherwise, as in "
            f"-D{level.macro}={value}{beyond}."
        )
    return {
        "SYSTEM": comment(artifact.system),
        "SECONDS": number(artifact.filter.dt),
        "VERSION": kkl_gym.__version__,
        "SOURCE": comment(exported.source),
        "CHECKSUM": exported.checksum,
        "ESTIMATES": comment(", ".join(exported.estimates)),
        "PARAGRAPHS": "\n *\n".join(
            fill(text, 116, initial_indent=" * ", subsequent_indent=" * ") for text in paragraphs
        ),
        "PRECISION": exported.precision,
        "COUNT_X": str(len(exported.estimates)),
        "COUNT_Y": str(artifact.ny),
        "COUNT_U": str(artifact.nu),
        "COUNT_Z": str(artifact.filter.size),
    }


def _constants(exported: Exported) -> str:
    """Sizes, levels of noise and arrays."""
    artifact, linear, macro = exported.artifact, exported.artifact.filter, exported.name.upper()
    nz, process = len(linear.A), process_level(exported)
    block_of_z = linear.transition[:nz, :nz]
    rows, columns = np.nonzero(block_of_z)
    sizes = {"NX": f"{macro}_NX", "NY": f"{macro}_NY", "NU": f"{macro}_NU", "NZ": nz, "SIZE": linear.size}
    parts = [defined(sizes | {"TRANSITIONS": len(rows), "LAST_AGE": f"{exported.last_age}ul"})]
    levels = [*measurement_levels(exported), *([process] if process else [])]
    parts += [
        "#define SQUARE(a) ((a) * (a))\n",
        *(f"\n#ifndef {each.macro}\n#define {each.macro} {number(each.value)}\n#endif\n" for each in levels),
        "\n/* The filter. */\n",
        array("double", "transition", block_of_z[rows, columns]),
        array("unsigned short", "transition_row", rows),
        array("unsigned short", "transition_column", columns),
        *(array("double", name, getattr(linear, name)[:nz]) for name in ("early_y", "late_y", "equilibrium")),
        *([array("double", "held_u", linear.held_u[nz : 2 * nz, 0])] if linear.nu else []),
        *(map_constants(exported, label, inverse) for label, inverse in exported.maps.items()),
    ]
    if artifact.motion is not None:
        parts.append(_tracker_constants(exported, artifact.motion))
    return "".join(parts)


def _tracker_constants(exported: Exported, motion: Motion) -> str:
    """Motion, Kalman filter, divergence detection and T_inv's covariance."""
    artifact, measurement, process = exported.artifact, measurement_levels(exported), process_level(exported)
    assert process is not None
    share = "0.0"
    for each in measurement:
        share = f"LARGER({share}, {each.cut} / {number(each.end)})"
    numbers = tracker_numbers(motion, artifact.filter.dt)
    macros: dict[str, Any] = {name.upper(): value for name, value in numbers.items()}
    macros |= {"NOISE_SHARE": share, "TABULATE(map, age, P)": _TABULATE, "FAR": (2 * numbers["other"]) ** -0.5}
    arrays = tracker_arrays(motion)
    if motion.flow is not None:
        names = ("linear", "gain", *(["u_scale"] if artifact.nu else []))
        arrays |= {f"flow_{name}": getattr(motion.flow, name) for name in names}
    elif motion.equations is not None and (substeps := motion.equations.substeps):
        macros |= {"SUBSTEPS": substeps, "H": artifact.filter.dt / substeps}
    for label, inverse in exported.maps.items():
        levels, ages, covariance = table(inverse, motion.x_scale)
        macros |= {f"{label}_ROWS": len(levels), f"{label}_COLUMNS": len(ages)}
        arrays |= {f"{label}_levels": levels, f"{label}_ages": ages, f"{label}_covariance": covariance.ravel()}
    level = f"LARGER({process.macro}, {number(motion.least_process_noise)})"
    noise, least = (motion.error, motion.process_noise), motion.least_measurement_noise
    Q = [f"SQUARE({level} * {number(added)}) + {number(error**2)}" for error, added in zip(*noise, strict=True)]
    cuts = [each.cut for each in measurement] * (artifact.ny // len(measurement))
    R = [f"SQUARE(LARGER({cut}, {number(each)}))" for cut, each in zip(cuts, least, strict=True)]
    parts = ["\n/* The motion, the Kalman filter on it, and T_inv's covariance. */\n", _LARGER, defined(macros)]
    parts += [array("double", name, values) for name, values in arrays.items()]
    parts += [block("double", "Q", f"[{len(Q)}]", Q), block("double", "R", f"[{len(R)}]", R)]
    return "".join(parts) + ("" if motion.flow is None else network_arrays("flow", motion.flow.mlp))


def _functions(exported: Exported) -> dict[str, Any]:
    """Functions that differ between observers, by the words in the place of which they stand."""
    motion, networks = exported.artifact.motion, [inverse.mlp for inverse in exported.maps.values()]
    words: dict[str, Any] = {}
    if motion is not None:
        moved = "" if motion.equations is None else function("field", motion.equations.field) + "\n"
        words["/* MOTION */\n"] = moved + function("h", output_expression(exported.artifact))
        if motion.flow is not None:
            calls = network_calls("flow", motion.flow.mlp)
            words |= dict(zip(("FLOW_WIDTH", "/* LAYERS */", "MOVED"), calls, strict=True))
            networks.append(motion.flow.mlp)
    maps = "".join(map_function(exported, label, inverse) for label, inverse in exported.maps.items())
    return words | {"/* FUNCTIONS */\n\n": activations(networks, exported.precision) + maps}
