"""An observer's step as C99, with only the C library. The tracker uses doubles, as floats could make P indefinite."""

import math
import re
from collections.abc import Collection, Mapping
from functools import reduce
from importlib.resources import files
from textwrap import fill
from typing import Any

import numpy as np

import kkl_gym
from observers.expression import Expression
from observers.inverse import InverseMap
from observers.network import MLP
from training.export.exported import Exported, output_expression, tracker_arrays, tracker_numbers

_POWERS = 8  # integer exponents up to this absolute value are written as products
_CONDITIONS = {**{name: f"{{0}} {name} {{1}}" for name in ("<", "<=", ">", ">=")}, "not": "!{0}"}
_CONDITIONS |= {"and": "{0} && {1}", "or": "{0} || {1}"}
_OPERATIONS = _CONDITIONS | {  # C code with the results of NumPy's functions; each argument is a variable or a number
    **{name: f"{name}({{0}})" for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "floor")},
    **{name: f"{{0}} {name} {{1}}" for name in ("+", "*")},
    "abs": "fabs({0})",
    "sign": "isnan({0}) ? {0} : ({0} > 0.0) - ({0} < 0.0)",
    "**": "pow({0}, {1})",
    "%": "fmod({0}, {1}) + (fmod({0}, {1}) * {1} < 0.0 ? {1} : 0.0)",
    "atan2": "atan2({0}, {1})",
    "minimum": "isnan({0}) || {0} < {1} ? {0} : {1}",
    "maximum": "isnan({0}) || {0} > {1} ? {0} : {1}",
    "where": "{0} ? {1} : {2}",
}


def c_files(exported: Exported) -> dict[str, str]:
    """Return the observer's C files: their texts by name."""
    artifact, name, motion = exported.artifact, exported.name, exported.artifact.motion
    networks = {label: inverse.mlp for label, inverse in exported.maps.items()}
    single, signals = exported.precision == "float", exported.signals
    parts = {"inputs" if artifact.nu else "autonomous", "static" if motion is None else "tracks", *exported.maps}
    texts = {"SOURCE": exported.source, "SYSTEM": artifact.system, "OUTPUTS": ", ".join(signals["y"])}
    texts |= {"INPUTS": ", ".join(signals["u"]), "ESTIMATES": ", ".join(signals["x_hat"])}
    words: dict[str, object] = {key: comment(text) for key, text in texts.items()}
    words |= {"NAME": name, "MACRO": name.upper(), "VERSION": kkl_gym.__version__, "CHECKSUM": exported.checksum}
    words |= {"LEVELS": ", ".join(map(str, exported.levels)), "PROCESS": exported.process_noise}
    words |= {"TANH": "tanhf" if single else "tanh", "DIGITS": 9 if single else 17, "PRECISION": exported.precision}
    words |= {"COUNT_X": len(signals["x_hat"]), "COUNT_Y": artifact.ny, "COUNT_U": artifact.nu}
    words |= {"COUNT_Z": artifact.filter.size, "SECONDS": artifact.filter.dt}
    if motion is not None and (h := output_expression(artifact)):
        moved = ""
        if motion.equations is not None:
            parts |= {"equations", "continuous" if motion.equations.substeps else "discrete"}
            moved = function("field", motion.equations.field) + "\n"
        elif motion.flow is not None:
            parts |= {"flow"}
            networks["flow"] = motion.flow.mlp
            words |= network_calls("flow", motion.flow.mlp, "FLOW_WIDTH", "MOVED")
        words["/* MOTION */\n"] = moved + function("h", h)
    parts |= {mlp.activation for mlp in networks.values() if len(mlp.weights) > 1}
    words["/* MAPS */\n"] = "".join(_map(exported, label, inverse) for label, inverse in exported.maps.items())
    words["/* CONSTANTS */\n"] = _constants(exported, networks)
    endings = {".h": "observer.h", ".c": "observer.c", "_main.c": "main.c"}
    return {f"{name}{ending}": template(source, words, parts) for ending, source in endings.items()}


