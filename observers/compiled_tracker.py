"""A tracker's step as machine code, where Numba is installed: one call for a single sample, a few for a batch.

That of a single sample takes the linear filter along: a call takes about as long as what is computed in it.

It computes what :mod:`observers.unscented` does, on the flow of :mod:`observers.flow` and for outputs C x with noise of
each its own. The kernels are made for numbers of states, inputs and outputs: loops as short as theirs are else mostly
overhead. Of a batch, the flow's network evaluates all sigma points at once, by BLAS.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from observers.compiled import _kernels
from observers.filter import LinearFilter
from observers.flow import Flow
from observers.polynomial import table
from observers.sparse import single_kernel, without_zeros
from observers.unscented import Gaussian

_F = TypeVar("_F", bound=Callable[..., Any])

_LOW, _HIGH, _GAIN, _NOISE, _OFFSET, _SCALE, _BEND = range(7)  # columns of the table of states
_TERMS = 4  # of the polynomial that are added at a time
_BLOCK = 64  # points that go through the polynomial at a time
_MEAN, _VARIANCE, _SHARE, _C = range(4)  # columns of the table of outputs


class CompiledTracker:
    """A step of an unscented Kalman filter on a learned flow, whose states are scaled.

    Where a method takes a state, that is an array (n, nx + nx^2 + 1) in memory without gaps, which is written over. A
    row holds the estimate, its covariance, and the running mean square of the innovations. A single sample has a state
    of one row.

    Parameters
    ----------
    flow : Flow
        The motion over a sample.
    linear : LinearFilter
        What makes z of the outputs.
    C : ndarray, shape (ny, nx)
        Of the outputs y = C x.
    variances : (ndarray, ndarray)
        Of what is added to scaled states at each sample, (nx,), and of the noise on each output, (ny,).
    share : float
        Of the newest innovation in the mean square.

    Raises
    ------
    ImportError
        If Numba is not installed.
    """

    def __init__(
        self,
        flow: Flow,
        linear: LinearFilter,
        C: np.ndarray,
        *,
        variances: tuple[np.ndarray, np.ndarray],
        share: float,
    ) -> None:
        network, (q, r) = flow.mlp.compiled, variances
        if network is None:
            raise ImportError("machine code needs Numba: pip install kkl-gym[fast]")
        bend = np.zeros(flow.nx) if flow.bend is None else flow.bend
        states = _packed(*flow.scaled_bounds, flow.gain, q, flow.x_offset, flow.x_scale, bend)
        outputs = _packed(C @ flow.x_offset, r, np.full(len(r), share), C * flow.x_scale)
        scale = 1.0 / np.array(flow.u_scale, dtype=float)
        self._network, self._nx, self._ny, self._points = network, flow.nx, len(C), 2 * flow.nx
        one, enter, leave, take = _tracking(network.activation, flow.nx, flow.nu, len(C), flow.degree)
        terms = flow.polynomial.shape[1]
        polynomial = np.pad(flow.polynomial, ((0, 0), (0, -terms % _TERMS)))
        gains, places, mixing = without_zeros(linear.transition, linear.drive)
        # A few arrays of all there is: each that is handed over takes as long as a hundred multiplications.
        numbers = np.concatenate([part.ravel() for part in (states, outputs, scale, polynomial, gains, mixing)])
        whole = np.array([len(network.widths), *network.widths, *places.ravel()])
        self._one = functools.partial(one, numbers, whole, network.packed, network.between)
        self._told = flow.nx + 2 * len(C) + linear.size
        self._enter = functools.partial(enter, states, scale, polynomial)
        self._leave = functools.partial(leave, states, outputs)
        self._take = functools.partial(take, states)

    def advance(self, state: np.ndarray, u: np.ndarray, y: np.ndarray, rows: np.ndarray | None) -> np.ndarray:
        """Predict a sample, and take it in.

        Parameters
        ----------
        state : ndarray, shape (n, nx + nx^2 + 1)
            The state.
        u : ndarray, shape (n, nu)
            Inputs.
        y : ndarray, shape (n, ny)
            Samples; NaN where they are missing.
        rows : ndarray of bool, shape (n,), optional
            The rows that take them in, by default all.

        Returns
        -------
        ndarray, shape (n, ny)
            The outputs that were predicted; NaN where a covariance was none.
        """
        expected = np.empty((len(y), self._ny))
        moved = np.empty((self._nx, len(y) * self._points))
        inputs = np.empty((moved.shape[1], self._nx + u.shape[1]), np.float32)
        self._enter(u, state, inputs, moved)
        taken = np.ones(len(y), dtype=bool) if rows is None else rows
        self._leave(self._network.batch(inputs), moved, y, taken, state, expected)
        return expected

    def single(
        self, state: np.ndarray, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predict a single sample, take it in, and take the filter along.

        Parameters
        ----------
        state : ndarray, shape (1, nx + nx^2 + 1)
            The state.
        z : ndarray, shape (size,)
            That of the filter.
        y : ndarray, shape (ny,)
            The sample before.
        u : ndarray, shape (nu,)
            Inputs.
        y_next : ndarray, shape (ny,)
            The sample; NaN where it is missing.

        Returns
        -------
        x : ndarray, shape (nx,)
            The estimate in units of the states.
        y_next : ndarray, shape (ny,)
            The sample; where it is missing the output that was predicted, or y where there is no such number.
        z_next : ndarray, shape (size,)
            The filter's next state.
        """
        told, nx, ny = np.empty(self._told), self._nx, self._ny
        self._one(z, y, u, y_next, state, told)
        return told[:nx], told[nx + ny : nx + 2 * ny], told[nx + 2 * ny :]

    def take(self, said: Gaussian, lost: np.ndarray, where: np.ndarray, state: np.ndarray) -> None:
        """Take what T_inv says, where it is surer by the traces of both covariances or the tracker is lost.

        Parameters
        ----------
        said : tuple of ndarray
            Estimates (k, nx) and covariances (k, nx, nx), in units of the states.
        lost : ndarray of bool, shape (k,)
            Where the tracker is lost.
        where : ndarray of int, shape (k,)
            The rows that these are.
        state : ndarray, shape (n, nx + nx^2 + 1)
            The state.
        """
        self._take(*said, lost, where, state)


