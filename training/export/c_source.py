"""The step as C99: a header, a source without dependencies but math.h, and a program that shows how they are used.

A tracker's estimates and covariances are doubles whatever the precision is: P is what differences leave, and in floats
its factor would break down.
"""

import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from textwrap import fill
from typing import Any

import numpy as np

import kkl_gym
from observers.expression import Expression
from observers.inverse import InverseMap
from observers.motion import Motion
from observers.network import MLP
from training.export.exported import Exported, output_expression, tracker_arrays, tracker_numbers

_POWERS = 8  # up to which an exponent becomes products
_ACTIVATIONS = {
    "tanh": "h[i] = {tanh}(h[i]);",
    "silu": "h[i] = (real)0.5 * h[i] + (real)0.5 * h[i] * {tanh}((real)0.5 * h[i]);",
    "relu": "h[i] = h[i] > 0 ? h[i] : 0;",
}
_OPERATIONS = {  # of values in variables, as NumPy has them
    **{name: f"{name}({{0}})" for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "floor")},
    **{name: f"{{0}} {name} {{1}}" for name in ("+", "*", "<", "<=", ">", ">=")},
    "abs": "fabs({0})",
    "sign": "isnan({0}) ? {0} : ({0} > 0.0) - ({0} < 0.0)",
    "**": "pow({0}, {1})",
    "%": "fmod({0}, {1}) + (fmod({0}, {1}) * {1} < 0.0 ? {1} : 0.0)",
    "atan2": "atan2({0}, {1})",
    "minimum": "isnan({0}) || {0} < {1} ? {0} : {1}",
    "maximum": "isnan({0}) || {0} > {1} ? {0} : {1}",
    "where": "{0} ? {1} : {2}",
    "and": "{0} && {1}",
    "or": "{0} || {1}",
    "not": "!{0}",
}
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


def template(name: str, words: Mapping[str, object], **chosen: bool) -> str:
    """A file of the folder ``c``: words are replaced, and parts between "// if" and "// end" stay where chosen."""
    text = files("training.export").joinpath("c", name).read_text(encoding="utf-8")

    def kept(match: re.Match[str]) -> str:
        return part.sub(kept, match[2]) if chosen[match[1]] else ""

    part = re.compile(r"// if (\w+)\n(.*?)// end \1\n", re.DOTALL)
    text = part.sub(kept, text)
    return re.sub("|".join(sorted(map(re.escape, words), key=len, reverse=True)), lambda m: str(words[m[0]]), text)


def number(value: float) -> str:
    """The shortest decimals that are read back as the same double."""
    return repr(float(value))


def array(name: str, values: np.ndarray) -> str:
    """A constant array; numbers are the shortest that are read back as the same, and integers unsigned short."""
    flat = values.reshape(-1)
    if values.dtype == np.float32:
        kind, words = "float", [f"{word}f" for word in flat.astype(str).tolist()]
    else:
        kind, words = ("double" if values.dtype == float else "unsigned short"), list(map(repr, flat.tolist()))
    if values.ndim == 2:
        rows = (words[first : first + values.shape[1]] for first in range(0, len(words), values.shape[1]))
        words = ["{" + ", ".join(row) + "}" for row in rows]
    shape = "".join(f"[{length}]" for length in values.shape)
    lines = fill(", ".join(words), 118, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    return f"static const {kind} {name}{shape} = {{\n{lines}\n}};\n"


def comment(text: str) -> str:
    """Names of others as a comment can hold them: on one line, and without its end."""
    return " ".join(text.split()).replace("/*", "/ *").replace("*/", "* /").replace("\\", "/").replace("??", "?")


def network_arrays(prefix: str, mlp: MLP) -> str:
    """The weights and biases of a network, which are floats in Python, too."""
    return "".join(
        array(f"{prefix}_weights{i}", np.asarray(weight, np.float32).reshape(-1))
        + array(f"{prefix}_biases{i}", np.asarray(bias, np.float32))
        for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True))
    )


def network_calls(prefix: str, mlp: MLP) -> tuple[int, str, str]:
    """Width of the rows a and b, the calls that lead from inputs in a to outputs, and the row that these are in."""
    layers, here, there = [], "a", "b"
    for i, weight in enumerate(mlp.weights):
        outputs, inputs = weight.shape
        if i:
            layers.append(f"activate_{mlp.activation}({here}, {inputs});")
        layers.append(f"layer({here}, {inputs}, {prefix}_weights{i}, {prefix}_biases{i}, {there}, {outputs});")
        here, there = there, here
    return max(max(weight.shape) for weight in mlp.weights), "\n    ".join(layers), here


def activations(networks: Sequence[MLP], precision: str) -> str:
    """The functions that the networks need between layers."""
    parts, tanh = [], "tanhf" if precision == "float" else "tanh"
    for name in dict.fromkeys(mlp.activation for mlp in networks if len(mlp.weights) > 1):
        parts.append(f"static void activate_{name}(real *h, int n)\n{{\n    for (int i = 0; i < n; i++)\n")
        parts.append(f"        {_ACTIVATIONS[name].format(tanh=tanh)}\n}}\n\n")
    return "".join(parts)


def function(name: str, expression: Expression) -> str:
    """A function ``name(x, u, out)``; what appears in an expression more than once is computed once."""
    lines: list[str] = []
    variables: dict[object, str] = {}

    def variable(part: object, kind: str, value: str) -> str:
        if part not in variables:
            variables[part] = f"{kind[0]}{len(variables)}"
            lines.append(f"    const {kind} {variables[part]} = {value};\n")
        return variables[part]

    def written(part: object) -> str:
        if not isinstance(part, tuple):
            return f"({part!r})"
        operation, *arguments = part
        if operation in ("x", "u"):
            return f"{operation}[{arguments[0]}]"
        first, *others = map(written, arguments)
        exponent = arguments[1] if operation == "**" else None
        if isinstance(exponent, float) and exponent.is_integer() and 0 < abs(exponent) <= _POWERS:
            product = " * ".join([first] * int(abs(exponent)))
            return variable(part, "double", product if exponent > 0 else f"1.0 / ({product})")
        text, kind = (
            _OPERATIONS[operation],
            "int" if operation in ("<", "<=", ">", ">=", "and", "or", "not") else "double",
        )
        if operation == "where" or not others:
            return variable(part, kind, text.format(first, *others))
        for i, other in enumerate(others):
            first = variable((*part[: i + 3],), kind, text.format(first, other))
        return first

    results = [f"    out[{i}] = {written(part)};\n" for i, part in enumerate(expression.components)]
    head = f"static void {name}(const double x[NX], const real *u, double *out)\n{{\n    (void)x, (void)u;\n"
    return "".join([head, *lines, *results, "}\n"])