def _constants(exported: Exported, networks: Mapping[str, MLP]) -> str:
    """Return the C definitions of sizes and arrays."""
    linear, motion = exported.artifact.filter, exported.artifact.motion
    nz, dt = len(linear.A), linear.dt
    rows, columns = np.nonzero(block := linear.transition[:nz, :nz])
    last = max((inverse.age_max for inverse in exported.maps.values() if "age" in inverse.features), default=0.0)
    macros: dict[str, Any] = {name: f"{exported.name.upper()}_{name}" for name in ("NX", "NY", "NU", "DT")}
    macros |= {"NZ": nz, "SIZE": linear.size, "TRANSITIONS": len(rows)}
    macros["LAST_AGE"] = f"{min(math.ceil(last / dt), 2**32 - 1)}ul"  # C guarantees this range of unsigned long
    arrays = {"transition": block[rows, columns], "transition_row": rows, "transition_column": columns}
    arrays |= {name: getattr(linear, name)[:nz] for name in ("early_y", "late_y", "equilibrium")}
    if linear.nu:
        arrays["held_u"] = linear.held_u[nz : 2 * nz, 0]
    for label, inverse in exported.maps.items():
        arrays |= {f"{label}_{name}": getattr(inverse, name) for name in ("z_offset", "x_offset", "x_scale")}
        arrays[f"{label}_whiten"] = inverse.gain(exported.measurement_noise)[:, None] * inverse.whiten
    if motion is not None:
        numbers = tracker_numbers(motion, dt)
        macros |= {name.upper(): value for name, value in numbers.items()} | {"FAR": (2 * numbers["other"]) ** -0.5}
        levels = exported.measurement_noise, exported.process_noise
        arrays |= tracker_arrays(motion) | dict(zip("QR", motion.variances(*levels), strict=True))
        if motion.equations is not None and (substeps := motion.equations.substeps):
            macros |= {"SUBSTEPS": substeps, "H": dt / substeps}
        if motion.flow is not None:
            names = ("linear", "gain", "u_scale") if linear.nu else ("linear", "gain")
            arrays |= {f"flow_{name}": getattr(motion.flow, name) for name in names}
        for label, inverse in exported.maps.items():
            assert inverse.error_covariance is not None
            ages = inverse.error_covariance.ages / dt  # in samples
            ages = np.append(ages[ages < numbers["window"]], numbers["window"])
            by_age = inverse.error_covariance.at_level(inverse.shares(levels[0])[0])
            covariance = by_age(ages * dt) / np.outer(motion.x_scale, motion.x_scale)
            arrays |= {f"{label}_ages": ages, f"{label}_covariance": covariance.ravel()}
    layers = {
        f"{label}_{kind}{i}": np.asarray(values, np.float32).reshape(-1)
        for label, mlp in networks.items()
        for i, layer in enumerate(zip(mlp.weights, mlp.biases, strict=True))
        for kind, values in zip(("weights", "biases"), layer, strict=True)
    }
    defined = [f"#define {name} {value}\n" for name, value in macros.items()]
    return "".join(defined + [array(name, values) for name, values in (arrays | layers).items()])


def _map(exported: Exported, label: str, inverse: InverseMap) -> str:
    """Return the C function of T_inv, with the noise levels as constants."""
    modes, size = inverse.whiten.shape
    words: dict[str, Any] = network_calls(label, inverse.mlp, "WIDTH", "OUT")
    levels = inverse.noise_features(exported.measurement_noise, exported.process_noise)
    given = "".join(f"    a[{modes + i}] = (real){level};\n" for i, level in enumerate(levels))
    words |= {"NAME": exported.name, "MAP": label, "MODES": modes, "COORDINATES": size, "/* LEVELS */\n": given}
    words |= {"AGE": modes + len(levels), "END": inverse.age_max, "UNIT": inverse.age_unit}
    return template("map.c", words, inverse.features)


