"""Derivatives of a system from its own equations."""

from collections.abc import Callable
from typing import Any

import numpy as np

from kkl_gym.system import Components, System


def jacobian(equations: Callable[[Components], Components], nx: int) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of f or h from its own equations: for each component, those that are not zero by state."""
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = sympy.symbols(f"x:{nx}", real=True)
    rows = []
    for value in equations(list(x)):
        derivatives = {j: sympy.diff(sympy.sympify(value), x[j]) for j in range(nx)}
        rows.append({j: sympy.lambdify(x, d, "numpy", cse=True) for j, d in derivatives.items() if d != 0})
    return rows


def linearised(system: System, x: Components) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """df/dx, g and dh/dx at a state x: (nx, nx), (nx, nu) and (ny, nx)."""
    A, C = np.zeros((system.nx, system.nx)), np.zeros((system.ny, system.nx))
    for matrix, equations in ((A, system.f), (C, system.h)):
        for i, row in enumerate(jacobian(equations, system.nx)):
            for j, derivative in row.items():
                matrix[i, j] = derivative(*x)
    return A, np.array(system.g(x), dtype=float).reshape(system.nx, system.nu), C
