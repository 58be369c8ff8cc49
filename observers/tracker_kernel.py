"""The step of :class:`observers.tracker.Tracker` compiled by Numba, row by row."""

import functools
import math
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.compiled import UNROLLED, single_network
from observers.expression import Expression
from observers.expression_source import python_source
from observers.machine import kernel, part
from observers.motion import Motion
from observers.supervision import INFLATION, Supervision

RELINEARISATIONS = 2  # of a step within the first window: with 0 errors without noise rise by 40 to 80 %
_kernel = kernel(fastmath={"contract"}, error_model="numpy")
_part = part(fastmath={"contract"}, error_model="numpy")


class TrackerKernel:
    """A tracker's step for rows of its state, (n, width), in place; ImportError without Numba."""

    def __init__(
        self,
        motion: Motion,
        artifact: Artifact,
        dt: float,
        watch: Supervision,
        *,
        variances: tuple[np.ndarray, np.ndarray],
    ) -> None:
        nx, ny, nu = motion.nx, artifact.ny, artifact.nu
        q, r = variances
        low, high = motion.scaled_bounds
        output = artifact.C if artifact.C is not None else artifact.h
        try:
            if motion.equations is not None:
                substeps = motion.equations.substeps
                move = _equations(nx, nu, substeps, motion.equations.field)
                numbers, packed = np.array([dt / max(substeps, 1)]), np.zeros(1, np.float32)
                widths = np.zeros(1, dtype=np.int64)
            else:
                assert motion.flow is not None
                flow, network = motion.flow, motion.flow.mlp.compiled
                if network is None:
                    raise ImportError("machine code needs Numba: pip install kkl-gym[fast]")
                move = _flow(nx, nu, network.activation)
                numbers = np.concatenate([flow.linear.ravel(), flow.gain, 1.0 / flow.u_scale])
                packed, widths = network.packed, network.widths
            measure = _linear_output(ny, nx) if isinstance(output, np.ndarray) else _output(output)
        except ValueError as error:
            raise ImportError(str(error)) from None
        C = output.ravel() if isinstance(output, np.ndarray) else np.zeros(1)
        shares = watch.share, watch.trend_share, watch.trend_square_share
        watched = np.array([*shares, watch.trend_gain, watch.trend_limit])
        states = np.column_stack([low, high, q, motion.x_offset, motion.x_scale])
        model = states, numbers, packed, widths, C, r
        self._ny = ny
        self._advance = functools.partial(_advance(nx, nu, ny, move, measure), model, watched, watch.window)

    def advance(self, state: np.ndarray, u: np.ndarray, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Predict and correct in some rows; returns the predicted outputs, (n, ny)."""
        expected = np.empty((len(state), self._ny))
        u, y = np.array(u, order="C"), np.ascontiguousarray(y)  # Numba compiles anew for what is read-only
        self._advance(u, y, rows, state, expected)
        return expected


@functools.cache
def _function(name: str, expression: Expression) -> Any:
    """An expression as a function that kernels call."""
    namespace: dict[str, Any] = {"np": np}
    exec(python_source(name, expression), namespace)
    return _part(namespace[name])


@functools.cache
def _equations(nx: int, nu: int, substeps: int, expression: Expression) -> Any:
    """A step of the equations, in units of the states."""
    field = _function("field", expression)

    @_part
    def move(s: np.ndarray, u: np.ndarray, model: Any, k: np.ndarray) -> None:
        states, x, at, h = model[0], k[0], k[1], model[1][0]
        for i in range(nx):
            x[i] = states[i, 3] + states[i, 4] * s[i]
        if substeps == 0:
            field(x, u, at)
            for i in range(nx):
                x[i] = at[i]
        for _ in range(substeps):
            field(x, u, k[2])
            for i in range(nx):
                at[i] = x[i] + 0.5 * h * k[2, i]
            field(at, u, k[3])
            for i in range(nx):
                at[i] = x[i] + 0.5 * h * k[3, i]
            field(at, u, k[4])
            for i in range(nx):
                at[i] = x[i] + h * k[4, i]
            field(at, u, k[5])
            for i in range(nx):
                x[i] += h / 6.0 * (k[2, i] + 2.0 * (k[3, i] + k[4, i]) + k[5, i])
        for i in range(nx):
            s[i] = (x[i] - states[i, 3]) / states[i, 4]

    return move


@functools.cache
def _flow(nx: int, nu: int, activation: str) -> Any:
    """A step of a learned flow."""
    evaluate, columns, spare = single_network(activation), 1 + nx + nu, UNROLLED

    @_part
    def move(s: np.ndarray, u: np.ndarray, model: Any, k: np.ndarray) -> None:
        _, numbers, packed, widths, _, _ = model
        memory, q = np.empty((5, widths.max() + spare), np.float32), k[0]
        for i in range(nx):
            q[i] = s[i]
        for j in range(nu):
            q[nx + j] = u[j] * numbers[nx * columns + nx + j]
        for i in range(nx + nu):
            memory[3, i] = q[i]
        evaluate(memory[3, : nx + nu], packed, widths, memory[:3], memory[4, :nx])
        for i in range(nx):
            total = numbers[i * columns]
            for j in range(nx + nu):
                total += numbers[i * columns + 1 + j] * q[j]
            s[i] += total + numbers[nx * columns + i] * memory[4, i]

    return move


@functools.cache
def _linear_output(ny: int, nx: int) -> Any:
    @_part
    def measure(x: np.ndarray, u: np.ndarray, C: np.ndarray, out: np.ndarray) -> None:
        for k in range(ny):
            out[k] = 0.0
            for i in range(nx):
                out[k] += C[nx * k + i] * x[i]

    return measure


@functools.cache
def _output(expression: Expression) -> Any:
    function = _function("output", expression)

    @_part
    def measure(x: np.ndarray, u: np.ndarray, C: np.ndarray, out: np.ndarray) -> None:
        function(x, u, out)

    return measure


@functools.cache
def _advance(nx: int, nu: int, ny: int, move: Any, measure: Any) -> Any:
    """The kernel for numbers of signals, a motion and an output."""
    kappa, end, times, inflation = max(3.0 - nx, 0.0), nx + nx * nx, RELINEARISATIONS, INFLATION
    points, far, other = 2 * nx + 1, math.sqrt(nx + kappa), 0.5 / (nx + kappa)
    middle, middle_squares = kappa / (nx + kappa), kappa / (nx + kappa) + 2.0

    @_part
    def factorise(P: np.ndarray, L: np.ndarray, n: int) -> None:
        for i in range(n):
            for j in range(i + 1):
                total = P[i, j]
                for k in range(j):
                    total -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = total / L[j, j]
                else:
                    L[i, j] = math.sqrt(total) if total > 0.0 else np.nan

    @_part
    def solve(L: np.ndarray, b: np.ndarray, n: int) -> None:
        """Solve L L^T x = b in place."""
        for i in range(n):
            for k in range(i):
                b[i] -= L[i, k] * b[k]
            b[i] /= L[i, i]
        for back in range(n):
            i = n - 1 - back
            for k in range(i + 1, n):
                b[i] -= L[k, i] * b[k]
            b[i] /= L[i, i]

    @_part
    def spread_out(x: np.ndarray, P: np.ndarray, L: np.ndarray, at: np.ndarray) -> None:
        factorise(P, L, nx)
        for i in range(nx):
            at[0, i] = x[i]
        for j in range(nx):
            for i in range(nx):
                entry = far * L[i, j] if i >= j else 0.0
                at[1 + j, i], at[1 + nx + j, i] = x[i] + entry, x[i] - entry

    @_part
    def moments(
        x: np.ndarray, at: np.ndarray, to: np.ndarray, mean: np.ndarray, S: np.ndarray, across: np.ndarray, n: int
    ) -> None:
        """Mean and covariance of points (points, n), and their covariance with the points that they were."""
        for i in range(n):
            mean[i] = middle * to[0, i]
            for p in range(1, points):
                mean[i] += other * to[p, i]
        for p in range(points):
            for i in range(n):
                to[p, i] -= mean[i]
            for i in range(nx):
                at[p, i] -= x[i]
        for i in range(n):
            for j in range(i + 1):
                total = middle_squares * to[0, i] * to[0, j]
                for p in range(1, points):
                    total += other * to[p, i] * to[p, j]
                S[i, j] = S[j, i] = total
        for i in range(nx):
            for j in range(n):
                total = 0.0
                for p in range(1, points):
                    total += other * at[p, i] * to[p, j]
                across[i, j] = total

    @_part
    def predict(x: np.ndarray, P: np.ndarray, u: np.ndarray, model: Any, memory: Any, moved: Any, work: Any) -> None:
        """Mean and covariance a sample later, and the covariance with the state before, into ``moved``."""
        states, (mean, S, across), (L, at, to) = model[0], moved, work
        spread_out(x, P, L, at)
        for p in range(points):
            for i in range(nx):
                s = at[p, i]
                s = states[i, 0] if s < states[i, 0] else s
                to[p, i] = states[i, 1] if s > states[i, 1] else s
            move(to[p], u, model, memory)
        moments(x, at, to, mean, S, across, nx)

    @_part
    def correct(
        x: np.ndarray,
        P: np.ndarray,
        y: np.ndarray,
        u: np.ndarray,
        model: Any,
        corrected: Any,
        of_output: Any,
        work: Any,
    ) -> None:
        """Condition a prediction on a sample, of which NaN is missing."""
        states, _, _, _, C, r = model
        (known, left, white), (expected, S, across, R), (L, at, to) = corrected, of_output, work
        spread_out(x, P, L, at)
        for p in range(points):
            for i in range(nx):
                to[p, i] = states[i, 3] + states[i, 4] * at[p, i]
            measure(to[p, :nx], u, C, to[p, nx : nx + ny])
        for p in range(points):
            for k in range(ny):
                value = to[p, nx + k]
                if not np.isfinite(value):  # h is undefined at a sigma point
                    for i in range(nx):
                        s = at[p, i]
                        s = states[i, 0] if s < states[i, 0] else s
                        s = states[i, 1] if s > states[i, 1] else s
                        to[p, i] = states[i, 3] + states[i, 4] * s
                    measure(to[p, :nx], u, C, white)
                    value = white[k] if np.isfinite(white[k]) else to[0, nx + k]
                to[p, nx + k] = value
        moments(x, at, to[:, nx:], expected, S, across, ny)
        for i in range(nx):
            known[i] = x[i]
            for j in range(nx):
                left[i, j] = P[i, j]
        for k in range(ny):
            S[k, k] += r[k]
            if np.isnan(y[k]):
                for j in range(ny):
                    S[k, j] = S[j, k] = 1.0 if j == k else 0.0
                for i in range(nx):
                    across[i, k] = 0.0
        factorise(S, R, ny)
        for k in range(ny):  # white innovations, and R^-1 across^T in the place of across
            total = 0.0 if np.isnan(y[k]) else y[k] - expected[k]
            for j in range(k):
                total -= R[k, j] * white[j]
            white[k] = total / R[k, k]
            for i in range(nx):
                entry = across[i, k]
                for j in range(k):
                    entry -= R[k, j] * across[i, j]
                across[i, k] = entry / R[k, k]
        for i in range(nx):
            for k in range(ny):
                known[i] += across[i, k] * white[k]
                for j in range(nx):
                    left[i, j] -= across[i, k] * across[j, k]

    @_kernel
    def advance(
        model: Any, watched: np.ndarray, window: int, u: Any, y: Any, rows: np.ndarray, state: Any, expected: Any
    ) -> None:
        states = model[0]
        square = np.empty((11, nx, nx))
        P, moved, left, L, spread, A, again, across, of_start, gain, other_left = square
        flat = np.empty((6, nx))
        x, mean, known, start, around, column = flat
        at, to = np.empty((points, nx)), np.empty((points, nx + ny))
        S, R, crossed, white = np.empty((ny, ny)), np.empty((ny, ny)), np.empty((nx, ny)), np.empty(ny)
        memory, work, corrected = np.empty((6, nx + nu)), (L, at, to), (known, left, white)
        for row in range(len(state)):
            now, of_output = state[row], (expected[row], S, crossed, R)
            for i in range(nx):
                x[i] = now[i]
                for j in range(nx):
                    P[i, j] = now[nx + nx * i + j]
            predict(x, P, u[row], model, memory, (mean, moved, across), work)
            for i in range(nx):
                moved[i, i] += states[i, 2]
            for _ in range(times if now[end + 2] < window else 0):
                correct(mean, moved, y[row], u[row], model, corrected, of_output, work)
                factorise(moved, L, nx)
                for i in range(nx):
                    for j in range(nx):
                        gain[i, j] = across[i, j]
                    solve(L, gain[i], nx)
                for i in range(nx):
                    start[i] = x[i]
                    for j in range(nx):
                        start[i] += gain[i, j] * (known[j] - mean[j])
                        other_left[i, j] = 0.0
                        for k in range(nx):
                            other_left[i, j] += gain[i, k] * (left[k, j] - moved[k, j])
                for i in range(nx):
                    for j in range(nx):
                        spread[i, j] = P[i, j]
                        for k in range(nx):
                            spread[i, j] += other_left[i, k] * gain[j, k]
                for i in range(nx):
                    for j in range(i):
                        spread[i, j] = spread[j, i] = 0.5 * (spread[i, j] + spread[j, i])
                predict(start, spread, u[row], model, memory, (around, again, of_start), work)
                factorise(spread, L, nx)
                for j in range(nx):
                    for i in range(nx):
                        column[i] = of_start[i, j]
                    solve(L, column, nx)
                    for i in range(nx):
                        A[j, i] = column[i]
                for i in range(nx):  # A P, in the place of what is no longer needed
                    for j in range(nx):
                        gain[i, j] = 0.0
                        for k in range(nx):
                            gain[i, j] += A[i, k] * P[k, j]
                total = 0.0
                for i in range(nx):
                    for j in range(nx):
                        left[i, j] = again[i, j]
                        for k in range(nx):
                            left[i, j] += gain[i, k] * A[j, k] - A[i, k] * of_start[k, j]
                for i in range(nx):
                    for j in range(i):
                        left[i, j] = left[j, i] = 0.5 * (left[i, j] + left[j, i])
                    left[i, i] += states[i, 2]
                    known[i] = around[i]
                    for k in range(nx):
                        known[i] += A[i, k] * (x[k] - start[k])
                    total += known[i]
                factorise(left, L, nx)
                for i in range(nx):
                    for j in range(i + 1):
                        total += L[i, j]
                if np.isfinite(total):
                    for i in range(nx):
                        mean[i] = known[i]
                        for j in range(nx):
                            moved[i, j], across[j, i] = left[i, j], gain[i, j]
            correct(mean, moved, y[row], u[row], model, corrected, of_output, work)
            total = 0.0
            for i in range(nx):
                total += known[i]
                for j in range(nx):
                    total += left[i, j]
            if not rows[row]:
                continue
            if not np.isfinite(total):
                now[end] = np.inf
                continue
            count, squares, raised = 0.0, 0.0, 0.0
            for k in range(ny):
                if not np.isnan(y[row, k]):
                    count += 1.0
                    squares += white[k] * white[k]
                    now[end + 3 + k] += watched[1] * (white[k] - now[end + 3 + k])
                    raised += now[end + 3 + k] * now[end + 3 + k]
            grown = 1.0
            if count > 0.0:
                weight = count / ny
                now[end] += watched[0] * weight * (squares / count - now[end])
                now[end + 1] += watched[2] * weight * (watched[3] * raised / count - now[end + 1])
                now[end + 2] += 1.0
                if now[end + 1] > watched[4]:
                    grown, now[end + 1] = inflation, 1.0
                    for k in range(ny):
                        now[end + 3 + k] = 0.0
            for i in range(nx):
                s = known[i]
                s = states[i, 0] if s < states[i, 0] else s
                now[i] = states[i, 1] if s > states[i, 1] else s
                for j in range(nx):
                    now[nx + nx * i + j] = grown * left[i, j]

    return advance


__all__ = ["TrackerKernel"]
