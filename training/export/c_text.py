"""Numbers, arrays, names and networks as C99 holds them."""

from collections.abc import Sequence

import numpy as np

from observers.network import MLP

_WIDTH = 118  # of lines of numbers


def number(value: float) -> str:
    """The shortest decimals that are read back as the same double."""
    return repr(float(value))


def array(kind: str, name: str, values: np.ndarray) -> str:
    """A constant array of one or two dimensions; numbers are the shortest that are read back as the same."""
    if kind == "float":
        words = [f"{number}f" for number in np.asarray(values, np.float32).astype(str).tolist()]
    elif kind == "double":
        words = list(map(repr, np.asarray(values, float).reshape(-1).tolist()))
    else:
        words = list(map(str, values.tolist()))
    shape = "".join(f"[{length}]" for length in np.shape(values))
    if np.ndim(values) < 2:
        return block(kind, name, shape, words)
    width = np.shape(values)[1]
    rows = [words[first : first + width] for first in range(0, len(words), width)]
    return block(kind, name, shape, ["{" + ", ".join(row) + "}" for row in rows])


def block(kind: str, name: str, shape: str, words: Sequence[str]) -> str:
    """A constant array whose entries are expressions of C."""
    lines, line = [], "   "
    for word in words:
        if len(line) + len(word) > _WIDTH and line.strip():
            lines.append(line)
            line = "   "
        line += f" {word},"
    return "\n".join([f"static const {kind} {name}{shape} = {{", *lines, line, "};", ""])


def comment(text: str) -> str:
    """Names of others as a comment can hold them: on one line, and without its end."""
    return " ".join(text.split()).replace("/*", "/ *").replace("*/", "* /").replace("\\", "/").replace("??", "?")


def network_arrays(prefix: str, mlp: MLP) -> list[str]:
    """The weights and biases of a network."""
    parts = []
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        parts.append(array("float", f"{prefix}_weights{i}", weight.reshape(-1)))
        parts.append(array("float", f"{prefix}_biases{i}", bias))
    return parts


def network_words(prefix: str, mlp: MLP) -> dict[str, object]:
    """What templates need of a network: ``width`` of a and b, the ``layers`` from a on, and the ``last`` of the two."""
    layers, here, there = [], "a", "b"
    for i, weight in enumerate(mlp.weights):
        outputs, inputs = weight.shape
        if i:
            layers.append(f"    activate_{mlp.activation}({here}, {inputs});\n")
        layers.append(f"    layer({here}, {inputs}, {prefix}_weights{i}, {prefix}_biases{i}, {there}, {outputs});\n")
        here, there = there, here
    return {"width": max(max(weight.shape) for weight in mlp.weights), "layers": "".join(layers), "last": here}
