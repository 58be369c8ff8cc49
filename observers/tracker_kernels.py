"""A tracker's step as Numba compiles it.

Kernels are made for numbers of states, inputs and outputs, and for the terms that a flow's polynomial has: loops as
short as theirs are else mostly overhead. A step takes some rows at a time, and its innermost loops are over these rows
or their sigma points, which are vectors to the processor. A single sample is the same with one row.

Kernels take a table of states, a row for each: its bounds, the gain of the flow's network, the variance that is added,
offset, scale and bend. That of outputs has their mean, the variance of the noise, what innovations are watched by, as
:class:`observers.supervision.Supervision` has it, and C.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from observers.compiled import UNROLLED, active_kernel, single_network
from observers.machine import kernel, part
from observers.polynomial import count, table
from observers.sparse import single_update
from observers.supervision import INFLATION

_LOW, _HIGH, _GAIN, _NOISE, _OFFSET, _SCALE, _BEND = range(7)  # columns of the table of states
_WRITTEN_OUT = 400  # coefficients of a polynomial: more would take the compiler long
_WIDE = 16  # neurons of a layer: beyond, a single row's loops are over them, and not over its few points
_LANES = 32  # rows of a batch that go through together: what there is of them stays in the first cache
_MEAN, _VARIANCE, _SHARE, _TREND_SHARE, _TREND_SQUARE_SHARE, _TREND_GAIN, _TREND_LIMIT, _C = range(8)  # of outputs


_kernel = kernel(fastmath={"contract"}, error_model="numpy")
_part = part(fastmath={"contract"}, error_model="numpy")


@functools.cache
def _unscaling() -> Callable[[float, float, float], float]:
    """A state in its own units, rounded as NumPy does it: a row that stands still says the same whoever is asked."""

    @part(fastmath=False)  # said aloud, or it would be as in the first kernel that calls it
    def unscaled(offset: float, scale: float, s: float) -> float:
        return offset + scale * s

    return unscaled


@functools.cache
def kernels(activation: str, nu: int, ny: int, degree: int, used: tuple[tuple[bool, ...], ...]) -> tuple[Any, ...]:
    """Those of :class:`observers.compiled_tracker.CompiledTracker`: a single sample, a batch, and what T_inv says.

    ``used`` says for each state which terms its polynomial has.
    """
    update, unscaled, nx = single_update(), _unscaling(), len(used)
    terms = count(nx + nu, degree)
    step_one, step_lanes = (_step(activation, nu, ny, degree, used, lanes) for lanes in (1, _LANES))

    @_kernel
    def one(
        numbers: np.ndarray,
        whole: np.ndarray,
        packed: np.ndarray,
        z: np.ndarray,
        y: np.ndarray,
        u: np.ndarray,
        y_next: np.ndarray,
        state: np.ndarray,
        shown: np.ndarray,
    ) -> None:
        size, layers = len(z), whole[0]
        widths, places = whole[1 : 1 + layers], whole[1 + layers :].reshape(2, (len(whole) - 1 - layers) // 2)
        states = numbers[: nx * (_BEND + 1)].reshape(nx, _BEND + 1)
        at = nx * (_BEND + 1)
        outputs = numbers[at : at + ny * (_C + nx)].reshape(ny, _C + nx)
        at += ny * (_C + nx)
        scale = numbers[at : at + nu]
        at += nu
        polynomial = numbers[at : at + nx * terms].reshape(nx, terms)
        at += nx * terms
        end = len(numbers) - places.shape[1]
        gains, mixing = numbers[at:end].reshape((end - at) // size, size), numbers[end:]

        expected, filled, all_rows = shown[nx : nx + ny], shown[nx + ny : nx + 2 * ny], np.ones(1, np.bool_)
        step_one(
            states,
            outputs,
            scale,
            polynomial,
            packed,
            widths,
            u.reshape(1, nu),
            y_next.reshape(1, ny),
            all_rows,
            state,
            shown[:nx].reshape(1, nx),
            expected.reshape(1, ny),
        )
        for k in range(ny):
            filled[k] = y_next[k]
            if np.isnan(y_next[k]):
                filled[k] = expected[k] if np.isfinite(expected[k]) else y[k]
        update(gains, places, mixing, z, y, u, filled, shown[nx + 2 * ny :])

    @_kernel
    def take(
        states: np.ndarray,
        x: np.ndarray,
        P: np.ndarray,
        lost: np.ndarray,
        where: np.ndarray,
        state: np.ndarray,
        shown: np.ndarray,
    ) -> None:
        for k in range(len(where)):
            row, ours, theirs = state[where[k]], 0.0, 0.0
            for i in range(nx):
                ours += row[nx + nx * i + i]
                theirs += P[k, i, i] / (states[i, _SCALE] * states[i, _SCALE])
            if lost[k] or theirs < ours:
                for i in range(nx):
                    s = (x[k, i] - states[i, _OFFSET]) / states[i, _SCALE]
                    s = states[i, _LOW] if s < states[i, _LOW] else s
                    row[i] = states[i, _HIGH] if s > states[i, _HIGH] else s
                    if len(shown) > 0:
                        shown[where[k], i] = unscaled(states[i, _OFFSET], states[i, _SCALE], row[i])
                    for j in range(nx):
                        row[nx + nx * i + j] = P[k, i, j] / (states[i, _SCALE] * states[j, _SCALE])
                if lost[k]:
                    row[nx + nx * nx] = row[nx + nx * nx + 1] = 1.0
                    row[nx + nx * nx + 3 :] = 0.0

    return one, _kernel(step_lanes), take


def _along(signals: int, degree: int, used: tuple[tuple[bool, ...], ...], points: int) -> Callable[..., None]:
    """Where points go by a polynomial, (nx, terms): (signals + nx) rows of all points, of which the last are written.

    Of few coefficients it is written out, so that the monomials of a point stay in the processor's registers, and those
    that no state has are left out.
    """
    (earlier, by), nx = table(signals, degree), len(used)
    terms = len(by)
    if sum(map(sum, used)) > _WRITTEN_OUT:

        @_part
        def along(polynomial: np.ndarray, flat: np.ndarray) -> None:
            at = flat.reshape(signals + nx, points)
            products = np.ones((terms, points))
            for t in range(1, terms):
                for p in range(points):
                    products[t, p] = products[earlier[t], p] * at[by[t], p]
            for i in range(nx):
                moved = at[signals + i]
                for p in range(points):
                    moved[p] = at[i, p]
                for t in range(terms):
                    factor, product = polynomial[i, t], products[t]
                    for p in range(points):
                        moved[p] += factor * product[p]

        return along

    asked = {0} | {t for of_one in used for t in range(terms) if of_one[t]}
    for t in range(terms - 1, 0, -1):
        if t in asked:  # as are those that it is a product of
            asked.add(int(earlier[t]))
    lines = ["def along(polynomial, flat):"]
    lines += [f"    c{i}_{t} = polynomial[{i}, {t}]" for i in range(nx) for t in range(terms) if used[i][t]]
    lines += [f"    for p in range({points}):"]
    lines += [f"        s{j} = flat[{j * points} + p]" for j in range(signals)]
    lines += ["        m0 = 1.0"]
    lines += [f"        m{t} = m{earlier[t]} * s{by[t]}" for t in sorted(asked - {0})]
    for i in range(nx):
        change = " + ".join(f"c{i}_{t} * m{t}" for t in range(terms) if used[i][t])
        lines += [f"        flat[{(signals + i) * points} + p] = s{i} + ({change or 0.0})"]
    namespace: dict[str, Any] = {}
    exec("\n".join(lines), namespace)
    return _part(namespace["along"])


def _step(
    activation: str, nu: int, ny: int, degree: int, used: tuple[tuple[bool, ...], ...], lanes: int
) -> Callable[..., None]:
    """A kernel that takes so many rows at a time: what they have in common is a loop over them.

    Its arrays have an entry for each row in the end, or for each sigma point of each row.
    """
    active, of_one, nx = active_kernel(activation), single_network(activation), len(used)
    signals, each = nx + nu, 2 * nx
    far, weight, points = math.sqrt(nx), 1 / each, each * lanes
    unrolled, inflation = UNROLLED, INFLATION  # of other files, to which the cache would not look
    along, unscaled = _along(signals, degree, used, points), _unscaling()

    @_part
    def factorise(P: np.ndarray) -> None:
        """Cholesky's factor in the place of P's lower half; NaN where there is none."""
        for i in range(nx):
            for j in range(i + 1):
                for k in range(j):
                    for r in range(lanes):
                        P[i, j, r] -= P[i, k, r] * P[j, k, r]
                if i > j:
                    for r in range(lanes):
                        P[i, j, r] /= P[j, j, r]
                else:
                    for r in range(lanes):
                        P[i, j, r] = math.sqrt(P[i, j, r]) if P[i, j, r] > 0.0 else np.nan

    @_part
    def spread_out(states: np.ndarray, x: np.ndarray, L: np.ndarray, at: np.ndarray) -> None:
        """The sigma points, within the bounds."""
        for i in range(nx):
            for p in range(each):
                for r in range(lanes):
                    at[i, p * lanes + r] = x[i, r]
            for j in range(i + 1):
                for r in range(lanes):
                    at[i, j * lanes + r] += far * L[i, j, r]
                    at[i, (nx + j) * lanes + r] -= far * L[i, j, r]
            low, high = states[i, _LOW], states[i, _HIGH]
            for p in range(points):
                s = at[i, p]
                s = low if s < low else s
                at[i, p] = high if s > high else s

    @_part
    def evaluate_each(packed: np.ndarray, widths: np.ndarray, h: np.ndarray, into: np.ndarray) -> np.ndarray:
        """The network, of inputs h; what it says lies in what is returned. The loops are over its width."""
        memory = np.empty((5, len(h)), np.float32)
        for p in range(points):
            for i in range(signals):
                memory[3, i] = h[i, p]
            of_one(memory[3, :signals], packed, widths, memory[:3], memory[4, :nx])
            for i in range(nx):
                into[i, p] = memory[4, i]
        return into

    @_part
    def evaluate_all(packed: np.ndarray, widths: np.ndarray, h: np.ndarray, into: np.ndarray) -> np.ndarray:
        """The same, in one of the two arrays. The loops are over the points."""
        begin = 0
        for layer in range(len(widths) - 1):
            inputs, width = widths[layer], widths[layer + 1]
            for i in range(inputs, inputs + unrolled):
                for p in range(points):
                    h[i, p] = 0.0  # beside the rows of zeros
            for j in range(width):
                row = into[j]
                for p in range(points):
                    row[p] = packed[begin + j]
                at = begin + width + j
                for i in range(0, inputs, unrolled):
                    w0, w1, w2, w3 = packed[at], packed[at + width], packed[at + 2 * width], packed[at + 3 * width]
                    a, b, c, d = h[i], h[i + 1], h[i + 2], h[i + 3]
                    for p in range(points):
                        row[p] += w0 * a[p] + w1 * b[p] + w2 * c[p] + w3 * d[p]
                    at += unrolled * width
                if layer < len(widths) - 2:
                    for p in range(points):
                        row[p] = active(row[p])
            begin += width + (inputs + (-inputs) % unrolled) * width
            h, into = into, h
        return h

    @_part
    def evaluate(packed: np.ndarray, widths: np.ndarray, h: np.ndarray, into: np.ndarray) -> np.ndarray:
        """The quicker of both."""
        if lanes == 1 and widths.max() > _WIDE:
            return evaluate_each(packed, widths, h, into)
        return evaluate_all(packed, widths, h, into)

    @_part
    def moments(
        states: np.ndarray,
        h: np.ndarray,
        moved: np.ndarray,
        x: np.ndarray,
        mean: np.ndarray,
        P: np.ndarray,
        distance: np.ndarray,
    ) -> None:
        """Of where the points go with the network, and what the flow is off by; x are the estimates before."""
        for r in range(lanes):
            distance[r] = 0.0
        for i in range(nx):
            gain = states[i, _GAIN]
            for p in range(points):
                moved[i, p] += gain * h[i, p]
            for r in range(lanes):
                total = 0.0
                for p in range(each):
                    total += moved[i, p * lanes + r]
                mean[i, r] = total * weight
                distance[r] += (mean[i, r] - x[i, r]) * (mean[i, r] - x[i, r])
            for p in range(each):
                for r in range(lanes):
                    moved[i, p * lanes + r] -= mean[i, r]
            for j in range(i + 1):
                for r in range(lanes):
                    total = 0.0
                    for p in range(each):
                        total += moved[i, p * lanes + r] * moved[j, p * lanes + r]
                    P[i, j, r] = total * weight
            for r in range(lanes):
                P[i, i, r] += states[i, _NOISE]
        for i in range(nx):
            if states[i, _BEND] > 0.0:  # or infinity times 0 would be no number
                for r in range(lanes):
                    bent = states[i, _BEND] * distance[r]
                    P[i, i, r] += bent * bent

    @_part
    def correct(
        output: np.ndarray,
        y: np.ndarray,
        mean: np.ndarray,
        P: np.ndarray,
        across: np.ndarray,
        apart: np.ndarray,
        pivot: np.ndarray,
        squared: np.ndarray,
        seen: np.ndarray,
        there: np.ndarray,
        trend: np.ndarray,
        raised: np.ndarray,
    ) -> None:
        """Take in an output, where it is a number."""
        for r in range(lanes):
            there[r] = 1.0 if y[r] == y[r] else 0.0
            apart[r] = y[r] - output[_MEAN] if y[r] == y[r] else 0.0
            pivot[r] = output[_VARIANCE]
        for i in range(nx):
            for r in range(lanes):
                across[i, r] = 0.0
            for j in range(nx):
                entry = P[i, j] if j < i else P[j, i]
                for r in range(lanes):
                    across[i, r] += output[_C + j] * entry[r]
            for r in range(lanes):
                apart[r] -= there[r] * output[_C + i] * mean[i, r]
                pivot[r] += output[_C + i] * across[i, r]
        for r in range(lanes):
            white = apart[r] / math.sqrt(pivot[r])
            trend[r] += there[r] * output[_TREND_SHARE] * (white - trend[r])
            raised[r] += there[r] * trend[r] * trend[r]
            squared[r] += white * white
            seen[r] += there[r]
            there[r] /= pivot[r]
        for i in range(nx):
            for r in range(lanes):
                mean[i, r] += there[r] * across[i, r] * apart[r]
            for j in range(i + 1):
                for r in range(lanes):
                    P[i, j, r] -= there[r] * across[i, r] * across[j, r]

    @_part
    def step(
        states: np.ndarray,
        outputs: np.ndarray,
        scale: np.ndarray,
        polynomial: np.ndarray,
        packed: np.ndarray,
        widths: np.ndarray,
        u: np.ndarray,
        y: np.ndarray,
        rows: np.ndarray,
        state: np.ndarray,
        shown: np.ndarray,
        expected: np.ndarray,
    ) -> None:
        n, cut = len(state), nx * nx
        of_rows = np.empty((cut + 3 * nx + 8 + ny, lanes))
        P, x, mean = of_rows[:cut].reshape(nx, nx, lanes), of_rows[cut : cut + nx], of_rows[cut + nx : cut + 2 * nx]
        across, more = of_rows[cut + 2 * nx : cut + 3 * nx], of_rows[cut + 3 * nx :]
        distance, sample, apart, pivot = more[0], more[1], more[2], more[3]
        squared, seen, there, raised, trends = more[4], more[5], more[6], more[7], more[8:]
        flat = np.empty((signals + nx) * points)
        of_points = flat.reshape(signals + nx, points)
        at, moved = of_points[:signals], of_points[signals:]
        between = np.empty((2, widths.max() + unrolled, points), np.float32)
        for first in range(0, n, lanes):
            for r in range(lanes):
                now = min(first + r, n - 1)  # behind the last row, copies of it
                for i in range(nx):
                    x[i, r] = state[now, i]
                    for j in range(i + 1):
                        P[i, j, r] = state[now, nx + nx * i + j]
                for j in range(nu):
                    for p in range(each):
                        at[nx + j, p * lanes + r] = u[now, j] * scale[j]
            factorise(P)
            spread_out(states, x, P, at)
            for i in range(signals):
                for p in range(points):
                    between[0, i, p] = at[i, p]
            along(polynomial, flat)
            moments(states, evaluate(packed, widths, between[0], between[1]), moved, x, mean, P, distance)

            size = min(lanes, n - first)
            for k in range(ny):
                for r in range(size):
                    expected[first + r, k] = outputs[k, _MEAN]
                    for i in range(nx):
                        expected[first + r, k] += outputs[k, _C + i] * mean[i, r]
            for r in range(lanes):
                squared[r] = seen[r] = raised[r] = 0.0
            for k in range(ny):
                for r in range(lanes):
                    now = min(first + r, n - 1)
                    sample[r], trends[k, r] = y[now, k], state[now, nx + cut + 3 + k]
                correct(outputs[k], sample, mean, P, across, apart, pivot, squared, seen, there, trends[k], raised)
            for r in range(size):
                row, total = state[first + r], 0.0
                for i in range(nx):
                    total += mean[i, r]
                    for j in range(i + 1):
                        total += P[i, j, r]
                if rows[first + r] and np.isfinite(total):
                    for i in range(nx):
                        s = mean[i, r]
                        s = states[i, _LOW] if s < states[i, _LOW] else s
                        row[i] = states[i, _HIGH] if s > states[i, _HIGH] else s
                        for j in range(i + 1):
                            row[nx + nx * i + j] = row[nx + nx * j + i] = P[i, j, r]
                    if seen[r] > 0:
                        counted, trend = seen[r] / ny, outputs[0, _TREND_GAIN] * raised[r] / seen[r]
                        row[nx + cut] += outputs[0, _SHARE] * counted * (squared[r] / seen[r] - row[nx + cut])
                        row[nx + cut + 1] += outputs[0, _TREND_SQUARE_SHARE] * counted * (trend - row[nx + cut + 1])
                        row[nx + cut + 2] += 1.0
                        for k in range(ny):
                            row[nx + cut + 3 + k] = trends[k, r]
                        if row[nx + cut + 1] > outputs[0, _TREND_LIMIT]:
                            for i in range(nx, nx + cut):
                                row[i] *= inflation
                            row[nx + cut + 1] = 1.0
                            row[nx + cut + 3 :] = 0.0
                elif rows[first + r]:
                    row[nx + cut] = np.inf
                for i in range(nx):
                    shown[first + r, i] = unscaled(states[i, _OFFSET], states[i, _SCALE], row[i])

    return step


__all__ = ["kernels"]