def template(name: str, words: Mapping[str, object], parts: Collection[str]) -> str:
    """Replace words in a file of folder ``c``, and cut from "// if PART" to "// end PART" unless ``parts`` has PART."""
    text = files("training.export").joinpath("c", name).read_text(encoding="utf-8")
    ranges = re.compile(r"// if (\w+)\n(.*?)// end \1\n", re.DOTALL)
    while ranges.search(text):
        text = ranges.sub(lambda found: found[2] if found[1] in parts else "", text)
    return re.sub("|".join(sorted(map(re.escape, words), key=len, reverse=True)), lambda m: str(words[m[0]]), text)


def array(name: str, values: np.ndarray) -> str:
    """Return a constant C array, with the fewest digits that reproduce each number; integers are unsigned short."""
    kind = {"float32": "float", "float64": "double"}.get(values.dtype.name, "unsigned short")
    words = [f"{word}f" if kind == "float" else word for word in values.astype(str).flat]
    if values.ndim == 2:
        words = ["{" + ", ".join(row) + "}" for row in np.reshape(words, values.shape)]
    shape = "".join(f"[{length}]" for length in values.shape)
    lines = fill(", ".join(words), 118, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    return f"static const {kind} {name}{shape} = {{\n{lines}\n}};\n"


def comment(text: str) -> str:
    """Return names as text that is safe inside a C comment: on one line, and without marks that end the comment."""
    return " ".join(text.split()).replace("/*", "/ *").replace("*/", "* /").replace("\\", "/").replace("??", "?")


def network_calls(prefix: str, mlp: MLP, width: str, out: str) -> dict[str, object]:
    """Return a template's words for a network: width of the buffers a and b, calls of layers, buffer of the result."""
    calls, rows = [], "ab"
    for i, (outputs, inputs) in enumerate(map(np.shape, mlp.weights)):
        if i:
            calls.append(f"activate_{mlp.activation}({rows[0]}, {inputs});")
        calls.append(f"layer({rows[0]}, {inputs}, {prefix}_weights{i}, {prefix}_biases{i}, {rows[1]}, {outputs});")
        rows = rows[::-1]
    return {width: max(map(max, map(np.shape, mlp.weights))), "/* LAYERS */": "\n    ".join(calls), out: rows[0]}


def function(name: str, expression: Expression) -> str:
    """Return a C function ``name(x, u, out)``, which computes repeated parts of an expression only once."""
    lines: list[str] = []
    variables: dict[str, str] = {}

    def variable(value: str, kind: str) -> str:
        if value not in variables:
            variables[value] = f"{kind[0]}{len(variables)}"
            lines.append(f"    const {kind} {variables[value]} = {value};\n")
        return variables[value]

    def written(part: Any) -> str:
        if not isinstance(part, tuple):
            return f"({part!r})"
        operation, *arguments = part
        if operation in ("x", "u"):
            return f"{operation}[{arguments[0]}]"
        first, *others = map(written, arguments)
        exponent = arguments[-1] if operation == "**" else None
        if isinstance(exponent, float) and exponent.is_integer() and 0 < abs(exponent) <= _POWERS:
            product = " * ".join([first] * int(abs(exponent)))
            return variable(product if exponent > 0 else f"1.0 / ({product})", "double")
        form, kind = _OPERATIONS[operation], "int" if operation in _CONDITIONS else "double"
        if operation == "where" or not others:
            return variable(form.format(first, *others), kind)
        return reduce(lambda one, other: variable(form.format(one, other), kind), others, first)

    results = [f"    out[{i}] = {written(part)};\n" for i, part in enumerate(expression.components)]
    head = f"static void {name}(const double x[NX], const real *u, double *out)\n{{\n    (void)x, (void)u;\n"
    return "".join([head, *lines, *results, "}\n"])
