"""What outputs and inputs determine of hidden signals, from records or rollouts: nothing is trained."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from scipy.spatial import cKDTree

from observers.checks import integer, noise_levels, shown
from training.diagnosis.finding import RESOLUTION, Finding, Verdict, error
from training.evaluation.levels import Level, show_level
from training.maps.coordinates import SETTLED, coordinates, noise_covariance, root, settling_time, spread
from training.progress import ProgressBars, progress_bars
from training.records import Record, check_signals, resampled
from training.records.record import Windows
from training.rollouts import Policy, play, policy_of
from training.rollouts.playing import RANDOM
from training.seeds import Stream, generator
from training.sources.recorded import FEW, evenly, recorded_preset, split
from training.spectrum import Spectrum

STEPS = 10_000  # played in an environment, by default
ASKING, OTHERS = 500, 40_000  # samples at most
ASKING_SHARE = 0.2  # of the records, whose samples look for neighbours among those of the others
FEWEST_ASKING = 50  # samples, for a judgement
FEWEST_OTHERS = 5  # times the coordinates of z
NOISE_SHARES = 0.01, 0.1  # of an output's standard deviation, where no level is named
FALLS = 1.25  # error with half of the samples over that with all, beyond which more would tell more
NEIGHBOURS = 32  # at least, or twice as many as z has coordinates, so that planes rest on enough of them
ROUNDING = 1e-9  # of z, in a linear regression
DETERMINED, UNDETERMINED = 0.05, 0.8  # of a signal's standard deviation: largest and least errors of these verdicts
AS_GOOD = 1.1  # times the least error, up to which a window is as good as any
SEEN = 0.1  # largest error of a signal's change, in the signal's own error, for it to be known up to a constant

# By the first word of a signal's verdict.
VERDICTS: dict[str, tuple[Verdict, str]] = {
    "determined": ("ok", ""),
    "up": ("note", "an observer follows it from a known start; measure a signal that depends on its value, too"),
    "partly": ("note", "measure one more signal that depends on it, or live with what is left"),
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
    """What outputs and inputs determine of hidden signals.

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
        That the best estimate leaves after so many steps.
    changes : ndarray, shape (m, nx)
        That it leaves of how much a signal has changed over the window, in standard deviations of that change, without
        noise; NaN where nothing has, and over windows of which the filter forgets where they began.
    warnings : tuple of str
        What the data are too few for.
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
        """The same as lines of a check."""
        known = " and ".join(", ".join(names) for names in (self.measured, self.inputs) if names)
        yield Finding("signals", "ok", f"{', '.join(self.hidden)} from {known}, in steps of {self.dt:.3g} s")
        for one in self.judgements:
            verdict, advice = VERDICTS[one.verdict.split()[0]]
            text = f"{one.signal}: {one.verdict}{self._since(one.window)}"
            if not np.isnan(one.errors[0]):
                left = [f"{error(each)} at noise {show_level(level)}" for level, each in zip(self.noise, one.errors)]
                text += f"; error {', '.join(left)}"
            yield Finding("observability", verdict, text, advice)
        for warning in self.warnings:
            found, _, advice = warning.partition("; ")
            yield Finding("data", "note", found, advice)

    def csv(self) -> str:
        """Errors by signal, level of noise and window, as the text of a file."""
        lines = ["signal,measurement_noise,steps,seconds,error"]
        for (k, m, i), left in np.ndenumerate(self.errors):
            level, window = show_level(self.noise[k]).replace(", ", " "), self.windows[m]
            lines.append(f"{self.hidden[i]},{level},{window},{window * self.dt:.6g},{left:.6g}")
        return "\n".join(lines) + "\n"

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

    def _since(self, window: int | None) -> str:
        if window is None:
            return ""
        steps = f"{window} step{'s' * (window > 1)} ({window * self.dt:.3g} s)"
        return f" from {steps} of y" if window else " from y alone"


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
        What an observer would see, and what it would estimate, as for :func:`training.learn`.
    policy : str or callable
        Who acts, see :func:`training.rollouts.policy_of`. What is found holds where it has been.
    episodes, steps : int, optional
        How much is played, to whichever is reached first; by default 10,000 steps.
    env_kwargs : mapping of str to object, optional
        Arguments of the environment.
    measurement_noise : sequence of (float or tuple of float), optional
        Standard deviations on each sample of y, of all outputs or each, beside 0; by default 1 % and 10 % of those of
        the outputs.
    seed : int
        Of the rollouts and of the comparison.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default nowhere.

    Returns
    -------
    Observability
        What was found; ``judgements`` has it in words.

    Raises
    ------
    ValueError
        If an argument makes no sense, or as :func:`training.diagnosis.of_records`.
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
    """Find what recorded outputs and inputs tell of recorded states.

    The filter that a training on the records would take is switched on at any sample. So many steps later its state z
    is compared with that of like samples in other records. Noise is added to z with the covariance that it has there,
    and coordinates of z count as far as they are signal.
    """
    integer("seed", seed, 0)
    check_signals(records)
    signals = records[0].signals
    if any(record.x is None for record in records):
        raise ValueError("no hidden states were recorded; name their columns (--hidden)")
    config = recorded_preset(records)
    spectrum = Spectrum(config.eigenvalues, config.pairs)
    linear = spectrum.filter(len(signals.measured), config.dt, len(signals.inputs))
    records = [resampled(record, linear.dt) for record in records]
    noise = _levels(records, measurement_noise)
    others, asking = (Windows(part, linear, len(signals.hidden)) for part in split(records, ASKING_SHARE, seed))
    rng = generator(Stream.VALIDATION, seed, 1)
    settled = settling_time(linear) / linear.dt
    last, memory = int(np.ceil(np.log2(settled))), settled / SETTLED  # beyond which it forgets where a window began
    windows, found = [0, *(2**i for i in range(last + 1))], list[Compared]()
    for window in windows:
        samples = Samples.of(asking, window, ASKING), Samples.of(others, window, OTHERS)
        compared = compare(*samples, covariance=noise_covariance(linear, np.array([window]))[0], noise=noise, rng=rng)
        if compared is None:
            break
        found.append(compared if window <= memory else replace(compared, change=np.full_like(compared.half, np.nan)))
    if not found:
        raise ValueError(
            f"{sum(len(record.t) for record in records)} samples in {len(records)} records are too few to say anything "
            f"of {', '.join(signals.hidden)}: record more"
        )
    result = Observability(
        signals.measured,
        signals.inputs if linear.nu else (),
        signals.hidden,
        dt=linear.dt,
        windows=tuple(windows[: len(found)]),
        noise=noise,
        errors=np.stack([np.stack(each.levels) for each in found], 1),
        changes=np.stack([each.change for each in found]),
    )
    halves = np.stack([each.half for each in found])
    return replace(result, warnings=tuple(_warnings(result, halves, records=len(records), windows=windows)))