def _packed(*columns: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.column_stack(columns))


def _inlined(function: _F) -> _F:
    """Part of each kernel that calls it: LLVM would leave some of the calls, at three times the cost of a row."""
    import numba

    made: Any = numba.njit(function, fastmath={"contract"}, error_model="numpy", inline="always")
    return cast(_F, made)


@functools.cache
def _tracking(activation: str, nx: int, nu: int, ny: int, degree: int) -> tuple[Any, ...]:
    """The kernels of :class:`CompiledTracker`."""
    import numba

    compiled = functools.partial(numba.njit, fastmath={"contract"}, error_model="numpy")
    evaluate, update = _kernels(activation)[1], single_kernel()
    count, far, weight = 2 * nx, math.sqrt(nx), 1 / (2 * nx)
    entries = nx * nx
    earlier, by = table(nx + nu, degree)
    terms, padded = len(by), -(-len(by) // _TERMS) * _TERMS

    @_inlined
    def within(states: np.ndarray, i: int, s: float) -> float:
        s = states[i, _LOW] if s < states[i, _LOW] else s
        return states[i, _HIGH] if s > states[i, _HIGH] else s

    @_inlined
    def before(
        states: np.ndarray,
        scale: np.ndarray,
        row: np.ndarray,
        u: np.ndarray,
        L: np.ndarray,
        points: np.ndarray,
        inputs: np.ndarray,
    ) -> None:
        """The sigma points of a row, before rows of scaled inputs, (nx + nu, 2 nx), and as the network has them.

        NaN where there is no Cholesky factor.
        """
        for i in range(nx):
            for p in range(count):
                points[i, p] = row[i]
            for j in range(i + 1):
                entry = row[nx + nx * i + j]
                for k in range(j):
                    entry -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = entry / L[j, j]
                else:
                    L[i, j] = math.sqrt(entry) if entry > 0.0 else np.nan
                points[i, j] += far * L[i, j]
                points[i, nx + j] -= far * L[i, j]
        for p in range(count):
            for i in range(nx):
                points[i, p] = within(states, i, points[i, p])
                inputs[p, i] = points[i, p]
            for j in range(nu):
                points[nx + j, p] = inputs[p, nx + j] = u[j] * scale[j]

    @_inlined
    def multiply(a: np.ndarray, b: np.ndarray, product: np.ndarray) -> None:
        for p in range(len(product)):
            product[p] = a[p] * b[p]

    @_inlined
    def add_four(weights: np.ndarray, rows: np.ndarray, total: np.ndarray) -> None:
        w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
        a, b, c, d = rows[0], rows[1], rows[2], rows[3]
        for p in range(len(total)):
            total[p] += w0 * a[p] + w1 * b[p] + w2 * c[p] + w3 * d[p]

    @_inlined
    def along(polynomial: np.ndarray, points: np.ndarray, block: int, moved: np.ndarray) -> None:
        """Where points go by the polynomial, (nx, n). A block of them stays in the cache, its loops are vectors."""
        memory = np.zeros((nx + nu + 1 + padded, block))
        signals, total, products = memory[: nx + nu], memory[nx + nu], memory[nx + nu + 1 :]
        products[0] = 1.0
        for first in range(0, points.shape[1], block):
            size = min(block, points.shape[1] - first)
            for j in range(nx + nu):
                for p in range(size):
                    signals[j, p] = points[j, first + p]
            for t in range(1, terms):
                multiply(products[earlier[t]], signals[by[t]], products[t])
            for i in range(nx):
                total[:] = signals[i]
                for t in range(0, padded, _TERMS):
                    add_four(polynomial[i, t : t + _TERMS], products[t : t + _TERMS], total)
                for p in range(size):
                    moved[i, first + p] = total[p]

    @_inlined
    def after(
        states: np.ndarray,
        outputs: np.ndarray,
        h: np.ndarray,
        moved: np.ndarray,
        y: np.ndarray,
        takes: bool,
        found: np.ndarray,
        across: np.ndarray,
        row: np.ndarray,
        expected: np.ndarray,
    ) -> None:
        """Moments of where the points of a row go with it, and a sample taken in, one output after another."""
        distance = 0.0
        for i in range(nx):
            total = 0.0
            for p in range(count):
                moved[i, p] += states[i, _GAIN] * h[p, i]
                total += moved[i, p]
            mean = weight * total
            for p in range(count):
                moved[i, p] -= mean
            found[i] = mean
            distance += (mean - row[i]) * (mean - row[i])
            for j in range(i + 1):
                entry = 0.0
                for p in range(count):
                    entry += moved[i, p] * moved[j, p]
                found[nx + nx * i + j] = weight * entry
            found[nx + nx * i + i] += states[i, _NOISE]
        for i in range(nx):
            if states[i, _BEND] > 0.0:  # or infinity times 0 would be no number
                bent = states[i, _BEND] * distance
                found[nx + nx * i + i] += bent * bent
        for k in range(ny):
            expected[k] = outputs[k, _MEAN]
            for i in range(nx):
                expected[k] += outputs[k, _C + i] * found[i]
        if takes:
            squared, seen = 0.0, 0
            for k in range(ny):
                if np.isnan(y[k]):
                    continue
                apart, pivot = y[k] - outputs[k, _MEAN], outputs[k, _VARIANCE]
                for i in range(nx):
                    across[i] = 0.0
                    for j in range(nx):
                        across[i] += outputs[k, _C + j] * found[nx + (nx * i + j if j < i else nx * j + i)]
                    apart -= outputs[k, _C + i] * found[i]
                for i in range(nx):
                    pivot += outputs[k, _C + i] * across[i]
                squared += apart * apart / pivot
                seen += 1
                for i in range(nx):
                    gain = across[i] / pivot
                    found[i] += gain * apart
                    for j in range(i + 1):
                        found[nx + nx * i + j] -= gain * across[j]
            total = 0.0
            for i in range(nx):
                total += found[i]
                for j in range(i + 1):
                    total += found[nx + nx * i + j]
            if np.isfinite(total):
                for i in range(nx):
                    row[i] = within(states, i, found[i])
                    for j in range(i + 1):
                        row[nx + nx * i + j] = row[nx + nx * j + i] = found[nx + nx * i + j]
                if seen > 0:
                    row[nx + entries] += outputs[0, _SHARE] * seen / ny * (squared / seen - row[nx + entries])
            else:
                row[nx + entries] = np.inf

    @compiled
    def one(
        numbers: np.ndarray,
        whole: np.ndarray,
        packed: np.ndarray,
        between: np.ndarray,
        z: np.ndarray,
        y: np.ndarray,
        u: np.ndarray,
        y_next: np.ndarray,
        state: np.ndarray,
        told: np.ndarray,
    ) -> None:
        size, layers, at = len(z), whole[0], 0
        widths, places = whole[1 : 1 + layers], whole[1 + layers :].reshape(2, (len(whole) - 1 - layers) // 2)
        states = numbers[: nx * (_BEND + 1)].reshape(nx, _BEND + 1)
        at += nx * (_BEND + 1)
        outputs = numbers[at : at + ny * (_C + nx)].reshape(ny, _C + nx)
        at += ny * (_C + nx)
        scale = numbers[at : at + nu]
        at += nu
        polynomial = numbers[at : at + nx * padded].reshape(nx, padded)
        at += nx * padded
        end = len(numbers) - places.shape[1]
        gains, mixing = numbers[at:end].reshape((end - at) // size, size), numbers[end:]

        memory, of_network = np.empty((2 * nx + nu, count)), np.empty((count, 2 * nx + nu), np.float32)
        points, moved, inputs, h = memory[: nx + nu], memory[nx + nu :], of_network[:, : nx + nu], of_network[:, nx + nu :]
        more = np.empty((nx + 2, entries + nx))
        L, found, across = more[2:], more[0], more[1]
        before(states, scale, state[0], u, L, points, inputs)
        along(polynomial, points, count, moved)
        for p in range(count):
            evaluate(inputs[p], packed, widths, between, h[p])
        expected, filled = told[nx : nx + ny], told[nx + ny : nx + 2 * ny]
        after(states, outputs, h, moved, y_next, True, found, across, state[0], expected)
        for i in range(nx):
            told[i] = states[i, _OFFSET] + states[i, _SCALE] * state[0, i]
        for k in range(ny):
            filled[k] = y_next[k]
            if np.isnan(y_next[k]):
                filled[k] = expected[k] if np.isfinite(expected[k]) else y[k]
        update(gains, places, mixing, z, y, u, filled, told[nx + 2 * ny :])

    @compiled
    def enter(
        states: np.ndarray,
        scale: np.ndarray,
        polynomial: np.ndarray,
        u: np.ndarray,
        state: np.ndarray,
        inputs: np.ndarray,
        moved: np.ndarray,
    ) -> None:
        L = np.empty((nx, nx))
        points = np.empty((nx + nu, len(inputs)))
        for row in range(len(state)):
            own = slice(row * count, (row + 1) * count)
            before(states, scale, state[row], u[row], L, points[:, own], inputs[own])
        along(polynomial, points, _BLOCK, moved)

    @compiled
    def leave(
        states: np.ndarray,
        outputs: np.ndarray,
        h: np.ndarray,
        moved: np.ndarray,
        y: np.ndarray,
        rows: np.ndarray,
        state: np.ndarray,
        expected: np.ndarray,
    ) -> None:
        found, across = np.empty(nx + entries), np.empty(nx)
        for row in range(len(state)):
            own = slice(row * count, (row + 1) * count)
            after(states, outputs, h[own], moved[:, own], y[row], rows[row], found, across, state[row], expected[row])

    @compiled
    def take(
        states: np.ndarray,
        x: np.ndarray,
        P: np.ndarray,
        lost: np.ndarray,
        where: np.ndarray,
        state: np.ndarray,
    ) -> None:
        for k in range(len(where)):
            row, ours, theirs = state[where[k]], 0.0, 0.0
            for i in range(nx):
                ours += row[nx + nx * i + i]
                theirs += P[k, i, i] / (states[i, _SCALE] * states[i, _SCALE])
            if lost[k] or theirs < ours:
                for i in range(nx):
                    row[i] = within(states, i, (x[k, i] - states[i, _OFFSET]) / states[i, _SCALE])
                    for j in range(nx):
                        row[nx + nx * i + j] = P[k, i, j] / (states[i, _SCALE] * states[j, _SCALE])
                if lost[k]:
                    row[nx + entries] = 1.0

    return one, enter, leave, take
