"""What outputs and inputs determine of hidden signals, from records or rollouts: nothing is trained."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console
from scipy.spatial import cKDTree

from observers import LinearFilter
from observers.checks import integer, noise_levels, shown
from training.diagnosis.signals import DETERMINED, Observability
from training.evaluation.levels import Level
from training.filter_noise import noise_covariance, root
from training.maps.coordinates import coordinates, settling_time, spread
from training.neighbours import told
from training.progress import ProgressBars, progress_bars
from training.records import Record, check_signals, pieces, resampled
from training.rollouts import Policy, make, policy_of, roll_out
from training.rollouts.playing import RANDOM
from training.seeds import Stream, generator
from training.sources.recorded import FEW, recorded_preset, split
from training.sources.windows import along, restarted, samples_as_old, taken
from training.spectrum import Spectrum

STEPS = 10_000  # played in an environment, by default
ASKING, OTHERS = 500, 40_000  # samples at most
ASKING_SHARE = 0.2  # of the records, whose samples look for neighbours among those of the others
FEWEST_ASKING = 50  # samples, for a judgement
FEWEST_OTHERS = 5  # times the coordinates of z
NOISE_SHARES = 0.01, 0.1  # of an output's standard deviation, where no level is named
FALLS = 1.25  # error with half of the samples over that with all, beyond which more would tell more


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
        What was found; ``judgements`` says it in words.

    Raises
    ------
    ValueError
        If an argument makes no sense, or as :func:`training.diagnosis.of_records`.
    """
    if episodes is None and steps is None:
        steps = STEPS
    if not hidden:
        raise ValueError("say which signals are hidden, as in hidden=[2]")
    with (
        progress_bars(console) as progress,
        make(env_id, env_kwargs) as env,
        progress.phase(f"playing {env_id}", steps or episodes or 1) as report,
    ):
        rollouts = roll_out(
            env,
            policy_of(policy, env),
            measured=list(map(str, measured)),
            hidden=list(map(str, hidden)),
            episodes=episodes,
            steps=steps,
            seed=seed,
            report=report,
        )
    return of_records(rollouts.records(), measurement_noise=measurement_noise, seed=seed)


def of_records(
    records: Sequence[Record], *, measurement_noise: Sequence[Level] | None = None, seed: int = 0
) -> Observability:
    """Find what recorded outputs and inputs tell of recorded states.

    The filter that a training on the records would take is switched on at any sample. So many steps later its state z
    is compared with that of like samples in other records (:mod:`training.neighbours`). Noise is added to z with the
    covariance that it has there, and coordinates of z count as far as they are signal.
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
    others, asking = (Filtered(pieces(part), linear) for part in split(records, ASKING_SHARE, seed))
    rng = generator(Stream.VALIDATION, seed, 1)
    settled = settling_time(linear) / linear.dt
    last, memory = int(np.ceil(np.log2(settled))), settled / np.log(1e3)  # beyond which it forgets where a window began
    windows, found = [0, *(2**i for i in range(last + 1))], list[Compared]()
    for window in windows:
        samples = asking.samples(window, ASKING), others.samples(window, OTHERS)
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


class Filtered:
    """Records with the filter along each."""

    def __init__(self, records: list[Record], linear: LinearFilter) -> None:
        self._linear, self._records = linear, records
        self._z = [along(linear, record) for record in records]

    def samples(self, window: int, most: int) -> "Samples":
        """Filter states after so many steps and the states there, evenly spread over all with one then and before."""
        owner, sample = samples_as_old(self._records, window)
        if len(owner):
            states = [record.x for record in self._records]
            whole = ~np.isnan(taken(states, owner, sample - window)).any(-1)
            owner, sample = owner[whole], sample[whole]
        chosen = np.linspace(0, len(owner) - 1, min(most, len(owner))).round().astype(int)
        owner, sample = owner[chosen], sample[chosen]
        if not len(owner):
            return Samples(*np.zeros((3, 0, 0)))
        x = taken(states, owner, sample)
        z = restarted(self._linear, self._records, self._z, owner=owner, sample=sample, age=window)
        return Samples(z, x, x - taken(states, owner, sample - window))


@dataclass(frozen=True)
class Samples:
    """Filter states (n, size), states (n, nx), and how much these have changed since the filter was switched on."""

    z: np.ndarray
    x: np.ndarray
    change: np.ndarray

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
            levels.append(told(z, asking.x, others_z=others_z, others_x=others.x).left)
            continue
        of_both, of_others = (np.hstack([each.x, each.change]) for each in (asking, others))
        both = told(z, of_both, others_z=others_z, others_x=of_others).left
        left, change = np.split(both, 2)
        levels.append(left)
        half = told(z, asking.x, others_z=others_z[::2], others_x=others.x[::2]).left
    return Compared(levels, change, half)


def _warnings(found: Observability, halves: np.ndarray, *, records: int, windows: Sequence[int]) -> Iterator[str]:
    """What is to be said of the data; ``halves`` (windows, nx) are the errors to who has half of them."""
    if records < FEW:
        yield (
            f"there are fewer than {FEW} records: samples are compared with others of the same, and what is constant "
            "in a record looks as if it were told; record more"
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
