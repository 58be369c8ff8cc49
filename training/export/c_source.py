"""The step as C99: a header, a source without dependencies but math.h, and a program that shows how they are used.

A tracker's estimates and covariances are doubles whatever the precision is: P is what differences leave, and in floats
its factor would break down.
"""

from textwrap import fill
from typing import Any

import numpy as np

import kkl_gym
from observers.inverse import InverseMap
from observers.motion import Motion
from training.export.c_text import (
    activations,
    array,
    comment,
    function,
    network_arrays,
    network_calls,
    number,
    template,
)
from training.export.exported import Exported, output_expression, tracker_arrays, tracker_numbers

_MAP = """\
static void {map}_map(const {name}_observer *observer, real *x_hat)
{{
    real a[{width}], b[{width}];
    for (int i = 0; i < {modes}; i++) {{
        double mode = 0.0;
        for (int j = 0; j < {size}; j++)
            mode += {map}_whiten[i][j] * (observer->z[j] - {map}_z_offset[j]);
        a[i] = (real)mode;
    }}
{conditions}    {layers}
    for (int i = 0; i < NX; i++)
        x_hat[i] = (real)({map}_x_offset[i] + {map}_x_scale[i] * {last}[i]);
}}

"""
_AGE = "    a[{at}] = (real)log1p((observer->age * DT < {end} ? observer->age * DT : {end}) / {unit});\n"


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
    artifact = exported.artifact
    finite = (
        "Samples and inputs must be finite: a NaN stays until the next reset."
        if artifact.motion is None
        else "Where an output is missing, pass NaN: it is predicted. The first sample and inputs must be finite, and "
        "the compiler must know NaN, as it does without -ffast-math."
    )
    levels = []
    if exported.levels:
        levels.append(f"measurement noise of standard deviation {', '.join(map(number, exported.levels))}")
    if exported.needs_process_noise:
        levels.append(f"process noise of level {number(exported.process_noise)}")
    text = (
        f"{exported.name}_reset takes in the first sample, {exported.name}_step every later one. {finite} Nothing is "
        "allocated, and observers share constants alone."
    )
    text += f" It assumes {' and '.join(levels)}." * bool(levels)
    return {
        "SYSTEM": comment(artifact.system),
        "SECONDS": number(artifact.filter.dt),
        "VERSION": kkl_gym.__version__,
        "SOURCE": comment(exported.source),
        "CHECKSUM": exported.checksum,
        "ESTIMATES": comment(", ".join(exported.estimates)),
        "PARAGRAPH": fill(text, 116, initial_indent=" * ", subsequent_indent=" * ", break_on_hyphens=False),
        "PRECISION": exported.precision,
        "COUNT_X": str(len(exported.estimates)),
        "COUNT_Y": str(artifact.ny),
        "COUNT_U": str(artifact.nu),
        "COUNT_Z": str(artifact.filter.size),
    }


def _constants(exported: Exported) -> str:
    """Sizes and arrays."""
    linear, motion = exported.artifact.filter, exported.artifact.motion
    nz = len(linear.A)
    block = linear.transition[:nz, :nz]
    rows, columns = np.nonzero(block)
    macros: dict[str, Any] = {name: f"{exported.name.upper()}_{name}" for name in ("NX", "NY", "NU", "DT")}
    macros |= {"NZ": nz, "SIZE": linear.size, "TRANSITIONS": len(rows), "LAST_AGE": f"{exported.last_age}ul"}
    arrays = {"transition": block[rows, columns], "transition_row": rows, "transition_column": columns}
    arrays |= {name: getattr(linear, name)[:nz] for name in ("early_y", "late_y", "equilibrium")}
    networks = {label: inverse.mlp for label, inverse in exported.maps.items()}
    if linear.nu:
        arrays["held_u"] = linear.held_u[nz : 2 * nz, 0]
    for label, inverse in exported.maps.items():
        own = {name: getattr(inverse, name) for name in ("z_offset", "x_offset", "x_scale")}
        own["whiten"] = inverse.gain(exported.measurement_noise)[:, None] * inverse.whiten
        arrays |= {f"{label}_{name}": values for name, values in own.items()}
    if motion is not None:
        numbers = tracker_numbers(motion, linear.dt)
        macros |= {name.upper(): value for name, value in numbers.items()} | {"FAR": (2 * numbers["other"]) ** -0.5}
        arrays |= _tracker_arrays(exported, motion, numbers["window"])
        if motion.flow is not None:
            networks["flow"] = motion.flow.mlp
        elif motion.equations is not None and (substeps := motion.equations.substeps):
            macros |= {"SUBSTEPS": substeps, "H": linear.dt / substeps}
    parts = [f"#define {name} {value}\n" for name, value in macros.items()]
    parts += [array(name, values) for name, values in arrays.items()]
    return "".join(parts + [network_arrays(label, mlp) for label, mlp in networks.items()])


def _tracker_arrays(exported: Exported, motion: Motion, window: int) -> dict[str, np.ndarray]:
    """Motion, Kalman filter, and T_inv's covariance at ages in samples up to the window."""
    dt, levels = exported.artifact.filter.dt, (exported.measurement_noise, exported.process_noise)
    arrays = tracker_arrays(motion) | dict(zip("QR", motion.variances(*levels), strict=True))
    if motion.flow is not None:
        arrays |= {f"flow_{name}": getattr(motion.flow, name) for name in ("linear", "gain")}
        arrays |= {"flow_u_scale": motion.flow.u_scale} if exported.artifact.nu else {}
    for label, inverse in exported.maps.items():
        assert inverse.error_covariance is not None
        ages = np.append((ages := inverse.error_covariance.ages / dt)[ages < window], window)
        by_age = inverse.error_covariance.at_level(inverse.shares(exported.measurement_noise)[0])
        covariance = by_age(ages * dt) / np.outer(motion.x_scale, motion.x_scale)
        arrays |= {f"{label}_ages": ages, f"{label}_covariance": covariance.ravel()}
    return arrays


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
    maps = "".join(_map(exported, label, inverse) for label, inverse in exported.maps.items())
    return words | {"/* FUNCTIONS */\n\n": activations(networks, exported.precision) + maps}


def _map(exported: Exported, label: str, inverse: InverseMap) -> str:
    """T_inv as a function; the levels of noise are constants."""
    modes, size = inverse.whiten.shape
    width, layers, last = network_calls(label, inverse.mlp)
    levels = inverse.noise_features(exported.measurement_noise, exported.process_noise)
    conditions = [f"    a[{modes + i}] = (real){number(level)};\n" for i, level in enumerate(levels)]
    if "age" in inverse.features:
        end, unit = number(inverse.age_max), number(inverse.age_unit)
        conditions.append(_AGE.format(at=modes + len(levels), end=end, unit=unit))
    words = {"modes": modes, "size": size, "width": width, "layers": layers, "last": last}
    return _MAP.format(map=label, name=exported.name, conditions="".join(conditions), **words)
