"""Derivatives of a system from its own equations."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from kkl_gym.system import Box, Components, System


def jacobian(equations: Callable[[Components], Components], nx: int) -> list[dict[int, Callable[..., Any]]]:
    """Derivatives of f or h from its own equations: for each component, those that are not zero by state."""
    import sympy  # here, because it takes half a second that other commands need not wait for

    x = sympy.symbols(f"x:{nx}", real=True)
    rows = []
    for value in equations(list(x)):
        derivatives = {j: sympy.diff(sympy.sympify(value), x[j]) for j in range(nx)}
        rows.append({j: sympy.lambdify(x, d, "numpy", cse=True) for j, d in derivatives.items() if d != 0})
    return rows


def output_jacobian(system: System, x: np.ndarray) -> np.ndarray:
    """dh/dx at states x, (..., nx), as (..., ny, nx)."""
    H = np.zeros((*x.shape[:-1], system.ny, system.nx))
    for i, row in enumerate(jacobian(system.h, system.nx)):
        for j, derivative in row.items():
            H[..., i, j] = derivative(*np.moveaxis(x, -1, 0))
    return H


def linearised(system: System, x: Components) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """df/dx, g and dh/dx at a state x: (nx, nx), (nx, nu) and (ny, nx)."""
    A, C = np.zeros((system.nx, system.nx)), np.zeros((system.ny, system.nx))
    for matrix, equations in ((A, system.f), (C, system.h)):
        for i, row in enumerate(jacobian(equations, system.nx)):
            for j, derivative in row.items():
                matrix[i, j] = derivative(*x)
    return A, np.array(system.g(x), dtype=float).reshape(system.nx, system.nu), C


def with_sensitivity(system: System) -> System:
    """The system beside its variational equation: states (x, Phi row by row), x' = f(x) + G u, Phi' = df/dx Phi."""
    nx, rows = system.nx, jacobian(system.f, system.nx)
    if type(system).g is not System.g:
        raise ValueError(
            f"{system.name} has an input matrix that depends on the state, which the variational equation would need"
        )

    class Sensitivity(System):
        name = f"{system.name}-sensitivity"
        X: ClassVar[Box] = (*system.X, *((0.0, 1.0),) * nx**2)
        bounds: ClassVar[Box] = (*system.bounds, *((-1e9, 1e9),) * nx**2)
        u_max: ClassVar[tuple[float, ...]] = system.u_max
        G: ClassVar[tuple[tuple[float, ...], ...]] = (*system.G, *((0.0,) * system.nu,) * nx**2) if system.nu else ()

        def f(self, x: Components) -> Components:
            state, Phi = x[:nx], x[nx:]
            out = list(system.f(state))
            for row in rows:
                at = {k: derivative(*state) for k, derivative in row.items()}
                out += [sum(value * Phi[k * nx + j] for k, value in at.items()) for j in range(nx)]
            return out

        def rate(self, x: Components) -> Any:
            return system.rate(x[:nx])

    return Sensitivity()
