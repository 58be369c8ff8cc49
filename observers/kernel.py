"""The observer's step as machine code, for one row or many, along one sample or a record. It needs Numba.

One compilation serves all observers with equal numbers of states, outputs and inputs, and is stored on disk for later
processes. A system's motion and nonlinear output are compiled separately, and the kernel calls them by their address.
"""

import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from observers.kernel_functions import OPTIONS, decode, evaluate, padded
from observers.lanes import choose, doubles, stack
from observers.machine import kernel, part
from observers.network import UNROLLED
from observers.tracker import INFLATION, RELINEARISATIONS

_intrinsic: Any = intrinsic  # Any, because it changes the arguments of the functions that it decorates
_POINTER = types.CPointer(types.float64)
_kernel, _part, _inlined = kernel(**OPTIONS), part(**OPTIONS), part(forceinline=True, **OPTIONS)


@_intrinsic
def call(typing: Any, address: Any, points: Any, other: Any, count: Any, h: Any) -> Any:
    """Call a compiled motion or output by its address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        double = ir.DoubleType()
        kind = ir.FunctionType(ir.VoidType(), [double.as_pointer(), double.as_pointer(), ir.IntType(64), double])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.int64, _POINTER, _POINTER, types.int64, types.float64), code


@functools.cache
def steps(nx: int, ny: int, nu: int, W: int) -> Any:
    """The kernel for numbers of states, outputs and inputs, and for groups of W rows.

    W > 1 serves rows beyond the first window of a tracker with equations. Every entry of a matrix is then a vector with
    a number for each row.
    """
    kappa, points, wide, single = max(3.0 - nx, 0.0), 2 * nx + 1, padded(nx, W), W == 1
    far, other = math.sqrt(nx + kappa), 0.5 / (nx + kappa)
    middle, middle_squares = kappa / (nx + kappa), kappa / (nx + kappa) + 2.0
    square, cross, inputs, turns, inflation = nx * nx, nx * ny, max(nu, 1), RELINEARISATIONS, INFLATION
    of_states, of_outputs, of_innovations, of_network = (nx + nu) * wide, ny * wide, ny * ny, nx + inputs
    nis = nx + square  # its place in a row of the tracker
    of_row, rejections, trends = nis + 4 + 2 * ny, nis + 4, nis + 4 + ny

    @_inlined
    def factorise(P: Any, L: Any, inverse: Any) -> None:
        """P = L L^T, and the inverse of L's diagonal; not finite if P is not positive definite."""
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
        """G = across P^-1 V, or across^T P^-1 V."""
        b = stack(nx, 1)
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
        """Sigma points (nx, lanes); points beyond 2 nx + 1, which only fill registers, are the mean."""
        factorise(P, L, inverse)
        for i in range(nx):
            for p in range(wide):
                at[i * wide + p] = x[i]
            for j in range(i + 1):
                entry = far * L[i * nx + j]
                at[i * wide + 1 + j] += entry
                at[i * wide + 1 + nx + j] -= entry

    @_inlined
    def moments(at: Any, n: int, mean: Any, S: Any) -> None:
        """Mean (n,) and covariance (n, n) of points (n, lanes); subtracts the mean from the points."""
        for i in range(n):
            total = 0.0
            for p in range(1, points):
                total += at[i * wide + p]
            mean[i] = middle * at[i * wide] + other * total
            for p in range(wide):
                at[i * wide + p] -= mean[i]
            for j in range(i + 1):
                total = 0.0
                for p in range(1, points):
                    total += at[i * wide + p] * at[j * wide + p]
                S[i * n + j] = S[j * n + i] = middle_squares * at[i * wide] * at[j * wide] + other * total

    @_inlined
    def together(L: Any, at: Any, n: int, across: Any) -> None:
        """Covariance (nx, n) of the sigma points of L with their images, given as differences (n, lanes)."""
        for j in range(n):
            for i in range(nx):
                total = 0.0
                for k in range(i + 1):
                    total += L[i * nx + k] * (at[j * wide + 1 + k] - at[j * wide + 1 + nx + k])
                across[i * n + j] = other * far * total

    @_part
    def flow_step(at: Any, u: Any, flow: Any, scratch: Any) -> None:
        """One step of a learned flow for all sigma points, in place."""
        scaling, linear, packed, shape = flow
        q = stack(of_network, 1)
        for j in range(nu):
            q[nx + j] = u[j] * scaling[3, j]
        for p in range(points):
            for i in range(nx):
                q[i] = (at[i * wide + p] - scaling[0, i]) / scaling[1, i]
            for i in range(nx + nu):
                scratch[3, i] = q[i]
            evaluate(scratch[3, : nx + nu], packed, shape, scratch, scratch[4, :nx])
            for i in range(nx):
                total = q[i] + linear[i, 0]
                for j in range(nx + nu):
                    total += linear[i, 1 + j] * q[j]
                total += scaling[2, i] * scratch[4, i]
                at[i * wide + p] = scaling[0, i] + scaling[1, i] * total

    @_inlined
    def clipped(states: Any, s: Any, i: int) -> Any:
        """A state limited to its bounds."""
        s = choose(states[0, i], s, states[0, i], s)
        return choose(s, states[1, i], states[1, i], s)

    @_inlined
    def finite(value: Any) -> Any:
        """1 if a number is finite, else 0."""
        return choose(value, -np.inf, choose(np.inf, value, 1.0, 0.0), 0.0)

    @_inlined
    def within(states: Any, at: Any, count: int) -> None:
        """Limit states (nx, lanes) to their bounds."""
        for i in range(nx):
            for p in range(count):
                at[i * wide + p] = clipped(states, at[i * wide + p], i)

    @_inlined
    def predict(x: Any, P: Any, u: Any, model: Any, scratch: Any, L: Any, mean: Any, moved: Any, across: Any) -> None:
        """Mean and covariance one sample later, and the covariance with the earlier state."""
        states, flow, substeps, address, h, share = model
        inverse, at = stack(nx, W), stack(of_states, W)
        spread_out(x, P, L, inverse, at)
        within(states, at, wide)
        if substeps >= 0:
            for j in range(nu):
                for p in range(wide):
                    at[(nx + j) * wide + p] = u[j]
            call(address, doubles(at), doubles(at), substeps, h)
        if single:
            for _ in range(-substeps):
                flow_step(at, u, flow, scratch)
        moments(at, nx, mean, moved)
        together(L, at, nx, across)
        for i in range(nx):
            moved[i * nx + i] += share * states[2, i]

    @_inlined
    def expect(x: Any, P: Any, h: Any, states: Any, L: Any, y: Any, S: Any, V: Any) -> None:
        """Mean and covariance of the output, and its covariance with the state."""
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
        within(states, at, points)  # sigma points may lie where h is undefined
        call(address, doubles(at), doubles(near), points, 0.0)
        for k in range(ny):
            for p in range(points):
                i = k * wide + p
                near[i] = choose(finite(near[i]), 0.0, near[i], to[k * wide])
                to[i] = choose(finite(to[i]), 0.0, to[i], near[i])
        moments(to, ny, y, S)
        together(L, to, ny, V)

    @_inlined
    def reject(now: Any, y: Any, expected: Any, S: Any, r: Any, gate: float, window: float) -> None:
        """Set outputs to NaN whose innovations are beyond the gate, unless the gate is open."""
        for k in range(ny):
            innovation, count = y[k] - expected[k], now[rejections + k]
            far = choose(innovation * innovation, gate * gate * (S[k * ny + k] + r[k]), 1.0, 0.0)
            rejected = choose(window, count, choose(now[nis + 2], window - 0.5, far, 0.0), 0.0)
            now[nis + 3] += rejected
            now[rejections + k] = choose(finite(y[k]), 0.0, choose(far, 0.0, count + 1.0, 0.0), count)
            y[k] = choose(rejected, 0.0, np.nan, y[k])

    @_inlined
    def whiten(y: Any, expected: Any, S: Any, r: Any, white: Any, V: Any) -> None:
        """Whiten innovations: the corrected state is x + V white, with the covariance P - V V^T."""
        for k in range(ny):
            white[k] = choose(finite(y[k]), 0.0, y[k] - expected[k], 0.0)
        for k in range(ny):
            root = finite(y[k]) / math.sqrt(S[k * ny + k] + r[k])
            white[k] *= root
            for i in range(nx):
                V[i * ny + k] *= root
            for j in range(k + 1, ny):
                share = S[j * ny + k] * root
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
        white, last = stack(ny, W), 0
        if single:
            last = turns if now[nis + 2] < window else 0
        for i in range(nx):
            start[i] = now[i]
        for i in range(square):
            spread[i] = now[nx + i]
        for turn in range(last + 1):
            predict(start, spread, u, model, scratch, L, again, again_moved, again_across)
            if single and turn:  # linearise the motion about the smoothed start of the step
                smoothed(spread, L, inverse, again_across, G, True, D)
                shift(again, -1.0, D, white)
                add(again_moved, 1.0, D, D)
                add(again_across, 1.0, G, D)
                factorise(again_moved, L, inverse)
                total = 0.0
                for i in range(nx):
                    total += again[i] + inverse[i]
                if not np.isfinite(total):
                    break
            for i in range(nx):
                mean[i] = again[i]
            for i in range(square):
                moved[i], across[i] = again_moved[i], again_across[i]
            expect(mean, moved, h, states, L, expected, S, V)
            if turn == 0 and gate < np.inf:
                reject(now, y, expected, S, r, gate, window)
            whiten(y, expected, S, r, white, V)
            if single and turn < last:
                smoothed(moved, L, inverse, across, V, False, G)
                for i in range(nx):
                    start[i] = now[i]
                for i in range(square):
                    spread[i] = now[nx + i]
                shift(start, 1.0, G, white)
                add(spread, -1.0, G, G)
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
        # Beyond the limit, successive innovations are correlated.
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
    def is_driven(z: Any, nz: int) -> bool:
        """Whether an input has acted; also true if the system has no input."""
        acted = len(z) == nz
        for i in range(nz, len(z)):
            acted = acted or z[i] != 0.0
        return acted

    @_part
    def supervise(now: Any, z: Any, age: float, nz: int, dt: float, window: float, lost: bool, states: Any, maps: Any,
                  scratch: Any, x_hat: Any) -> None:  # fmt: skip
        """Take T_inv's estimate if the tracker diverged, or if T_inv has the smaller covariance in the first window."""
        driven = is_driven(z, nz)  # else use the T_inv of free motion
        ages, table = maps[2] if driven else maps[3]
        seen, at = min(now[nis + 2], window) * dt, 0
        while at < len(ages) - 2 and seen > ages[at + 1]:
            at += 1
        P, L, inverse, own = stack(square, 1), stack(square, 1), stack(nx, 1), stack(square, 1)
        part = 0.0 if len(ages) == 1 else min((seen - ages[at]) / (ages[at + 1] - ages[at]), 1.0)
        upper = min(at + 1, len(ages) - 1)
        for i in range(square):
            P[i], own[i] = (1.0 - part) * table[at, i] + part * table[upper, i], now[nx + i]
        larger = 0.0  # log of T_inv's determinant over the tracker's
        factorise(P, L, inverse)
        for i in range(nx):
            larger -= math.log(inverse[i])
        factorise(own, L, inverse)
        for i in range(nx):
            larger += math.log(inverse[i])
        if lost or larger < 0.0:
            decode(z if driven else z[:nz], age, maps[0] if driven else maps[1], scratch, x_hat)
            for i in range(nx):
                now[i] = clipped(states, x_hat[i], i)
            for i in range(square):
                now[nx + i] = P[i]
        if lost:
            now[nis] = now[nis + 1] = 1.0
            for k in range(ny):
                now[rejections + k] = window
                now[trends + k] = 0.0

    @_part
    def follow(z: Any, before: Any, u: Any, y: Any, linear: Any, out: Any) -> None:
        """Advance the linear filter by one interval, from the output ``before`` to y."""
        gains, places, mixing = linear
        size = len(z)
        for i in range(size):
            out[i] = gains[0, i] * z[i]
        for k in range(ny):
            for i in range(size):
                out[i] += gains[1 + k, i] * before[k] + gains[1 + ny + nu + k, i] * y[k]
        for j in range(nu):
            for i in range(size):
                out[i] += gains[1 + ny + j, i] * u[j]
        for i in range(len(mixing)):
            out[places[0, i]] += mixing[i] * z[places[1, i]]

    @_kernel
    def run(
        addresses: Any, flags: Any, numbers: Any, states: Any, r: Any, C: Any, linear: Any, maps: Any,
        flow: Any, rows: Any, state: Any, y: Any, u: Any, record: Any
    ) -> None:  # fmt: skip
        """Advance some rows of the state (n, width) by samples y (steps, n, ny) and inputs u (steps, n, nu).

        A record (steps, n, width) stores the rows at each sample; (steps, n, 0) stores none.
        """
        nz, widest, substeps = flags
        h, samples, dt, limit = numbers[:4]
        watched = numbers[4:]
        model, of_output = (states, flow, substeps, addresses[0], h, samples), (addresses[1], C)
        size = linear[0].shape[1]
        base, scratch = size + ny + 1, np.empty((5, widest + UNROLLED), np.float32)
        z, x_hat, filled = np.empty(size), np.empty(nx), np.empty(ny)
        now, sample, held, expected = stack(of_row, W), stack(ny, W), stack(inputs, W), stack(ny, W)
        nows, ys, us, expecteds = doubles(now), doubles(sample), doubles(held), doubles(expected)
        for first in range(0, len(rows), W):
            count = min(W, len(rows) - first)
            for k in range(len(y)):
                for w in range(W):
                    row = rows[first + min(w, count - 1)]  # unused lanes repeat the last row
                    for i in range(ny):
                        ys[i * W + w] = y[k, row, i]
                    for j in range(nu):
                        us[j * W + w] = u[k, row, j]
                    for i in range(of_row):
                        nows[i * W + w] = state[row, base + i]
                track(now, sample, held, model, of_output, r, watched, scratch, expected)
                for w in range(count):
                    row = rows[first + w]
                    whole, before = state[row], state[row, size : size + ny]
                    past, tracked = whole[:size], whole[base:]
                    for i in range(ny):
                        at = i * W + w
                        filled[i] = ys[at]
                        if np.isnan(ys[at]):
                            filled[i] = expecteds[at] if np.isfinite(expecteds[at]) else before[i]
                    follow(past, before, u[k, row], filled, linear, z)
                    for i in range(size):
                        past[i] = z[i]
                    for i in range(ny):
                        before[i] = filled[i]
                    whole[base - 1] += samples
                    for i in range(of_row):
                        tracked[i] = nows[i * W + w]
                    lost = not tracked[nis] <= limit
                    if lost or tracked[nis + 2] < watched[0]:
                        age = whole[base - 1] * dt
                        supervise(tracked, past, age, nz, dt, watched[0], lost, states, maps, scratch, x_hat)
                    for i in range(record.shape[2]):
                        record[k, row, i] = whole[i]

    return run
