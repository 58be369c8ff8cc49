"""Networks as machine code. It needs Numba."""

import math
from typing import Any

import numpy as np

from observers.machine import kernel, part
from observers.network import UNROLLED

_OPTIONS: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
_kernel, _part = kernel(**_OPTIONS), part(**_OPTIONS)  # NaN and infinity keep their meaning

# tanh(x)/x as a quotient of polynomials in x^2 of the least relative error, 2e-8, or 4e-7 with the rounding of float32.
# Loops take many values of it at a time.
_P = tuple(map(np.float32, (2.40733336e-11, -1.48956287e-08, 9.93605136e-06, 2.99177715e-03, 1.29846185e-01, 1.0)))
_Q = tuple(map(np.float32, (2.38041306e-04, 2.40518041e-02, 4.63179380e-01, 1.0)))
_END = np.float32(7.90531110763549805)  # beyond which float32 knows no difference to 1
_HALF, _ZERO = np.float32(0.5), np.float32(0.0)


@_part
def _tanh(x: Any) -> Any:
    x = -_END if x < -_END else x
    x = _END if x > _END else x
    s = x * x
    above = ((((_P[0] * s + _P[1]) * s + _P[2]) * s + _P[3]) * s + _P[4]) * s + _P[5]
    return x * above / (((_Q[0] * s + _Q[1]) * s + _Q[2]) * s + _Q[3])


@_part
def _silu(x: Any) -> Any:
    x = _HALF * x  # as observers.network has it
    return x + x * _tanh(x)


@_part
def _relu(x: Any) -> Any:
    return _ZERO if x < _ZERO else x


@_part
def _activate(h: Any, kind: int) -> None:
    if kind == 0:
        for j in range(len(h)):
            h[j] = _tanh(h[j])
    elif kind == 1:
        for j in range(len(h)):
            h[j] = _silu(h[j])
    else:
        for j in range(len(h)):
            h[j] = _relu(h[j])


@_part
def evaluate(x: Any, packed: Any, shape: Any, between: Any, out: Any) -> None:
    """A network for one sample; its shape is the activation and the widths, and x may lie in ``between``'s first row.

    Shapes: ``between`` (3, the largest width and UNROLLED more).
    """
    h, into, at = between[0], between[1], 0
    for j in range(len(x)):
        h[j] = x[j]
    for layer in range(1, len(shape) - 1):
        inputs, width = shape[layer], shape[layer + 1]
        for j in range(inputs, inputs + UNROLLED):
            h[j] = _ZERO  # beside the rows of zeros
        for j in range(width):
            into[j] = packed[at + j]
        at += width
        for i in range(0, inputs, UNROLLED):
            a, b, c, d = h[i], h[i + 1], h[i + 2], h[i + 3]
            first, second = packed[at : at + width], packed[at + width : at + 2 * width]
            third, fourth = packed[at + 2 * width : at + 3 * width], packed[at + 3 * width : at + 4 * width]
            for j in range(width):
                into[j] += a * first[j] + b * second[j] + c * third[j] + d * fourth[j]
            at += 4 * width
        if layer < len(shape) - 2:
            _activate(into[:width], shape[0])
        h, into = into, h
    for j in range(len(out)):
        out[j] = h[j]


@_part
def decode(z: Any, age: float, network: Any, between: Any, out: Any) -> None:
    """T_inv of one sample: the first layer on z and age in doubles, and the network behind it."""
    first, units, ages, packed, shape = network
    width, size = first.shape[1], len(z)
    sums = np.empty(width)
    age = math.log1p(min(age, ages[1]) / ages[0])
    for j in range(width):
        sums[j] = first[0, j] + age * first[1, j]
    for i in range(0, size - 1, 2):
        a, b = z[i], z[i + 1]
        for j in range(width):
            sums[j] += a * first[i + 2, j] + b * first[i + 3, j]
    if size % 2:
        for j in range(width):
            sums[j] += z[size - 1] * first[size + 1, j]
    entered, found = between[0, :width], between[2, : len(out)]
    for j in range(width):
        entered[j] = sums[j]
    if len(shape) > 2:
        _activate(entered, shape[0])
        evaluate(entered, packed, shape, between, found)
    else:
        for j in range(len(out)):
            found[j] = entered[j]
    for j in range(len(out)):
        out[j] = units[0, j] + units[1, j] * found[j]


@_kernel
def decode_one(z: Any, age: float, network: Any, out: Any) -> None:
    """T_inv of one sample."""
    widest = network[0].shape[1]
    for width in network[4][1:]:
        widest = max(widest, width)
    decode(z, age, network, np.empty((3, widest + UNROLLED), np.float32), out)


__all__ = ["decode", "decode_one", "evaluate"]
