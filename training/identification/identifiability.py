"""Tests whether the outputs determine parameters, products of their powers, and signs."""

import itertools
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from kkl_gym.equations import input_matrix
from kkl_gym.system import System
from training.trajectories.parameters import with_parameters

RANK = 1e-7  # an eigenvalue of the information matrix below this share of the largest one counts as zero
HARDLY = 1.0  # relative standard error from which a direction counts as unidentifiable
PART = 0.05  # a parameter whose component of a direction is smaller does not belong to the direction
LARGEST_DENOMINATOR, ROUNDING = 6, 0.03  # largest denominator of an exponent, and relative error of its rounding
MOST_SIGNS = 12  # largest number of states and parameters of which all combinations of signs are tested
POINTS = 64  # number of random states at which a symmetry is tested


def unidentifiable_directions(information: np.ndarray) -> np.ndarray:
    """Return the directions (p, k) in which parameters can change with little or no effect on the outputs."""
    values, vectors = np.linalg.eigh(information)
    return vectors[:, (values <= RANK * values[-1]) | (values <= HARDLY**-2)]


def identifiable_directions(information: np.ndarray) -> np.ndarray:
    """Return the directions (p, k) in which a change of the parameters changes the outputs, even if little."""
    values, vectors = np.linalg.eigh(information)
    return vectors[:, values > RANK * max(values[-1], 0.0)]


def combinations(names: Sequence[str], hidden: np.ndarray) -> list[dict[str, Fraction | float]]:
    """Return the identifiable products of powers of parameters, given unidentifiable directions ``hidden`` (p, k)."""
    p, k = hidden.shape
    if p == k:
        return []
    seen = np.linalg.svd(hidden)[0][:, k:].T if k else np.eye(p)
    rows: list[np.ndarray] = []
    pivots: list[int] = []
    for _ in range(p - k):  # Gauss-Jordan elimination with full pivoting
        left = np.abs(seen)
        left[: len(rows)] = 0.0
        row, column = np.unravel_index(left.argmax(), left.shape)
        seen[[len(rows), row]] = seen[[row, len(rows)]]
        seen[len(rows)] /= seen[len(rows), column]
        for other in range(len(seen)):
            if other != len(rows):
                seen[other] -= seen[other, column] * seen[len(rows)]
        rows.append(seen[len(rows)])
        pivots.append(int(column))
    found = []
    for row in seen:
        row = np.where(np.abs(row) < PART, 0.0, row)
        smallest = np.abs(row[row != 0]).min()
        scaled = row / (smallest * np.sign(row[np.flatnonzero(row)[0]]))
        found.append({name: _fraction(value) for name, value in zip(names, scaled, strict=True) if value})
    return found


def written(powers: dict[str, Fraction | float]) -> str:
    """Return a product as text, such as ``a b^3``."""
    return " ".join(name if power == 1 else f"{name}^{_power(power)}" for name, power in powers.items())


def sign_symmetries(system: System, parameters: Sequence[str], *, driven: bool = False) -> list[tuple[str, ...]]:
    """Return the minimal sets of states and parameters whose common change of sign leaves the outputs unchanged."""
    values = system.parameters
    ranges = {name: _around(values[name]) for name in parameters}
    both = with_parameters(system, ranges)
    if both.nx > MOST_SIGNS or both.discrete:
        return []  # Larger systems, and those in discrete time, are not tested.
    x = both.draw_starts(np.random.default_rng(0), POINTS)
    f, h, g = both.drift(x), both.output(x), _inputs(both, x)
    found = []
    for signs in itertools.product((1.0, -1.0), repeat=both.nx):
        s = np.array(signs)
        if (s > 0).all():
            continue
        with np.errstate(all="ignore"):
            same = np.allclose(both.output(s * x), h, rtol=1e-9) and np.allclose(both.drift(s * x), s * f, rtol=1e-9)
            same = same and (not driven or np.allclose(_inputs(both, s * x), s[:, None] * g, rtol=1e-9))
        if same:
            found.append(tuple(name for name, sign in zip(both.state_names, signs, strict=True) if sign < 0))
    return [one for one in found if not any(set(other) < set(one) for other in found)]


def _inputs(system: System, x: np.ndarray) -> np.ndarray:
    """Return the input matrices g(x) (n, nx, nu) at states (n, nx)."""
    rows = [np.broadcast_to(value, len(x)) for row in input_matrix(system, x.T) for value in row]
    return np.reshape(rows, (system.nx, system.nu, len(x))).transpose(2, 0, 1)


def _around(value: float) -> tuple[float, float]:
    size = 0.1 * abs(value) or 1.0
    return value - size, value + size


def _fraction(value: float) -> Fraction | float:
    near = Fraction(float(value)).limit_denominator(LARGEST_DENOMINATOR)
    return near if near and abs(float(near) - value) <= ROUNDING * abs(value) else float(value)


def _power(power: Fraction | float) -> str:
    if isinstance(power, Fraction):
        return str(power.numerator) if power.denominator == 1 else f"({power})"
    return f"{power:.3g}"
