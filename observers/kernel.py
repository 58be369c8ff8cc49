"""The observer's step as machine code, for a batch with one observer in each row. It needs Numba.

One compilation serves all observers with equal numbers of states, outputs and inputs, and is stored on disk for later
processes. A system's equations and nonlinear output are compiled separately, and the kernel calls them by address.
"""

import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from observers.kernel_functions import OPTIONS, decode, evaluate
from observers.lanes import choose, doubles, offset, stack
from observers.machine import kernel, part
from observers.network import UNROLLED
from observers.tracker import INFLATION, RELINEARISATIONS

_intrinsic: Any = intrinsic  # Any, because it changes the arguments of the functions that it decorates
_POINTER = types.CPointer(types.float64)
_kernel, _part, _inlined = kernel(**OPTIONS), part(**OPTIONS), part(forceinline=True, **OPTIONS)


@_intrinsic
def call(typing: Any, address: Any, points: Any, other: Any, count: Any, h: Any) -> Any:
    """Call compiled equations of motion, or a compiled output, by their address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        double = ir.DoubleType()
        kind = ir.FunctionType(ir.VoidType(), [double.as_pointer(), double.as_pointer(), ir.IntType(64), double])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.int64, _POINTER, _POINTER, types.int64, types.float64), code


@functools.cache
def steps(nx: int, ny: int, nu: int, W: int) -> Any:
    """Return the kernel for nx states, ny outputs and nu inputs; it steps W rows of the batch together.

    Each entry of a state vector or matrix holds W numbers, one for each of these rows. Matrices are stored flat.
    """
    kappa, points, wide = max(3.0 - nx, 0.0), 2 * nx + 1, (2 * nx + 1) * W
    far, other = math.sqrt(nx + kappa), 0.5 / (nx + kappa)
    middle, middle_squares = kappa / (nx + kappa), kappa / (nx + kappa) + 2.0
    square, cross, inputs, turns, inflation = nx * nx, nx * ny, max(nu, 1), RELINEARISATIONS, INFLATION
    of_states, of_outputs, of_innovations, of_network = (nx + nu) * points, ny * points, ny * ny, nx + nu
    nis = nx + square  # index of the NIS in the tracker's part of a row
    of_row, rejections, trends = nis + 4 + 2 * ny, nis + 4, nis + 4 + ny

    @_inlined
    def factorise(P: Any, L: Any, inverse: Any) -> None:
        """Compute L with P = L L^T, and the reciprocals of L's diagonal; L is not finite if P has no such factor."""
        for i in range(nx):
            for j in range(i + 1):
                total = P[i * nx + j]
                for k in range(j):
                    total -= L[i * nx + k] * L[j * nx + k]
                if i > j:
                    L[i * nx + j] = total * inverse[j]
                else:
                    inverse[i] = 1.0 / math.sqrt(choose(total, 0.0, total, np.nan))
                    L[i * nx + i] = total * inverse[i]

    @_part
    def smoothed(P: Any, L: Any, inverse: Any, across: Any, V: Any, turned: bool, G: Any) -> None:
        """Compute G = M P^-1 V, where M is ``across``, transposed if ``turned``."""
        b = stack(nx, W)
        factorise(P, L, inverse)
        for k in range(ny):
            for i in range(nx):
                b[i] = V[i * ny + k]
                for j in range(i):
                    b[i] -= L[i * nx + j] * b[j]
                b[i] *= inverse[i]
            for back in range(nx):
                i = nx - 1 - back
                for j in range(i + 1, nx):
                    b[i] -= L[j * nx + i] * b[j]
                b[i] *= inverse[i]
            for i in range(nx):
                total = 0.0
                for j in range(nx):
                    total += (across[j * nx + i] if turned else across[i * nx + j]) * b[j]
                G[i * ny + k] = total

    @_inlined
    def spread_out(x: Any, P: Any, L: Any, inverse: Any, at: Any) -> None:
        """Write the sigma points of mean x and covariance P to ``at``, (nx, points)."""
        factorise(P, L, inverse)
        for i in range(nx):
            for p in range(points):
                at[i * points + p] = x[i]
            for j in range(i + 1):
                entry = far * L[i * nx + j]
                at[i * points + 1 + j] += entry
                at[i * points + 1 + nx + j] -= entry

    @_inlined
    def moments(at: Any, n: int, mean: Any, S: Any) -> None:
        """Compute the mean (n,) and covariance (n, n) of points (n, points), and subtract the mean from the points."""
        for i in range(n):
            total = 0.0
            for p in range(1, points):
                total += at[i * points + p]
            mean[i] = middle * at[i * points] + other * total
            for p in range(points):
                at[i * points + p] -= mean[i]
            for j in range(i + 1):
                total = 0.0
                for p in range(1, points):
                    total += at[i * points + p] * at[j * points + p]
                S[i * n + j] = S[j * n + i] = middle_squares * at[i * points] * at[j * points] + other * total

    @_inlined
    def together(L: Any, at: Any, n: int, across: Any) -> None:
        """Compute the covariance (nx, n) of sigma points and their images; ``at`` holds the images minus their mean."""
        for j in range(n):
            for i in range(nx):
                total = 0.0
                for k in range(i + 1):
                    total += L[i * nx + k] * (at[j * points + 1 + k] - at[j * points + 1 + nx + k])
                across[i * n + j] = other * far * total

    @_part
    def flow_step(at: Any, flow: Any, scratch: Any) -> None:
        """Move all sigma points in place by one step of a learned flow, a network that predicts the next state."""
        scaling, linear, packed, shape = flow
        q, given = stack(of_network, 1), offset(scratch, 0)
        for p in range(wide):
            for i in range(nx + nu):
                q[i] = given[i] = (at[i * wide + p] - scaling[0, i]) / scaling[1, i]
            moved = evaluate(packed, shape, scratch)
            for i in range(nx):
                total = q[i] + linear[i, 0]
                for j in range(nx + nu):
                    total += linear[i, 1 + j] * q[j]
                at[i * wide + p] = scaling[0, i] + scaling[1, i] * (total + scaling[2, i] * moved[i])

    @_inlined
    def clipped(states: Any, s: Any, i: int) -> Any:
        """Return a state limited to its bounds."""
        s = choose(states[0, i], s, states[0, i], s)
        return choose(s, states[1, i], states[1, i], s)

    @_inlined
    def finite(value: Any) -> Any:
        """Return 1 if a number is finite, else 0."""
        return choose(value, -np.inf, choose(np.inf, value, 1.0, 0.0), 0.0)

    @_inlined
    def within(states: Any, at: Any) -> None:
        """Limit states (nx, points) to their bounds."""
        for i in range(nx):
            for p in range(points):
                at[i * points + p] = clipped(states, at[i * points + p], i)

    @_inlined
    def predict(x: Any, P: Any, u: Any, model: Any, scratch: Any, L: Any, mean: Any, moved: Any, across: Any) -> None:
        """Compute the next state's mean, its covariance, and its covariance ``across`` with the present state."""
        states, flow, substeps, address, h, share = model
        inverse, at = stack(nx, W), stack(of_states, W)
        spread_out(x, P, L, inverse, at)
        within(states, at)
        for j in range(nu):
            for p in range(points):
                at[(nx + j) * points + p] = u[j]
        if substeps >= 0:  # negative numbers count the steps of a learned flow
            call(address, doubles(at), doubles(at), substeps, h)
        for _ in range(-substeps):
            flow_step(doubles(at), flow, scratch)
        within(states, at)
        moments(at, nx, mean, moved)
        together(L, at, nx, across)
        for i in range(nx):
            moved[i * nx + i] += share * states[2, i]

    @_inlined
    def expect(x: Any, P: Any, h: Any, states: Any, L: Any, y: Any, S: Any, V: Any) -> None:
        """Compute the output's mean y, its covariance S, and its covariance V with the state."""
        address, C = h
        if address == 0:
            for k in range(ny):
                y[k] = 0.0
                for i in range(nx):
                    y[k] += C[k, i] * x[i]
                    V[i * ny + k] = 0.0
                    for j in range(nx):
                        V[i * ny + k] += P[i * nx + j] * C[k, j]
            for k in range(ny):
                for j in range(k + 1):
                    S[k * ny + j] = 0.0
                    for i in range(nx):
                        S[k * ny + j] += C[k, i] * V[i * ny + j]
            return
        inverse, at, to, near = stack(nx, W), stack(of_states, W), stack(of_outputs, W), stack(of_outputs, W)
        spread_out(x, P, L, inverse, at)
        call(address, doubles(at), doubles(to), points, 0.0)
        within(states, at)  # sigma points may lie where h is undefined
        call(address, doubles(at), doubles(near), points, 0.0)
        for k in range(ny):
            for p in range(points):
                i = k * points + p
                near[i] = choose(finite(near[i]), 0.0, near[i], to[k * points])
                to[i] = choose(finite(to[i]), 0.0, to[i], near[i])
        moments(to, ny, y, S)
        together(L, to, ny, V)

    @_inlined
    def reject(now: Any, y: Any, expected: Any, S: Any, r: Any, gate: float, window: float) -> None:
        """Set outputs beyond the gate to NaN; a start, a divergence or ``window`` rejections in a row open the gate."""
        for k in range(ny):
            innovation, count = y[k] - expected[k], now[rejections + k]
            far = choose(innovation * innovation, gate * gate * (S[k * ny + k] + r[k]), 1.0, 0.0)
            rejected = choose(window, count, choose(now[nis + 2], window - 0.5, far, 0.0), 0.0)
            now[nis + 3] += rejected
            now[rejections + k] = choose(finite(y[k]), 0.0, choose(far, 0.0, count + 1.0, 0.0), count)
            y[k] = choose(rejected, 0.0, np.nan, y[k])

    @_inlined
    def whiten(y: Any, expected: Any, S: Any, r: Any, white: Any, V: Any) -> None:
        """Whiten innovations: the corrected state is x + V ``white``, with the covariance P - V V^T."""
        for k in range(ny):
            white[k] = y[k] - expected[k]
        for k in range(ny):  # drops missing outputs, whose expected values may be undefined
            seen, root = finite(y[k]), 1.0 / math.sqrt(S[k * ny + k] + r[k])
            white[k] = choose(seen, 0.0, white[k] * root, 0.0)
            for i in range(nx):
                V[i * ny + k] = choose(seen, 0.0, V[i * ny + k] * root, 0.0)
            for j in range(k + 1, ny):
                share = choose(seen, 0.0, S[j * ny + k] * root, 0.0)
                white[j] -= share * white[k]
                for i in range(nx):
                    V[i * ny + j] -= share * V[i * ny + k]
                for m in range(k + 1, j + 1):
                    S[j * ny + m] -= share * S[m * ny + k] * root

    @_inlined
    def shift(x: Any, sign: float, V: Any, white: Any) -> None:
        for i in range(nx):
            for k in range(ny):
                x[i] += sign * V[i * ny + k] * white[k]

    @_inlined
    def add(P: Any, sign: float, V: Any, W: Any) -> None:
        for i in range(nx):
            for j in range(nx):
                for k in range(ny):
                    P[i * nx + j] += sign * V[i * ny + k] * W[j * ny + k]

    @_inlined
    def track(now: Any, y: Any, u: Any, model: Any, h: Any, r: Any, watched: Any, scratch: Any, expected: Any) -> None:
        """Predict and correct the state of a row's tracker; rejected outputs become NaN."""
        window, share, trend_share, square_share, trend_gain, trend_limit, gate = watched
        states = model[0]
        start, spread, mean, moved = stack(nx, W), stack(square, W), stack(nx, W), stack(square, W)
        across, L, inverse = stack(square, W), stack(square, W), stack(nx, W)
        again, again_moved, again_across = stack(nx, W), stack(square, W), stack(square, W)
        S, V, G, D = stack(of_innovations, W), stack(cross, W), stack(cross, W), stack(cross, W)
        white, last, sound, ages = stack(ny, W), 0, 1.0, doubles(offset(now, nis + 2))
        for w in range(W):
            last = turns if ages[w] < window else last
        for turn in range(last + 1):
            for i in range(nx):
                start[i] = now[i]
            for i in range(square):
                spread[i] = now[nx + i]
            if turn:  # the sample also corrects the previous state
                smoothed(moved, L, inverse, across, V, False, G)
                shift(start, 1.0, G, white)
                add(spread, -1.0, G, G)
            predict(start, spread, u, model, scratch, L, again, again_moved, again_across)
            if turn:  # linearise the motion about this smoothed state
                smoothed(spread, L, inverse, again_across, G, True, D)
                shift(again, -1.0, D, white)
                add(again_moved, 1.0, D, D)
                add(again_across, 1.0, G, D)
                factorise(again_moved, L, inverse)
                total = 0.0
                for i in range(nx):
                    total += again[i] + inverse[i]
                sound = choose(window, now[nis + 2], finite(total), 0.0)
            for i in range(nx):
                mean[i] = choose(sound, 0.0, again[i], mean[i])
            for i in range(square):
                moved[i] = choose(sound, 0.0, again_moved[i], moved[i])
                across[i] = choose(sound, 0.0, again_across[i], across[i])
            expect(mean, moved, h, states, L, expected, S, V)
            if turn == 0 and gate < np.inf:
                reject(now, y, expected, S, r, gate, window)
            whiten(y, expected, S, r, white, V)
        shift(mean, 1.0, V, white)
        add(moved, -1.0, V, V)
        total = 0.0
        for i in range(nx):
            total += mean[i]
            for j in range(nx):
                total += moved[i * nx + j]
        sound = finite(total)
        count, squares, raised = 0.0, 0.0, 0.0
        for k in range(ny):
            seen, trend = sound * finite(y[k]), now[trends + k]
            trend = choose(seen, 0.0, trend + trend_share * (white[k] - trend), trend)
            count += seen
            squares += white[k] * white[k]
            raised += seen * trend * trend
            now[trends + k] = trend
        some = choose(count, 0.0, 1.0, 0.0)
        weight, each = count / float(ny), 1.0 / choose(count, 0.0, count, 1.0)
        average = now[nis] + share * weight * (squares * each - now[nis])
        square_average = now[nis + 1] + square_share * weight * (trend_gain * raised * each - now[nis + 1])
        # Beyond the limit, successive innovations are correlated: the covariance is inflated.
        grown = choose(square_average, trend_limit, inflation, 1.0)
        now[nis] = choose(sound, 0.0, average, np.inf)
        now[nis + 1] = choose(some, 0.0, choose(square_average, trend_limit, 1.0, square_average), now[nis + 1])
        now[nis + 2] += some
        for k in range(ny):
            now[trends + k] = choose(square_average, trend_limit, 0.0, now[trends + k])
        for i in range(nx):
            now[i] = choose(sound, 0.0, clipped(states, mean[i], i), now[i])
        for i in range(square):
            now[nx + i] = choose(sound, 0.0, grown * moved[i], now[nx + i])

    @_part
    def supervise(
        rows: Any, count: int, sizes: Any, dt: float, window: float, limit: float, states: Any, maps: Any, scratch: Any
    ) -> None:
        """Reinitialise by T_inv after a divergence and, during the first window, if T_inv's covariance is smaller."""
        (driven, free, ages, covariances), (nz, size) = maps, sizes
        base = size + ny + 1
        P, L, inverse, own, quotient = stack(square, W), stack(square, W), stack(nx, W), stack(nx, W), stack(1, W)
        z, x_hat, covariance, surer, acted = stack(size, 1), stack(nx, 1), doubles(P), doubles(quotient), stack(W, 1)
        for w in range(count):
            row, at = offset(doubles(rows), w), 0
            acted[w] = 1.0 if size == nz else 0.0  # until an input acts, T_inv for free motion applies
            for i in range(nz, size):
                acted[w] = acted[w] if row[i * W] == 0.0 else 1.0
            table = 0 if acted[w] else 1
            seen = min(row[(base + nis + 2) * W], window) * dt
            while at < len(ages) - 2 and seen > ages[at + 1]:
                at += 1
            upper = min(at + 1, len(ages) - 1)
            part = min((seen - ages[at]) / (ages[upper] - ages[at]), 1.0) if upper else 0.0
            for i in range(square):
                lower = covariances[table, at, i]
                covariance[i * W + w] = lower + part * (covariances[table, upper, i] - lower)
        factorise(P, L, inverse)
        factorise(offset(rows, base + nx), L, own)
        quotient[0] = own[0] / inverse[0]  # sqrt(det of T_inv's covariance / det of the tracker's covariance)
        for i in range(1, nx):
            quotient[0] *= own[i] / inverse[i]
        for w in range(count):
            row, now = offset(doubles(rows), w), offset(doubles(rows), base * W + w)
            lost = not now[nis * W] <= limit
            if lost or (now[(nis + 2) * W] < window and surer[w] < 1.0):
                for i in range(size):
                    z[i] = row[i * W]
                age = row[(base - 1) * W] * dt
                decode(z, age, driven if acted[w] else free, scratch, x_hat)
                for i in range(nx):
                    now[i * W] = clipped(states, x_hat[i], i)
                for i in range(square):
                    now[(nx + i) * W] = covariance[i * W + w]
            if lost:
                now[nis * W] = now[(nis + 1) * W] = 1.0
                for k in range(ny):
                    now[(rejections + k) * W] = window
                    now[(trends + k) * W] = 0.0

    @_part
    def follow(z: Any, before: Any, u: Any, y: Any, linear: Any) -> None:
        """Advance the linear filter by one interval, from the output ``before`` to y."""
        gains, places, mixing = linear
        size = gains.shape[1]
        out = stack(size, W)
        for i in range(size):
            total = gains[0, i] * z[i]
            for k in range(ny):
                total += gains[1 + k, i] * before[k] + gains[1 + ny + nu + k, i] * y[k]
            for j in range(nu):
                total += gains[1 + ny + j, i] * u[j]
            out[i] = total
        for i in range(len(mixing)):
            out[places[0, i]] += mixing[i] * z[places[1, i]]
        for i in range(size):
            z[i] = out[i]

    @_kernel
    def run(
        addresses: Any, flags: Any, numbers: Any, states: Any, r: Any, C: Any, linear: Any, maps: Any,
        flow: Any, state: Any, y: Any, u: Any, record: Any
    ) -> None:  # fmt: skip
        """Advance rows of the state (n, width) by samples y (steps, n, ny) and inputs u (steps, n, nu).

        The shape of ``record`` decides what it receives: rows (steps, n, width), estimates (steps, n, nx), or nothing.
        """
        nz, widest, substeps = flags
        h, samples, dt, limit = numbers[:4]
        watched = numbers[4:]
        model, of_output = (states, flow, substeps, addresses[0], h, samples), (addresses[1], C)
        size = linear[0].shape[1]
        base, scratch = size + ny + 1, np.empty((2, widest + UNROLLED), np.float32)
        width, column = base + of_row, base if record.shape[2] == nx else 0
        kept, sample, held, expected = min(record.shape[2], width), stack(ny, W), stack(inputs, W), stack(ny, W)
        rows = stack(width, W)
        before, now = offset(rows, size), offset(rows, base)
        values, ys, us = doubles(rows), doubles(sample), doubles(held)
        judged, seen = doubles(offset(now, nis)), doubles(offset(now, nis + 2))
        for first in range(0, len(state), W):
            count = min(W, len(state) - first)
            for w in range(W):
                row = first + min(w, count - 1)  # unused lanes repeat the last row
                for i in range(width):
                    values[i * W + w] = state[row, i]
            for k in range(len(y)):
                for w in range(W):
                    row = first + min(w, count - 1)
                    for i in range(ny):
                        ys[i * W + w] = y[k, row, i]
                    for j in range(nu):
                        us[j * W + w] = u[k, row, j]
                track(now, sample, held, model, of_output, r, watched, scratch, expected)
                for i in range(ny):
                    expected[i] = choose(finite(expected[i]), 0.0, expected[i], before[i])
                    sample[i] = choose(finite(sample[i]), 0.0, sample[i], expected[i])
                follow(rows, before, held, sample, linear)
                for i in range(ny):
                    before[i] = sample[i]
                rows[base - 1] += samples
                settled = True
                for w in range(count):
                    settled = settled and judged[w] <= limit and seen[w] >= watched[0]
                if not settled:
                    supervise(rows, count, (nz, size), dt, watched[0], limit, states, maps, scratch)
                for w in range(count):
                    for i in range(kept):
                        record[k, first + w, i] = values[(column + i) * W + w]
            for w in range(count):
                for i in range(width):
                    state[first + w, i] = values[i * W + w]

    return run
