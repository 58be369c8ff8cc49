"""T of the reverse Duffing system, by integration backward in time."""

import numpy as np
from scipy.integrate import solve_ivp

from kkl_gym import ReverseDuffing


def backward_quadrature(x, eigenvalues):
    """T(x) = integral over tau < 0 of exp(-A tau) B h(x(tau)), A diagonal."""
    system, horizon = ReverseDuffing(), 37.0 / min(-np.array(eigenvalues))

    def field(s, state):
        f = system.f(state[:2])
        return [-f[0], -f[1], *(np.exp(np.array(eigenvalues) * s) * state[0])]

    return solve_ivp(field, (0, horizon), [*x, *np.zeros(len(eigenvalues))], method="DOP853", rtol=1e-10).y[2:, -1]
