"""Which hidden signals the outputs and inputs determine, from records or rollouts, without a training."""

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

STEPS = 10_000  # number of steps played in an environment by default
MAX_QUERIES, MAX_OTHERS = 500, 40_000  # largest numbers of samples to predict, and of their possible neighbours
QUERY_SHARE = 0.2  # share of the records (of each record, if fewer than FEW) to predict; neighbours are in the rest
MIN_QUERIES = 50  # least number of samples to predict
MIN_OTHERS = 5  # for each coordinate of z there must be more possible neighbours than this
NOISE_SHARES = 0.01, 0.1  # default noise levels, in standard deviations of the output
MIN_NEIGHBOURS = 32  # least number of neighbours; a z of many coordinates needs more, to determine a plane
ROUNDING = 1e-9  # ridge of the linear regression on z, about the relative rounding error of z
# Largest error of a determined signal and least error of an undetermined one, in the signal's standard deviations.
DETERMINED, UNDETERMINED = 0.05, 0.8
AS_GOOD = 1.1  # a window whose error is at most this multiple of the least error is as good as the best
# A signal is known up to a constant if the error of its changes is <= DETERMINED and <= SEEN times the signal's error.
SEEN = 0.1

# Severity and advice by the first word of the verdict on a signal.
VERDICTS: dict[str, tuple[Verdict, str]] = {
    "determined": ("ok", ""),
    "up": ("note", "an observer follows it from a known start; measure a signal that depends on its value, too"),
    "partly": ("note", "measure one more signal that depends on it, or accept the remaining error"),
    "not": ("problem", "measure a signal that depends on it, or leave it out"),
    "never": ("note", "leave it out"),
}


@dataclass(frozen=True)
class Judgement:
    """The verdict on one hidden signal, its shortest good window in steps, if any, and its errors by noise level."""

    signal: str
    verdict: str
    window: int | None
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Observability:
    """Which hidden signals the outputs and inputs determine.

    Errors are root mean squares in standard deviations of the signals.

    Parameters
    ----------
    measured, inputs, hidden : tuple of str
        Names of the signals.
    dt : float
        Sampling interval in seconds.
    windows : tuple of int, length m
        Numbers of past steps of which outputs and inputs are known; with 0, only the present output is known.
    noise : tuple of (float or tuple of float), length k
        Levels of measurement noise; the first is 0.
    errors : ndarray, shape (k, m, nx)
        Errors of the best estimates by noise level and window.
    changes : ndarray, shape (m, nx)
        Errors of the best estimates of each signal's change over the window, without noise, in standard deviations of
        that change; NaN for signals that do not change, and for windows longer than the filter's slowest time constant.
    warnings : tuple of str
        Reports of results for which there are too few data.
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
        """Yield the results as lines of a diagnosis."""
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
                text += f"; error {'; '.join(errors)}"
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
    """Find which hidden signals of an environment its outputs and actions determine, before any training.

    Parameters
    ----------
    env_id : str
        Id of the environment, as for ``gym.make``.
    measured, hidden : sequence of str or int
        Signals that an observer measures, and those that it estimates, as for :func:`training.learn`.
    policy : str or callable
        The policy that acts, as for :func:`training.learn`. The result holds for the states that the policy visits.
    episodes, steps : int, optional
        Largest numbers of episodes and of steps to play; by default 10,000 steps.
    env_kwargs : mapping of str to object, optional
        Arguments of the environment.
    measurement_noise : sequence of (float or tuple of float), optional
        Standard deviations of the noise on y, in addition to 0; each is one number, or a tuple with a number for each
        output. By default 1 % and 10 % of the outputs' standard deviations.
    seed : int
        Seed of the rollouts and of the comparison.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default nowhere.

    Returns
    -------
    Observability
        Errors of the hidden signals; ``judgements`` has verdicts in words.

    Raises
    ------
    ValueError
        If an argument is invalid, or the rollouts are too short to judge the signals.
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

    For a window of k steps, the KKL filter that a training on these records would use starts k steps before a sample.
    At each noise level, x at the sample is then predicted from x at other samples with similar noisy z.
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
        # After the filter's slowest time constant, z has lost most of its start.
        remembered = window <= settled / SETTLED
        changes.append(np.where(remembered, compared[1], np.nan))
    if not errors:
        total = sum(len(record.t) for record in records)
        raise ValueError(f"{total} samples are too few to judge {', '.join(signals.hidden)}: record more")
    warnings = list[str]()
    if len(records) < FEW:
        text = "as samples are compared within records, a signal that is constant in each looks determined; record more"
        warnings.append(f"there are fewer than {FEW} records: {text}")
    if len(errors) < len(windows):
        warnings.append(f"too few samples for windows of {windows[len(errors)]} steps or more; record longer episodes")
    known = (signals.measured, signals.inputs, signals.hidden, linear.dt, windows[: len(errors)], noise)
    return Observability(*known, errors=np.stack(errors, 1), changes=np.stack(changes), warnings=tuple(warnings))


