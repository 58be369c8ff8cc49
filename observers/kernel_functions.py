"""Networks, equations of motion and outputs h(x) as machine code, called by :mod:`observers.kernel`. It needs Numba."""

import functools
import math
from typing import Any

import numpy as np
from numba import types

from observers.expression import Expression
from observers.lanes import offset, stack
from observers.machine import kernel, part, pointer
from observers.network import UNROLLED

# Fast arithmetic, but without the flags that assume there is no NaN and no infinity.
OPTIONS: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
_POINTER = types.CPointer(types.float64)
_SIGNATURE = types.void(_POINTER, _POINTER, types.int64, types.float64)
_kernel, _part = kernel(**OPTIONS), part(**OPTIONS)

# tanh(x)/x as a quotient of polynomials in x^2, relative error < 4e-8 (< 4e-7 in float32). The compiler vectorises it.
_P = tuple(map(np.float32, (2.40733336e-11, -1.48956287e-08, 9.93605136e-06, 2.99177715e-03, 1.29846185e-01, 1.0)))
_Q = tuple(map(np.float32, (2.38041306e-04, 2.40518041e-02, 4.63179380e-01, 1.0)))
_END = np.float32(7.90531110763549805)  # larger arguments count as this one: tanh(x) is 1 within 3e-7
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
    x = _HALF * x  # the same formula as in observers.network
    return x + x * _tanh(x)


@_part
def _relu(x: Any) -> Any:
    return _ZERO if x < _ZERO else x


@_part
def _activate(h: Any, width: int, kind: int) -> None:
    if kind == 0:
        for j in range(width):
            h[j] = _tanh(h[j])
    elif kind == 1:
        for j in range(width):
            h[j] = _silu(h[j])
    else:
        for j in range(width):
            h[j] = _relu(h[j])


@_part
def evaluate(packed: Any, shape: Any, between: Any) -> Any:
    """Evaluate a network for one sample, the first row of ``between``. Returns a pointer to the network's outputs.

    ``packed`` holds biases and weights, ``shape`` the activation and the widths. Layers overwrite ``between``, of shape
    (2, largest width + UNROLLED).
    """
    h, into, at = offset(between, 0), offset(between, between.shape[1]), 0
    for layer in range(1, len(shape) - 1):
        inputs, width = shape[layer], shape[layer + 1]
        for j in range(inputs, inputs + UNROLLED):
            h[j] = _ZERO  # zeros pad the inputs to a multiple of UNROLLED
        for j in range(width):
            into[j] = packed[at + j]
        at += width
        for i in range(0, inputs, UNROLLED):
            a, b, c, d = h[i], h[i + 1], h[i + 2], h[i + 3]
            first, second = offset(packed, at), offset(packed, at + width)
            third, fourth = offset(packed, at + 2 * width), offset(packed, at + 3 * width)
            for j in range(width):
                into[j] += a * first[j] + b * second[j] + c * third[j] + d * fourth[j]
            at += 4 * width
        if layer < len(shape) - 2:
            _activate(into, width, shape[0])
        h, into = into, h
    return h


@_part
def decode(z: Any, age: float, network: Any, between: Any, out: Any) -> None:
    """Evaluate T_inv for one sample. The first layer takes z and age in double precision, the others are float32."""
    first, units, ages, packed, shape = network
    size, width = first.shape[0] - 2, first.shape[1]
    sums = stack(width, 1)
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
    outputs = offset(between, 0)
    for j in range(width):
        outputs[j] = sums[j]
    if len(shape) > 2:
        _activate(outputs, width, shape[0])
        outputs = evaluate(packed, shape, between)
    for j in range(units.shape[1]):
        out[j] = units[0, j] + units[1, j] * outputs[j]


@_kernel
def decode_one(z: Any, age: float, network: Any, out: Any) -> None:
    """Evaluate T_inv for one sample; Python calls this function."""
    widest = network[0].shape[1]
    for width in network[4][1:]:
        widest = max(widest, width)
    decode(offset(z, 0), age, network, np.empty((2, widest + UNROLLED), np.float32), offset(out, 0))


@functools.cache
def motion(expression: Expression, nx: int, nu: int, W: int, discrete: bool) -> Any:
    """Compile equations to a function that moves sigma points in place, by Runge-Kutta or discrete steps.

    One array (nx + nu, points, W) holds the states and inputs of all sigma points, for W rows of the batch.
    """
    wide, field, inputs = (2 * nx + 1) * W, expression.python("field", nx, nu), [f"u{j}" for j in range(nu)]
    states = [f"x{i}" for i in range(nx)]
    given = ", ".join(states + inputs)
    lines = ["def step(s, p, h):", *(f"    {name} = s[{i * wide} + p]" for i, name in enumerate(states + inputs))]
    for stage, (before, share) in enumerate((("", ""), ("a", "0.5 * h * "), ("b", "0.5 * h * "), ("c", "h * "))):
        moved = [f"x{i} + {share}{before}[{i}]" if before else f"x{i}" for i in range(nx)]
        lines.append(f"    {'abcd'[stage]} = field({', '.join(moved + inputs)})")
    lines += [
        f"    s[{i * wide} + p] = x{i} + h / 6.0 * (a[{i}] + 2.0 * (b[{i}] + c[{i}]) + d[{i}])" for i in range(nx)
    ]
    if discrete:
        lines[1 + nx + nu :] = [f"    a = field({given})", *(f"    s[{i * wide} + p] = a[{i}]" for i in range(nx))]
    step = _function("\n".join(lines), "step", field=field)

    def move(s: Any, _: Any, substeps: int, h: float) -> None:
        for _ in range(substeps):
            for p in range(wide):
                step(s, p, h)

    return pointer(move, _SIGNATURE, **OPTIONS)


@functools.cache
def output(expression: Expression, nx: int, W: int) -> Any:
    """Compile h(x) to a function that writes outputs (ny, points, W) at sigma points (nx, points, W), for W rows."""
    wide, ny = (2 * nx + 1) * W, len(expression.components)
    function = expression.python("function", nx, 0)
    given = ", ".join(f"s[{i * wide} + p]" for i in range(nx))
    lines = [
        "def at(s, out, p):",
        f"    y = function({given})",
        *(f"    out[{k * wide} + p] = y[{k}]" for k in range(ny)),
    ]
    at = _function("\n".join(lines), "at", function=function)

    def measure(s: Any, out: Any, _: int, h: float) -> None:
        for p in range(wide):
            at(s, out, p)

    return pointer(measure, _SIGNATURE, **OPTIONS)


def _function(source: str, name: str, **names: str) -> Any:
    """Build a function from its source and the sources of the functions that it calls."""
    namespace: dict[str, Any] = {"np": np}
    for inner, text in names.items():
        exec(text, namespace)
        namespace[inner] = _part(namespace[inner])
    exec(source, namespace)
    return _part(namespace[name])
