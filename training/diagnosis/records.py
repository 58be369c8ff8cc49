"""Which hidden signals outputs and inputs determine, from records or rollouts, without a training."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from scipy.spatial import cKDTree

from observers.checks import integer, noise_levels, shown
from training.diagnosis.finding import RESOLUTION, Finding, Verdict, error
from training.evaluation.levels import Level, show_level
from training.maps.coordinates import SETTLED, coordinates, noise_covariance, root, settling_time
from training.progress import ProgressBars, progress_bars
from training.records import Record, check_signals, resampled
from training.records.record import Windows
from training.rollouts import Policy, policy_of
from training.rollouts.playing import RANDOM, play
from training.seeds import Stream, generator
from training.sources.recorded import FEW, evenly, recorded_preset, split
from training.spectrum import Spectrum

STEPS = 10_000  # played in an environment, by default
MAX_QUERIES, MAX_OTHERS = 500, 40_000  # samples that are predicted, and those that may be their neighbours
QUERY_SHARE = 0.2  # of the records; neighbours come from the others
MIN_QUERIES = 50  # samples, for a judgement
MIN_OTHERS = 5  # times the coordinates of z
NOISE_SHARES = 0.01, 0.1  # of an output's standard deviation, where no level is named
MIN_NEIGHBOURS = 32  # or twice as many as z has coordinates, so that planes rest on enough of them
ROUNDING = 1e-9  # of z, in a linear regression
DETERMINED, UNDETERMINED = 0.05, 0.8  # of a signal's standard deviation: largest and least errors of these verdicts
AS_GOOD = 1.1  # times the least error, up to which a window is as good as any
SEEN = 0.1  # largest error of a signal's change, in the signal's own error, for it to be known up to a constant

# By the first word of a signal's verdict.
VERDICTS: dict[str, tuple[Verdict, str]] = {
    "determined": ("ok", ""),
    "up": ("note", "an observer follows it from a known start; measure a signal that depends on its value, too"),
    "partly": ("note", "measure one more signal that depends on it, or accept the remaining error"),
    "not": ("problem", "measure a signal that depends on it, or leave it out"),
    "never": ("note", "leave it out"),
}


@dataclass(frozen=True)
class Judgement:
    """The verdict on one hidden signal."""

    signal: str
    verdict: str
    window: int | None
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Observability:
    """Which hidden signals outputs and inputs determine.

    Errors are root mean squares in standard deviations of the signals.

    Parameters
    ----------
    measured, inputs, hidden : tuple of str
        Names of the signals.
    dt : float
        Seconds in a step.
    windows : tuple of int, length m
        Steps back that outputs and inputs are known; 0 is the output alone.
    noise : tuple of (float or tuple of float), length k
        Levels of measurement noise; the first is 0.
    errors : ndarray, shape (k, m, nx)
        Of the best estimate after so many steps.
    changes : ndarray, shape (m, nx)
        Its errors of a signal's change over the window, in standard deviations of that change, without noise; NaN where
        no signal changes, and over windows whose start the filter has forgotten.
    warnings : tuple of str
        Judgements for which the data are too few.
    """

    measured: tuple[str, ...]
    inputs: tuple[str, ...]
    hidden: tuple[str, ...]
    dt: float
    windows: tuple[int, ...]
    noise: tuple[Level, ...]
    errors: np.ndarray
    changes: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def judgements(self) -> tuple[Judgement, ...]:
        """The verdict on each hidden signal."""
        return tuple(map(self._judged, range(len(self.hidden))))

    def findings(self) -> Iterator[Finding]:
        """The same as lines of a diagnosis."""
        known = " and ".join(", ".join(names) for names in (self.measured, self.inputs) if names)
        yield Finding("signals", "ok", f"{', '.join(self.hidden)} from {known}, in steps of {self.dt:.3g} s")
        for one in self.judgements:
            verdict, advice = VERDICTS[one.verdict.split()[0]]
            text = f"{one.signal}: {one.verdict}"
            if one.window is not None:
                steps = f"{one.window} step{'s' * (one.window > 1)} ({one.window * self.dt:.3g} s) of y"
                text += f" from {steps if one.window else 'y alone'}"
            if not np.isnan(one.errors[0]):
                errors = [f"{error(each)} at noise {show_level(level)}" for level, each in zip(self.noise, one.errors)]
                text += f"; error {', '.join(errors)}"
            yield Finding("observability", verdict, text, advice)
        for warning in self.warnings:
            text, _, advice = warning.partition("; ")
            yield Finding("data", "note", text, advice)

    def _judged(self, i: int) -> Judgement:
        errors, exact = tuple(self.errors[:, :, i].min(1).tolist()), self.errors[0, :, i]
        changes = self.changes[~np.isnan(self.changes[:, i]), i]
        least, good = errors[0], exact <= max(DETERMINED, AS_GOOD * exact.min())
        if np.isnan(least):
            verdict = "never moves"
        elif least <= DETERMINED:
            verdict = "determined"
        elif len(changes) and changes[-1] <= min(DETERMINED, SEEN * least):
            verdict, good = "up to a constant", self.changes[:, i] <= DETERMINED
        elif least < UNDETERMINED:
            verdict = f"partly ({100 * least:.2g} % left)"
        else:
            verdict = "not determined"
        window = None if verdict[:2] in ("ne", "no") else self.windows[int(good.argmax())]
        return Judgement(self.hidden[i], verdict, window, errors)


def observability(
    env_id: str,
    *,
    measured: Sequence[str | int],
    hidden: Sequence[str | int],
    policy: str | Policy = RANDOM,
    episodes: int | None = None,
    steps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    measurement_noise: Sequence[Level] | None = None,
    seed: int = 0,
    console: Console | ProgressBars | None = None,
) -> Observability:
    """Find which hidden signals of any environment its outputs and actions determine, before an observer is trained.

    Parameters
    ----------
    env_id : str
        As ``gym.make`` takes it.
    measured, hidden : sequence of str or int
        Signals that an observer measures, and those that it estimates, as for :func:`training.learn`.
    policy : str or callable
        Chooses the actions, see :func:`training.rollouts.policy_of`. The result holds where it has been.
    episodes, steps : int, optional
        Length of the play, to whichever is reached first; by default 10,000 steps.
    env_kwargs : mapping of str to object, optional
        Arguments of the environment.
    measurement_noise : sequence of (float or tuple of float), optional
        Standard deviations on each sample of y, of all outputs or each, beside 0; by default 1 % and 10 % of those of
        the outputs.
    seed : int
        Of the rollouts and of the comparison.
    console : rich.console.Console or ProgressBars, optional
        For the progress; by default none is printed.

    Returns
    -------
    Observability
        Errors of the hidden signals; ``judgements`` has verdicts in words.

    Raises
    ------
    ValueError
        If an argument is invalid, or as :func:`training.diagnosis.of_records`.
    """
    if not hidden:
        raise ValueError("name the hidden signals, as in hidden=[2]")
    with progress_bars(console) as progress:
        signals: dict[str, Any] = {"measured": list(map(str, measured)), "hidden": list(map(str, hidden))}
        amount: dict[str, Any] = {"episodes": episodes, "steps": steps, "default_steps": STEPS, "seed": seed}
        rollouts = play(env_id, partial(policy_of, policy), progress, **signals, **amount, env_kwargs=env_kwargs)
    return of_records(rollouts.records(), measurement_noise=measurement_noise, seed=seed)


def of_records(
    records: Sequence[Record], *, measurement_noise: Sequence[Level] | None = None, seed: int = 0
) -> Observability:
    """Find which recorded states the recorded outputs and inputs determine.

    The filter of a training on the records starts at any sample. So many steps later its state z is compared with that
    of similar samples in other records, with noise of the covariance that z then has.
    """
    integer("seed", seed, 0)
    check_signals(records)
    signals = records[0].signals
    if any(record.x is None for record in records):
        raise ValueError("no hidden states were recorded; name their columns (--hidden)")
    config = recorded_preset(records)
    linear = Spectrum(config.eigenvalues, config.pairs).filter(len(signals.measured), config.dt, len(signals.inputs))
    records = [resampled(record, linear.dt) for record in records]
    noise = _levels(records, measurement_noise)
    others, queries = (Windows(part, linear, len(signals.hidden)) for part in split(records, QUERY_SHARE, seed))
    rng, settled = generator(Stream.VALIDATION, seed, 1), settling_time(linear) / linear.dt
    windows = (0, *(2**i for i in range(int(np.ceil(np.log2(settled))) + 1)))
    errors, changes = list[np.ndarray](), list[np.ndarray]()
    for window in windows:
        compared = compare(queries, others, window, noise=noise, rng=rng)
        if compared is None:
            break
        errors.append(compared[0])
        changes.append(np.where(window <= settled / SETTLED, compared[1], np.nan))  # the filter forgets later starts
    if not errors:
        raise ValueError(
            f"{sum(len(record.t) for record in records)} samples in {len(records)} records are too few to judge "
            f"{', '.join(signals.hidden)}: record more"
        )
    warnings = list[str]()
    if len(records) < FEW:
        warnings.append(
            f"there are fewer than {FEW} records: samples are compared with others of the same, and a constant of a "
            "record looks determined; record more"
        )
    if len(errors) < len(windows):
        warnings.append(f"too few samples for windows of {windows[len(errors)]} steps or more; record longer episodes")
    known = (signals.measured, signals.inputs, signals.hidden, linear.dt, windows[: len(errors)], noise)
    return Observability(*known, errors=np.stack(errors, 1), changes=np.stack(changes), warnings=tuple(warnings))


def _levels(records: Sequence[Record], given: Sequence[Level] | None) -> tuple[Level, ...]:
    """No noise, and the given levels or shares of the outputs' standard deviations."""
    y = np.concatenate([record.y for record in records])
    if given is None:
        given = [tuple(float(f"{share * size:.3g}") for size in np.nanstd(y, 0)) for share in NOISE_SHARES]
    elif not isinstance(given, Iterable):
        raise ValueError(f"measurement_noise must be a list of levels, as in [0.1, 0.3], got {shown(given)}")
    levels = [noise_levels("measurement_noise", level, y.shape[1]) for level in given]
    return tuple(dict.fromkeys([0.0, *levels]))