def _levels(records: Sequence[Record], given: Sequence[Level] | None) -> tuple[Level, ...]:
    """Return level 0 and the given levels, which by default are shares of the outputs' standard deviations."""
    y = np.concatenate([record.y for record in records])
    if given is None:
        given = [tuple(float(f"{share * size:.3g}") for size in np.nanstd(y, 0)) for share in NOISE_SHARES]
    elif not isinstance(given, Iterable):
        raise ValueError(f"measurement_noise must be a list of levels, as in [0.1, 0.3], got {shown(given)}")
    levels = [noise_levels("measurement_noise", level, y.shape[1]) for level in given]
    return tuple(dict.fromkeys([0.0, *levels]))


def _samples(windows: Windows, steps: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return, at evenly spread samples, z (n, size) of filters begun ``steps`` earlier, and x with its change since."""
    rows = windows.rows(steps)
    rows = rows[~np.isnan(windows.x[rows - steps]).any(-1)]
    rows = evenly(rows, min(most, len(rows)))
    x = windows.x[rows]
    return windows.restarted(rows, steps), np.hstack([x, x - windows.x[rows - steps]])


def compare(
    queries: Windows, others: Windows, window: int, *, noise: Sequence[Level], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return errors (k, nx) by noise level and errors (nx,) of changes without noise, or None for too few samples."""
    (z, x), (others_z, others_x) = _samples(queries, window, MAX_QUERIES), _samples(others, window, MAX_OTHERS)
    if len(z) < MIN_QUERIES or len(others_z) <= MIN_OTHERS * others_z.shape[1]:
        return None
    errors, covariance = [], noise_covariance(others.linear, np.array([window]))[0]
    for level in noise:
        noisy = bool(np.any(level))
        own = np.einsum("j,jab->ab", np.broadcast_to(np.square(level), len(covariance)), covariance)
        scaled = coordinates(others_z, own if noisy else covariance.sum(0))
        signal = 1 / (1 + scaled.noise_gain**2) if noisy else 1.0  # share of the signal in each coordinate's variance
        R = root(own).T
        at, others_at = (signal * scaled(each + rng.standard_normal(each.shape) @ R) for each in (z, others_z))
        errors.append(left_by(at, x, others_at, others_x))
    left, changes = np.split(np.array(errors), 2, axis=1)
    return left, changes[0]


def left_by(z: np.ndarray, x: np.ndarray, others_z: np.ndarray, others_x: np.ndarray) -> np.ndarray:
    """Return the errors (nx,) of x given z, in standard deviations, by comparing samples with others of similar z.

    Weights are chosen so that the weighted mean of the neighbours' z is the sample's z. The weighted mean of their x
    misses the sample's x for two reasons. First, z may not determine x; the variance of this error is the sought
    variance times (1 + the sum of squared weights), and is divided by this factor. Second, x may not be linear in z;
    this error falls with the square of the distance. One neighbour of weight 1 would make the method the Delta test.

    Shapes: ``z`` (n, modes), ``x`` (n, nx), ``others_z``, ``others_x`` (m, ...).
    """
    deviation = np.where(np.ptp(x, 0) > 0, x.std(0), np.nan)
    design = np.column_stack([np.ones(len(others_z)), others_z])
    gram = design.T @ design + ROUNDING * len(design) * np.eye(len(design.T))
    coefficients = np.linalg.solve(gram, design.T @ others_x)
    # Neighbours predict only the rest that the linear regression leaves.
    others_x = others_x - design @ coefficients
    x = x - np.column_stack([np.ones(len(z)), z]) @ coefficients
    linear: np.ndarray = np.sqrt((x**2).mean(0)) / deviation
    n, modes = z.shape
    if not modes:
        return linear
    k = min(len(others_z), max(MIN_NEIGHBOURS, 2 * (modes + 1)))
    near = cKDTree(others_z).query(z, k=k)[1]
    apart = others_z[near] - z[:, None]
    # These are the smallest weights of sum 1 under which the deviations ``apart`` cancel up to RESOLUTION.
    weights = np.linalg.solve(apart @ apart.mT + RESOLUTION**2 * modes * np.eye(k), np.ones((n, k, 1)))[..., 0]
    weights /= weights.sum(1, keepdims=True)
    squared = (np.einsum("nk,nkj->nj", weights, others_x[near]) - x) ** 2 / (1 + (weights**2).sum(1))[:, None]
    return np.minimum(np.sqrt(squared.mean(0)) / deviation, linear)
