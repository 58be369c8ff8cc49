"""A tracker's step as machine code, where Numba is installed: two calls for a single sample, a few for a batch.

It computes what :mod:`observers.unscented` does, on the flow of :mod:`observers.flow` and for outputs C x. The kernels
are made for numbers of states, inputs and outputs: loops as short as theirs are else mostly overhead. Of a batch, the
flow's network evaluates all sigma points at once, by BLAS.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from observers.compiled import _kernels
from observers.flow import Flow
from observers.unscented import UNSEEN, Gaussian

Arrays = tuple[np.ndarray, ...]
_F = TypeVar("_F", bound=Callable[..., Any])

_LOW, _HIGH, _BIAS, _GAIN, _NOISE, _OFFSET, _SCALE, _LINEAR = range(8)  # columns of the table of states
_MEAN, _VARIANCE, _UNSEEN, _SHARE, _C = range(5)  # columns of the table of outputs
_ALL = np.ones(1, dtype=bool)


class CompiledTracker:
    """Prediction and correction of an unscented Kalman filter on a learned flow, whose states are scaled.

    Where a method takes a state, that is (x, P, mean_square) of shapes (n, nx), (n, nx, nx) and (n,), in memory without
    gaps: estimates, covariances, and the running mean square of the innovations.

    Parameters
    ----------
    flow : Flow
        The motion over a sample.
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

    def __init__(self, flow: Flow, C: np.ndarray, *, variances: tuple[np.ndarray, np.ndarray], share: float) -> None:
        network, (q, r) = flow.mlp.compiled, variances
        if network is None:
            raise ImportError("machine code needs Numba: pip install kkl-gym[fast]")
        low, high = ((bound - flow.x_offset) / flow.x_scale for bound in (flow.low, flow.high))
        states = low, high, flow.bias, flow.gain, q, flow.x_offset, flow.x_scale, flow.linear
        outputs = C @ flow.x_offset, r, np.full(len(r), UNSEEN * r.max()), np.full(len(r), share), C * flow.x_scale
        model = np.column_stack(states), np.column_stack(outputs), np.array(flow.u_scale, dtype=float)
        kernels = _tracking(network.activation, flow.nx, flow.nu, len(C))
        of_one = network.packed, network.widths, network.between
        self._network, self._points = network, 2 * flow.nx + 1
        self._ahead = functools.partial(kernels[0], model, of_one)
        self._enter, self._leave, self._correct, self._take = (functools.partial(each, model) for each in kernels[1:])
        self._next = np.empty((1, flow.nx)), np.empty((1, flow.nx, flow.nx))

    def ahead(self, state: Arrays, u: np.ndarray) -> Gaussian:
        """Predict a sample, before it is known.

        Parameters
        ----------
        state : tuple of ndarray
            The state now.
        u : ndarray, shape (n, nu)
            Inputs.

        Returns
        -------
        tuple of ndarray
            Estimates and covariances; NaN where a covariance was none. Those of a single sample last until the next.
        """
        x, P, _ = state
        if len(x) == 1:
            self._ahead(state, u, self._next)
            return self._next
        moved = np.empty((len(x), self._points, x.shape[1]))
        inputs = np.empty((*moved.shape[:2], x.shape[1] + u.shape[1]), np.float32)
        self._enter(x, P, u, inputs, moved)
        h, found = self._network.batch(inputs.reshape(-1, inputs.shape[-1])), (np.empty_like(x), np.empty_like(P))
        self._leave(h.reshape(moved.shape), moved, *found)
        return found

    def correct(self, ahead: Gaussian, y: np.ndarray, rows: np.ndarray | None, state: Arrays) -> None:
        """Take in samples.

        Parameters
        ----------
        ahead : tuple of ndarray
            What :meth:`ahead` says.
        y : ndarray, shape (n, ny)
            Samples; NaN where they are missing.
        rows : ndarray of bool, shape (n,), optional
            The rows that take them in, by default all.
        state : tuple of ndarray
            The state before, which is written over.
        """
        if rows is None:
            rows = _ALL if len(y) == 1 else np.ones(len(y), dtype=bool)
        self._correct(ahead, y, rows, state)

    def take(self, said: Gaussian, lost: np.ndarray, where: np.ndarray, state: Arrays) -> None:
        """Take what T_inv says, where it is surer by the traces of both covariances or the tracker is lost.

        Parameters
        ----------
        said : tuple of ndarray
            Estimates (k, nx) and covariances (k, nx, nx), in units of the states.
        lost : ndarray of bool, shape (k,)
            Where the tracker is lost.
        where : ndarray of int, shape (k,)
            The rows that these are.
        state : tuple of ndarray
            The state, which is written over.
        """
        self._take(said, lost, where, state)