def _samples(windows: Windows, steps: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spread samples with a state now and ``steps`` before, when the filter started.

    Returns filter states (n, size), and states with how much these have changed since (n, 2 nx).
    """
    rows = windows.rows(steps)
    rows = rows[~np.isnan(windows.x[rows - steps]).any(-1)]
    rows = evenly(rows, min(most, len(rows)))
    x = windows.x[rows]
    return windows.restarted(rows, steps), np.hstack([x, x - windows.x[rows - steps]])


def compare(
    queries: Windows, others: Windows, window: int, *, noise: Sequence[Level], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """Errors at each level of noise (k, nx), and without any those of changes (nx,).

    The first level is 0. Returns None where there are too few samples.
    """
    (z, x), (others_z, others_x) = _samples(queries, window, MAX_QUERIES), _samples(others, window, MAX_OTHERS)
    if len(z) < MIN_QUERIES or len(others_z) <= MIN_OTHERS * others_z.shape[1]:
        return None
    errors, covariance = [], noise_covariance(others.linear, np.array([window]))[0]
    for level in noise:
        noisy = bool(np.any(level))
        own = np.einsum("j,jab->ab", np.broadcast_to(np.square(level), len(covariance)), covariance)
        scaled = coordinates(others_z, own if noisy else covariance.sum(0))
        signal = 1 / (1 + scaled.noise_gain**2) if noisy else 1.0  # share of it in each coordinate
        R = root(own).T
        at, others_at = (signal * scaled(each + rng.standard_normal(each.shape) @ R) for each in (z, others_z))
        errors.append(left_by(at, x, others_at, others_x))
    left, changes = np.split(np.array(errors), 2, axis=1)
    return left, changes[0]


def left_by(z: np.ndarray, x: np.ndarray, others_z: np.ndarray, others_x: np.ndarray) -> np.ndarray:
    """Errors (nx,) of x given z, in standard deviations, from samples of both and of others.

    The nearest others of each sample are weighted so that their weighted z is its own: a plane through them. Their
    weighted x is then off by the part of x that z does not determine, of the sample itself and of the others, and by
    the curvature of x between them, which falls with the square of their distance. The first part is divided by 1 + the
    sum of squared weights, as which it counts the variance. With one neighbour of weight 1 that is the Delta test.

    Shapes: ``z`` (n, modes), ``x`` (n, nx), ``others_z``, ``others_x`` (m, ...).
    """
    deviation = np.where(np.ptp(x, 0) > 0, x.std(0), np.nan)
    design = np.column_stack([np.ones(len(others_z)), others_z])
    gram = design.T @ design + ROUNDING * len(design) * np.eye(len(design.T))
    coefficients = np.linalg.solve(gram, design.T @ others_x)
    others_x = others_x - design @ coefficients  # neighbours predict the nonlinear rest
    x = x - np.column_stack([np.ones(len(z)), z]) @ coefficients
    linear: np.ndarray = np.sqrt((x**2).mean(0)) / deviation
    n, modes = z.shape
    if not modes:
        return linear
    k = min(len(others_z), max(MIN_NEIGHBOURS, 2 * (modes + 1)))
    near = cKDTree(others_z).query(z, k=k)[1]
    apart = others_z[near] - z[:, None]
    # The smallest weights with the sum 1 for which neighbours cancel to RESOLUTION.
    weights = np.linalg.solve(apart @ apart.mT + RESOLUTION**2 * modes * np.eye(k), np.ones((n, k, 1)))[..., 0]
    weights /= weights.sum(1, keepdims=True)
    squared = (np.einsum("nk,nkj->nj", weights, others_x[near]) - x) ** 2 / (1 + (weights**2).sum(1))[:, None]
    return np.minimum(np.sqrt(squared.mean(0)) / deviation, linear)
