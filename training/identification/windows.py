"""Multiple shooting on windows: their length is doubled while this improves the parameters."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from training.identification.identifiability import identifiable_directions
from training.identification.motions import Problem, Shooting, Windows
from training.identification.shooting import CLUSTERS, Fit, UnexplainedError, predictable, shoot
from training.records import Record

FIRST_LENGTHS = (100, 200, 400)  # lengths of the first windows in samples; each length is fitted in turn
MORE_NOISE = 1.5  # largest standard deviation of the first windows' residuals, in multiples of the noise level
SMALL = 0.01  # the same in multiples of the output's standard deviation; the larger of the two limits counts
LEAST_USED = 0.8  # least share of the windows that the model must explain at a new length
GAIN = 0.7  # lengths grow no further once every standard error is more than this share of its previous value
MORE_COST = 2.0  # largest factor by which a doubling may increase the residuals' mean square
LEFT = 0.4  # in standard errors: longest Gauss-Newton step that may remain after a fit
APART = 0.5  # in standard errors: largest distance between two fits of the same windows, see fit_windows
MOST_SAMPLES = 6400  # largest number of samples in a window
DIFFERENCES = 4  # order of the differences of y that estimate the noise

Starts = Mapping[tuple[int, int], np.ndarray]
"""States (nx,) at the first samples of windows, by indices of the record and of the sample."""


def noise_level(records: Sequence[Record]) -> np.ndarray:
    """Return the standard deviation (ny,) of white noise on outputs, from differences of neighbouring samples."""
    order = DIFFERENCES
    gain = math.comb(2 * order, order)  # sum of the squared coefficients of the difference
    parts = [np.diff(record.y, n=order, axis=0) ** 2 / gain for record in records if len(record.y) > order]
    blocks = [part.mean(0) for whole in parts for part in np.array_split(whole, max(1, len(whole) // 100))]
    # The median leaves out the fast parts of a motion, whose differences are not noise.
    return np.sqrt(np.median(blocks, axis=0))


def fit_windows(
    shooting: Shooting,
    records: Sequence[Record],
    rng: np.random.Generator,
    *,
    say: Callable[[str], object] = lambda line: None,
    report: Callable[[float], object] = lambda part: None,
) -> Fit:
    """Fit parameters and initial states on windows of growing length; ``report`` receives the share done.

    Long windows give smaller standard errors, short ones converge from rougher guesses. Chaos and process noise limit
    the length: the residuals of longer windows are not white, and the sum of their squares has many minima. So each
    doubled length is fitted twice, from one standard error on either side of the last fit; the fits must agree.
    """
    longest = min(max(len(record.y) for record in records) - 1, MOST_SAMPLES)
    first = [length for length in FIRST_LENGTHS if length <= longest] or [longest]
    fits, done = len(first) + 2 * max(int(math.log2(longest / first[-1])), 0), 0

    def fitted(shooting: Shooting, theta: np.ndarray, cut: Windows) -> Fit:
        nonlocal done
        fit = shoot(shooting, theta, cut, report=lambda part: report((done + part) / fits))
        done += 1
        report(done / fits)
        return fit

    best = _first_fit(shooting, records, rng, first, fitted)
    say(described(best))
    shooting, length = shooting.around(best.theta), len(best.windows.u)
    starts: Starts = dict(zip(_cuts(records, length), best.windows.x0, strict=True))
    while 2 * length <= longest:
        length *= 2
        starts = {key: starts[key] for key in _cuts(records, length) if key in starts}
        if len(starts) < CLUSTERS and best.coloured:
            # Standard errors under coloured residuals need more windows.
            break
        keep = predictable(best, windows(records, starts, length))
        if keep.mean() < LEAST_USED:
            break
        starts = {key: x for (key, x), kept in zip(starts.items(), keep, strict=True) if kept}
        known = identifiable_directions(best.information)
        before = best.errors(known, known)
        aside = shooting.unit * (known @ np.minimum(before, 1.0))
        longer = list[Fit]()
        for side in (aside, -aside):
            theta = np.clip(best.theta + side, shooting.low, shooting.high)
            x0 = Problem(shooting, windows(records, starts, length // 2)).settled(theta).x0
            fit = fitted(shooting, theta, windows(records, dict(zip(starts, x0, strict=True)), length))
            if fit.left > LEFT or not _lasts(fit, best):
                break
            longer.append(fit)
        if len(longer) < 2:
            break
        now = longer[0].errors(known, known)
        apart = np.abs(known.T @ ((longer[0].theta - longer[1].theta) / shooting.unit))
        if (apart > APART * now).any():
            break
        gain = now / before
        if (gain < 1).any():
            best = min(longer, key=lambda each: each.cost)
            say(described(best))
        if (gain > GAIN).all():
            break
        starts = dict(zip(starts, longer[0].windows.x0, strict=True))
    return best


def _lasts(longer: Fit, shorter: Fit) -> bool:
    """Return whether the model explains longer windows about as well as shorter ones."""
    return bool(
        longer.used.mean() >= LEAST_USED
        and longer.cost <= MORE_COST * shorter.cost
        and (shorter.coloured or not longer.coloured)
    )


def _first_fit(
    shooting: Shooting,
    records: Sequence[Record],
    rng: np.random.Generator,
    lengths: Sequence[int],
    fitted: Callable[[Shooting, np.ndarray, Windows], Fit],
) -> Fit:
    """Guess starts in X; return the fit of the longest windows with small residuals, or else of the shortest ones."""
    spread = np.nanstd(np.concatenate([record.y for record in records]), 0)
    expected = np.maximum(MORE_NOISE * noise_level(records), SMALL * spread)
    theta, best, problem = shooting.given, None, UnexplainedError("")
    for length in lengths:
        nowhere = dict.fromkeys(_cuts(records, length), np.zeros(shooting.system.nx))
        cut = windows(records, nowhere, length)
        try:
            fit = fitted(shooting, theta, replace(cut, x0=Problem(shooting, cut).searched(theta, rng).x0))
        except UnexplainedError as error:
            problem = error
            continue
        if best is None or (fit.used.mean() >= LEAST_USED and (fit.noise <= expected).all()):
            best, theta = fit, fit.theta
    if best is None:
        raise problem
    return best


def _cuts(records: Sequence[Record], length: int) -> list[tuple[int, int]]:
    """Return the indices of record and first sample for each window of a given length."""
    return [(i, k) for i, record in enumerate(records) for k in range(0, len(record.y) - length, length)]


def windows(records: Sequence[Record], starts: Starts, length: int) -> Windows:
    """Cut records into windows of a given length, which begin at ``starts``."""

    def cut(values: Sequence[np.ndarray], samples: int) -> np.ndarray:
        return np.stack([values[index][k : k + samples] for index, k in starts], 1)

    inputs = [np.zeros((len(record.y), 0)) if record.u is None else record.u for record in records]
    return Windows(cut([record.y for record in records], length + 1), cut(inputs, length), np.array([*starts.values()]))


@dataclass(frozen=True)
class Prediction:
    """Outputs ``y`` (steps + 1, ny) of a held-out record, predicted from its samples 0 to ``fitted``."""

    record: Record
    y: np.ndarray
    fitted: int


def predict(fit: Fit, records: Sequence[Record], rng: np.random.Generator) -> list[Prediction]:
    """Predict outputs in the first window of each record that has one; the window's first half gives the start."""
    length, theta = len(fit.windows.u), fit.theta
    chosen = [record for record in records if len(record.y) > length]
    if not chosen:
        return []
    nowhere = {(i, 0): np.zeros(fit.shooting.system.nx) for i in range(len(chosen))}
    half, whole = (windows(chosen, nowhere, samples) for samples in (length // 2, length))
    x0 = Problem(fit.shooting, half).searched(theta, rng).x0
    y = fit.shooting.outputs(np.tile(theta, (len(x0), 1)), x0, whole.u)
    return [Prediction(record, y[:, i], length // 2) for i, record in enumerate(chosen)]


def described(fit: Fit) -> str:
    """Return a line of text with the parameters, standard errors and residuals of a fit."""
    values = ", ".join(
        f"{name} = {value:.6g} +- {error:.2g}"
        for (name, value), error in zip(fit.parameters.items(), fit.standard_errors)
    )
    noise = ", ".join(f"{noise:.3g}" for noise in fit.noise)
    return f"windows of {len(fit.windows.u)} samples: {values}; residuals {noise}"
