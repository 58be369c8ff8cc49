"""A system's motion and output as machine code that the kernel calls by its address. It needs Numba."""

import functools
from typing import Any

import numpy as np
from numba import types

from observers.expression import Expression
from observers.machine import part, pointer

OPTIONS: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz"}, "error_model": "numpy"}
_POINTER = types.CPointer(types.float64)
_SIGNATURE = types.void(_POINTER, _POINTER, types.int64, types.float64)
_part = part(**OPTIONS)


def padded(nx: int, W: int) -> int:
    """Sigma points of nx states, and for a single row as many more as fill the processor's registers."""
    return -(-(2 * nx + 1) // 4) * 4 if W == 1 else 2 * nx + 1


@functools.cache
def motion(expression: Expression, nx: int, nu: int, W: int, discrete: bool) -> Any:
    """The equations' step of all sigma points of W rows, in place, in so many Runge-Kutta steps of h.

    States and inputs lie in one array (nx + nu, points, W).
    """
    wide, field, inputs = padded(nx, W) * W, expression.python("field", nx, nu), [f"u{j}" for j in range(nu)]
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
    """The outputs (ny, points, W) of the first sigma points (nx, points, W) of W rows."""
    wide, ny = padded(nx, W) * W, len(expression.components)
    function = expression.python("function", nx, 0)
    given = ", ".join(f"s[{i * wide} + p]" for i in range(nx))
    lines = [
        "def at(s, out, p):",
        f"    y = function({given})",
        *(f"    out[{k * wide} + p] = y[{k}]" for k in range(ny)),
    ]
    at = _function("\n".join(lines), "at", function=function)

    def measure(s: Any, out: Any, count: int, h: float) -> None:
        for p in range(count * W):
            at(s, out, p)

    return pointer(measure, _SIGNATURE, **OPTIONS)


def _function(source: str, name: str, **names: str) -> Any:
    """A function by its source, and by the sources of those that it calls."""
    namespace: dict[str, Any] = {"np": np}
    for inner, text in names.items():
        exec(text, namespace)
        namespace[inner] = _part(namespace[inner])
    exec(source, namespace)
    return _part(namespace[name])


__all__ = ["OPTIONS", "motion", "output", "padded"]