def _levels(records: Sequence[Record], given: Sequence[Level] | None) -> tuple[Level, ...]:
    """No noise, and the levels that are asked for."""
    y = np.concatenate([record.y for record in records])
    if given is None:
        given = [tuple(float(f"{share * size:.3g}") for size in np.nanstd(y, 0)) for share in NOISE_SHARES]
    elif not isinstance(given, Sequence) or isinstance(given, str):
        raise ValueError(f"measurement_noise must be a list of levels, as in [0.1, 0.3], got {shown(given)}")
    levels = [noise_levels("measurement_noise", level, y.shape[1]) for level in given]
    return tuple(dict.fromkeys([0.0, *levels]))


def _warnings(found: Observability, halves: np.ndarray, *, records: int, windows: Sequence[int]) -> Iterator[str]:
    """Warnings of too few data; ``halves`` (windows, nx) are the errors with half of the samples."""
    if records < FEW:
        yield (
            f"there are fewer than {FEW} records: samples are compared with others of the same, and what is constant "
            "in a record looks as if it were determined; record more"
        )
    if len(found.windows) < len(windows):
        yield (
            f"windows of {windows[len(found.windows)]} steps and more are left out, as too few samples have so many "
            "before them; record longer episodes, or more"
        )
    for i, name in enumerate(found.hidden):
        exact = found.errors[0, :, i]
        best = int(exact.argmin())
        if exact[best] > DETERMINED and halves[best, i] > FALLS * exact[best]:
            yield (
                f"{name}: {100 * exact[best]:.2g} % are left with these samples, {100 * halves[best, i]:.2g} % with "
                "half of them; record more, with which it will be less"
            )