def _inlined(function: _F) -> _F:
    """Part of each kernel that calls it: LLVM would leave some of the calls, at three times the cost of a row."""
    import numba

    made: Any = numba.njit(function, fastmath={"contract"}, error_model="numpy", inline="always")
    return cast(_F, made)


@functools.cache
def _tracking(activation: str, nx: int, nu: int, ny: int) -> tuple[Any, ...]:
    """The kernels of :class:`CompiledTracker`."""
    import numba

    compiled = functools.partial(numba.njit, fastmath={"contract"}, error_model="numpy")
    evaluate, count, far = _kernels(activation)[1], 2 * nx + 1, math.sqrt(3.0)
    central, others = (3 - nx) / 3 + 2.0, 1 / 6  # weights of the points in covariances

    @_inlined
    def draw(x: np.ndarray, P: np.ndarray, L: np.ndarray, points: np.ndarray) -> None:
        """Sigma points, (2 nx + 1, nx), and the Cholesky factor; NaN where there is none."""
        for i in range(nx):
            for p in range(count):
                points[p, i] = x[i]
            for j in range(i + 1):
                entry = P[i, j]
                for k in range(j):
                    entry -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = entry / L[j, j]
                else:
                    L[i, j] = math.sqrt(entry) if entry > 0.0 else np.nan
                points[1 + j, i] += far * L[i, j]
                points[1 + nx + j, i] -= far * L[i, j]

    @_inlined
    def centre(points: np.ndarray, mean: np.ndarray) -> None:
        """The weighted mean of transformed points, (2 nx + 1, k), which is taken from them."""
        for i in range(len(mean)):
            total = 2 * (3 - nx) * points[0, i]
            for p in range(1, count):
                total += points[p, i]
            mean[i] = total / 6
            for p in range(count):
                points[p, i] -= mean[i]

    @_inlined
    def product(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
        """Weighted sum over points of products of what they differ by."""
        total = central * a[0, i] * b[0, j]
        for p in range(1, count):
            total += others * a[p, i] * b[p, j]
        return total

    @_inlined
    def within(states: np.ndarray, i: int, s: float) -> float:
        s = states[i, _LOW] if s < states[i, _LOW] else s
        return states[i, _HIGH] if s > states[i, _HIGH] else s

    @_inlined
    def before(model: Arrays, u: np.ndarray, points: np.ndarray, inputs: np.ndarray, moved: np.ndarray) -> None:
        """What the network is given of a row, and where its points go without it."""
        states, _, u_scale = model
        for p in range(count):
            for i in range(nx):
                points[p, i] = within(states, i, points[p, i])
                inputs[p, i] = points[p, i]
            for j in range(nu):
                inputs[p, nx + j] = u[j] / u_scale[j]
        for i in range(nx):
            held = states[i, _BIAS]
            for j in range(nu):
                held += states[i, _LINEAR + nx + j] * (u[j] / u_scale[j])
            for p in range(count):
                total = points[p, i] + held
                for j in range(nx):
                    total += states[i, _LINEAR + j] * points[p, j]
                moved[p, i] = total

    @_inlined
    def after(states: np.ndarray, h: np.ndarray, moved: np.ndarray, x_next: np.ndarray, P_next: np.ndarray) -> None:
        """Moments of where the points of a row go with it."""
        for p in range(count):
            for i in range(nx):
                moved[p, i] += states[i, _GAIN] * h[p, i]
        centre(moved, x_next)
        for i in range(nx):
            for j in range(i + 1):
                P_next[i, j] = P_next[j, i] = product(moved, i, moved, j)
            P_next[i, i] += states[i, _NOISE]

    @compiled
    def ahead(model: Arrays, network: Arrays, state: Arrays, u: np.ndarray, found: Arrays) -> None:
        memory, (x, P, _), (x_next, P_next) = np.empty((2, count, nx)), state, found
        packed, widths, between = network
        inputs, h = np.empty((count, nx + nu), np.float32), np.empty((count, nx), np.float32)
        draw(x[0], P[0], P_next[0], memory[0])
        before(model, u[0], memory[0], inputs, memory[1])
        for p in range(count):
            evaluate(inputs[p], packed, widths, between, h[p])
        after(model[0], h, memory[1], x_next[0], P_next[0])

    @compiled
    def enter(
        model: Arrays, x: np.ndarray, P: np.ndarray, u: np.ndarray, inputs: np.ndarray, moved: np.ndarray
    ) -> None:
        L, points = np.empty((nx, nx)), np.empty((count, nx))
        for row in range(len(x)):
            draw(x[row], P[row], L, points)
            before(model, u[row], points, inputs[row], moved[row])

    @compiled
    def leave(model: Arrays, h: np.ndarray, moved: np.ndarray, x_next: np.ndarray, P_next: np.ndarray) -> None:
        for row in range(len(moved)):
            after(model[0], h[row], moved[row], x_next[row], P_next[row])

    @_inlined
    def compare(outputs: np.ndarray, y: np.ndarray, points: np.ndarray, found: Arrays) -> int:
        """A row's outputs with a sample: innovations, S and its products with the states; how many were measured."""
        expected, innovation, S, cross = found
        seen = 0
        for p in range(count):
            for j in range(ny):
                total = outputs[j, _MEAN]
                for i in range(nx):
                    total += outputs[j, _C + i] * points[p, i]
                expected[p, j] = total
        centre(expected, innovation)
        for i in range(nx):
            mean = points[0, i]
            for p in range(count):
                points[p, i] -= mean
        for j in range(ny):
            for k in range(j + 1):
                S[j, k] = product(expected, j, expected, k)
            for i in range(nx):
                cross[j, i] = product(expected, j, points, i)
            missing = np.isnan(y[j])
            S[j, j] += outputs[j, _VARIANCE] + (outputs[j, _UNSEEN] if missing else 0.0)
            innovation[j] = 0.0 if missing else y[j] - innovation[j]
            seen += 0 if missing else 1
        return seen

    @_inlined
    def condition(x: np.ndarray, P: np.ndarray, innovation: np.ndarray, S: np.ndarray, cross: np.ndarray) -> float:
        """Correct a row by one output after another; the innovations squared, in units of S."""
        squared = 0.0
        for k in range(ny):
            apart, pivot = innovation[k], S[k, k]
            squared += apart * apart / pivot
            for i in range(nx):
                gain = cross[k, i] / pivot
                x[i] += gain * apart
                for j in range(i + 1):
                    P[i, j] -= gain * cross[k, j]
            for j in range(k + 1, ny):  # and take from the others what it tells of them
                ratio = S[j, k] / pivot
                innovation[j] -= ratio * apart
                for i in range(nx):
                    cross[j, i] -= ratio * cross[k, i]
                for m in range(k + 1, j + 1):
                    S[j, m] -= ratio * S[m, k]
        return squared

    @compiled
    def correct(model: Arrays, ahead: Arrays, y: np.ndarray, rows: np.ndarray, state: Arrays) -> None:
        (states, outputs, _), (x_next, P_next), (x, P, mean_square) = model, ahead, state
        new, L, points = np.empty(nx), np.empty((nx, nx)), np.empty((count, nx))
        expected, innovation, S, cross = np.empty((count, ny)), np.empty(ny), np.empty((ny, ny)), np.empty((ny, nx))
        for row in range(len(x)):
            if not rows[row]:
                continue
            draw(x_next[row], P_next[row], L, points)
            seen = compare(outputs, y[row], points, (expected, innovation, S, cross))
            for i in range(nx):
                new[i] = x_next[row, i]
                for j in range(i + 1):
                    L[i, j] = P_next[row, i, j]
            squared, sound = condition(new, L, innovation, S, cross), True
            for i in range(nx):
                sound &= np.isfinite(new[i])
                for j in range(i + 1):
                    sound &= np.isfinite(L[i, j])
            if not sound:
                mean_square[row] = np.inf
            elif seen > 0:
                mean_square[row] += outputs[0, _SHARE] * (squared / seen - mean_square[row])
            for i in range(nx):
                x[row, i] = within(states, i, new[i] if sound else x[row, i])
                if sound:
                    for j in range(i + 1):
                        P[row, i, j] = P[row, j, i] = L[i, j]

    @compiled
    def take(model: Arrays, said: Arrays, lost: np.ndarray, where: np.ndarray, state: Arrays) -> None:
        (states, _, _), (x_said, P_said), (x, P, mean_square) = model, said, state
        for k in range(len(where)):
            row, ours, theirs = where[k], 0.0, 0.0
            for i in range(nx):
                ours += P[row, i, i]
                theirs += P_said[k, i, i] / (states[i, _SCALE] * states[i, _SCALE])
            if lost[k] or theirs < ours:
                for i in range(nx):
                    x[row, i] = within(states, i, (x_said[k, i] - states[i, _OFFSET]) / states[i, _SCALE])
                    for j in range(nx):
                        P[row, i, j] = P_said[k, i, j] / (states[i, _SCALE] * states[j, _SCALE])
                if lost[k]:
                    mean_square[row] = 1.0

    return ahead, enter, leave, correct, take
