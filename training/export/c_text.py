"""Numbers, arrays, names, networks and expressions as C99 holds them, and templates of C of which parts are chosen."""

import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from textwrap import fill

import numpy as np

from observers.expression import Expression
from observers.network import MLP

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