@dataclass(frozen=True)
class Samples:
    """Filter states (n, size), states (n, nx), and how much these have changed since the filter was switched on."""

    z: np.ndarray
    x: np.ndarray
    change: np.ndarray

    @classmethod
    def of(cls, windows: Windows, steps: int, most: int) -> "Samples":
        """Samples so many steps after a start of the filter, evenly spread over all with a state then and before."""
        rows = windows.rows(steps)
        rows = rows[~np.isnan(windows.x[rows - steps]).any(-1)]
        rows = evenly(rows, min(most, len(rows)))
        return cls(windows.restarted(rows, steps), windows.x[rows], windows.x[rows] - windows.x[rows - steps])

    def nearest(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of these (n,) come closest to other filter states (n, size), and how close, in standard deviations."""
        offset, scale = self.z.mean(0), spread(self.z)
        distances, near = cKDTree((self.z - offset) / scale).query((z - offset) / scale)
        return near, distances


@dataclass(frozen=True)
class Compared:
    """Errors by level of noise, and without any those of changes, and those with half of the samples."""

    levels: list[np.ndarray]
    change: np.ndarray
    half: np.ndarray


def compare(
    asking: Samples, others: Samples, *, covariance: np.ndarray, noise: Sequence[Level], rng: np.random.Generator
) -> Compared | None:
    """Compare samples at all levels of noise, with its ``covariance`` in z; None where there are too few samples."""
    if len(asking.z) < FEWEST_ASKING or len(others.z) <= FEWEST_OTHERS * others.z.shape[1]:
        return None
    levels = []
    for level in noise:
        own = np.einsum("j,jab->ab", np.broadcast_to(np.square(level), len(covariance)), covariance)
        scaled = coordinates(others.z, own if np.any(level) else covariance.sum(0))
        share = 1 / (1 + scaled.noise_gain**2) if np.any(level) else 1.0  # of signal in each coordinate
        R = root(own).T
        z, others_z = (share * scaled(each.z + rng.standard_normal(each.z.shape) @ R) for each in (asking, others))
        if np.any(level):
            levels.append(left_by(z, asking.x, others_z, others.x))
            continue
        of_both, of_others = (np.hstack([each.x, each.change]) for each in (asking, others))
        left, change = np.split(left_by(z, of_both, others_z, of_others), 2)
        levels.append(left)
        half = left_by(z, asking.x, others_z[::2], others.x[::2])
    return Compared(levels, change, half)


def left_by(z: np.ndarray, x: np.ndarray, others_z: np.ndarray, others_x: np.ndarray) -> np.ndarray:
    """Errors (nx,) that z leaves of x, in standard deviations, from samples of both and of others.

    The nearest others of each sample are weighed so that their z, weighted, is its own: a plane through them. Their x,
    weighted, is then off by what z does not determine, of the sample itself and of the others, and by how far x bends
    between them, which falls with the square of their distance. The first part is divided by 1 + the sum of squared
    weights, as which it counts the variance; it is left where neighbours come as close as one likes. With one neighbour
    of weight 1 that is the Delta test.

    Shapes: ``z`` (n, modes), ``x`` (n, nx), ``others_z``, ``others_x`` (m, ...).
    """
    deviation = np.where(np.ptp(x, 0) > 0, x.std(0), np.nan)
    design = np.column_stack([np.ones(len(others_z)), others_z])
    gram = design.T @ design + ROUNDING * len(design) * np.eye(len(design.T))
    coefficients = np.linalg.solve(gram, design.T @ others_x)
    others_x = others_x - design @ coefficients  # only what is bent need be found from neighbours
    x = x - np.column_stack([np.ones(len(z)), z]) @ coefficients
    linear: np.ndarray = np.sqrt((x**2).mean(0)) / deviation
    n, modes = z.shape
    if not modes:
        return linear
    k = min(len(others_z), max(NEIGHBOURS, 2 * (modes + 1)))
    near = cKDTree(others_z).query(z, k=k)[1]
    apart = others_z[near] - z[:, None]
    # The smallest weights with the sum 1 for which neighbours cancel to RESOLUTION.
    weights = np.linalg.solve(apart @ apart.mT + RESOLUTION**2 * modes * np.eye(k), np.ones((n, k, 1)))[..., 0]
    weights /= weights.sum(1, keepdims=True)
    squared = (np.einsum("nk,nkj->nj", weights, others_x[near]) - x) ** 2 / (1 + (weights**2).sum(1))[:, None]
    return np.minimum(np.sqrt(squared.mean(0)) / deviation, linear)
