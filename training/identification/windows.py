"""Windows that grow: shooting over longer and longer stretches of records, as long as they say more."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from training.identification.consistency import noise_level
from training.identification.identifiability import told_directions
from training.identification.motions import Shooting, Windows, settled
from training.identification.shooting import CLUSTERS, EXACT, ROUNDS, Fit, UnexplainedError, predictable, shoot
from training.records import Record

FIRST_LENGTHS = (400, 200, 100)  # samples of the first windows: long ones say more, short ones find their way
FIRST_ROUNDS = 25  # steps in which the longer of these have to find theirs
MORE_NOISE = 1.5  # standard deviation of their residuals, over that of the noise that neighbouring samples show
SMALL = 0.01  # of an output's standard deviation: residuals that are no matter without noise either
LEAST_USED = 0.8  # share of the windows that the model must explain at a new length
GAIN = 0.7  # standard errors at twice the length, over those before, from which on longer windows are not worth it
MORE_COST = 2.0  # mean square of the residuals at twice the length, over that before: the model does not last as long

FIRST_LEFT = 1.0  # standard errors that a first fit may be from its least squares, and still be on the right way
LEFT = 0.4  # the same of longer windows: where a fit is stuck, curvature promises more than it knows
APART = 0.5  # standard errors that it may be from a fit that began elsewhere
MOST_SAMPLES = 6400  # of a window

Starts = dict[tuple[int, int], np.ndarray]
"""Estimates of the state (nx,) by record and sample."""
Guess = Callable[[Record, np.ndarray], np.ndarray]
"""Record and samples in, estimates of the states there, (n, nx), out."""


def fit_windows(
    shooting: Shooting,
    guesses: Sequence[np.ndarray],
    records: Sequence[Record],
    guess: Guess,
    *,
    first: int,
    report: Callable[[str], object] = lambda line: None,
) -> Fit:
    """Fit parameters and starts on windows of growing length.

    Long windows say more, short ones find their way from rougher guesses: the first are as long as the model can
    explain most of them, but for noise, from one of the guesses. Chaos and process noise set an end to their
    growth, which no start explains for long: residuals are no longer white then, and standard errors that follow the
    scatter of windows fall no further. Chaos also makes many minima. So longer windows are fitted from two sides, a
    standard error of the shorter ones away, and count only if both fits come to rest, and in one place.
    """
    longest = min(max(len(record.y) for record in records) - 1 - first, MOST_SAMPLES)
    best, starts, length = _first_fit(shooting, guesses, records, guess, first=first, longest=longest)
    report(described(best, length))
    while 2 * length <= longest:
        length *= 2
        found = dict(zip(starts, best.windows.x0, strict=True))
        starts = {
            (index, k): x
            for (index, k), x in found.items()
            if (k - first) % length == 0 and k + length < len(records[index].y)
        }
        if len(starts) < CLUSTERS and best.coloured:
            break  # longer windows would hide what these show
        longer = windows(records, starts, length)
        keep = predictable(shooting, best, longer)
        if keep.mean() < LEAST_USED:
            break
        starts = {key: x for key, x, kept in zip(starts, longer.x0, keep, strict=True) if kept}
        told = told_directions(best.information)
        before = best.errors(told, told)
        theta, aside = np.array(list(best.parameters.values())), shooting.unit * (told @ np.minimum(before, 1.0))
        fit = _longer_fit(shooting, theta + aside, records, starts, length)
        if fit.used.mean() < LEAST_USED or fit.cost > MORE_COST * best.cost or (fit.coloured and not best.coloured):
            break
        if fit.left > LEFT or fit.claims > best.claims:
            break
        now = fit.errors(told, told)
        other = _longer_fit(shooting, theta - aside, records, starts, length)
        if other.left > LEFT or other.claims > best.claims or (_apart(fit, other, told) > APART * now).any():
            break  # so long windows have many minima, and their curvature says nothing of where the others are
        report(described(fit, length))
        gain = now / before
        if (gain < 1).any():
            best = min(fit, other, key=lambda each: each.cost)
        if (gain > GAIN).all():
            break
    return best


def _longer_fit(shooting: Shooting, theta: np.ndarray, records: Sequence[Record], starts: Starts, length: int) -> Fit:
    """A fit to windows twice as long as those before, if they had led to these parameters."""
    theta = np.clip(theta, shooting.low, shooting.high)
    x0 = settled(shooting, theta, windows(records, starts, length // 2))
    return shoot(shooting, theta, windows(records, dict(zip(starts, x0, strict=True)), length))


def _apart(one: Fit, other: Fit, directions: np.ndarray) -> np.ndarray:
    """How far the parameters of two fits are from each other along directions, in their units."""
    difference = np.subtract(list(one.parameters.values()), list(other.parameters.values()))
    return np.asarray(np.abs(directions.T @ (difference / one.unit)))


def _first_fit(
    shooting: Shooting,
    guesses: Sequence[np.ndarray],
    records: Sequence[Record],
    guess: Guess,
    *,
    first: int,
    longest: int,
) -> tuple[Fit, Starts, int]:
    """A fit on the longest of the first windows that the model explains, their starts, and their length.

    Where chaos keeps all fits from their least squares, it is the one that is nearest, in its own standard errors, or
    before it the one that explains its windows best to rounding.
    """
    spread = np.nanstd(np.concatenate([record.y for record in records]), 0)
    expected = np.maximum(MORE_NOISE * noise_level(records), SMALL * spread)
    lengths = sorted({min(length, longest) for length in FIRST_LENGTHS}, reverse=True)
    problem: Exception = UnexplainedError("no guess of the parameters")
    under_way = list[tuple[Fit, Starts, int]]()  # explain their windows, but are not at their least squares
    for length in lengths:
        starts: Starts = {}
        for index, record in enumerate(records):
            at = np.arange(first, len(record.y) - length, length)
            starts |= {(index, int(k)): x for k, x in zip(at, guess(record, at), strict=True)}
        cut, fits = windows(records, starts, length), list[Fit]()
        for theta in guesses:
            try:
                fit = shoot(shooting, theta, cut, rounds=ROUNDS if length == lengths[-1] else FIRST_ROUNDS)
            except UnexplainedError as error:
                problem = error
                continue
            fits.append(fit)
            if fit.used.mean() >= LEAST_USED and (fit.noise <= expected).all():
                if fit.left <= FIRST_LEFT:
                    return fit, starts, length
                under_way.append((fit, starts, length))
    if under_way:
        return min(under_way, key=lambda each: _unsettled(each[0]))
    if fits:
        return min(fits, key=lambda fit: fit.cost), starts, length
    raise problem


def _unsettled(fit: Fit) -> tuple[bool, float]:
    """How far a fit is from being done, to compare; where all is explained to rounding, what is left is rounding."""
    exact = fit.cost < EXACT
    return not exact, fit.cost if exact else fit.left


def windows(records: Sequence[Record], starts: Mapping[tuple[int, int], np.ndarray], length: int) -> Windows:
    """Cut windows of one length out of records."""

    def cut(values: Sequence[np.ndarray], samples: int) -> np.ndarray:
        return np.stack([values[index][k : k + samples] for index, k in starts], 1)

    inputs = [np.zeros((len(record.y), 0)) if record.u is None else record.u for record in records]
    return Windows(cut([record.y for record in records], length + 1), cut(inputs, length), np.array([*starts.values()]))


@dataclass(frozen=True)
class Prediction:
    """Outputs of a window of a record that took no part in the fit, predicted from the window's first half."""

    record: Record
    first: int
    y: np.ndarray
    fitted: int

    @property
    def residuals(self) -> np.ndarray:
        """Measured minus predicted outputs, (steps + 1, ny)."""
        return np.asarray(self.record.y[self.first : self.first + len(self.y)] - self.y)


def predict(
    shooting: Shooting, theta: np.ndarray, records: Sequence[Record], guess: Guess, *, first: int, length: int
) -> list[Prediction]:
    """Predict the outputs of records from half of a window at their beginning."""
    chosen = [record for record in records if len(record.y) > first + length]
    if not chosen:
        return []
    fitted = length // 2
    starts = {(i, first): guess(record, np.array([first]))[0] for i, record in enumerate(chosen)}
    x0 = settled(shooting, theta, windows(chosen, starts, fitted))
    whole = windows(chosen, starts, length)
    y = shooting.outputs(np.tile(theta, (len(x0), 1)), x0, whole.u)
    return [Prediction(record, first, y[:, i], fitted) for i, record in enumerate(chosen)]


def described(fit: Fit, length: int) -> str:
    """A line about a fit."""
    values = ", ".join(
        f"{name} = {value:.6g} +- {error:.2g}"
        for (name, value), error in zip(fit.parameters.items(), fit.standard_errors)
    )
    return f"windows of {length} samples: {values}; residuals {', '.join(f'{noise:.3g}' for noise in fit.noise)}"
