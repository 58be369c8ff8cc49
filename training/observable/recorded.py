"""What records with states say of observability: no equations, and nothing is trained."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from observers import LinearFilter
from observers.checks import integer, noise_levels, shown
from training.evaluation.levels import Level
from training.filter_noise import noise_covariance, root
from training.maps.coordinates import coordinates, settling_time, spread
from training.neighbours import Told, told
from training.observable.found import DETERMINED, Observability
from training.recorded.config import recorded_config
from training.recorded.preparing import FEW, filter_of, split
from training.recorded.windows import along, restarted, samples_as_old, taken
from training.records import Record, check_signals, pieces, resampled
from training.seeds import Stream, generator

ASKING, OTHERS = 500, 40_000  # samples at most
ASKING_SHARE = 0.2  # of the records, whose samples look for neighbours among those of the others
FEWEST_ASKING = 50  # samples, for a judgement
FEWEST_OTHERS = 5  # times the coordinates of z
NOISE_SHARES = 0.01, 0.1  # of an output's standard deviation, where no level is named
FALLS = 1.25  # error with half of the samples over that with all, beyond which more would tell more


def of_records(
    records: Sequence[Record],
    *,
    measurement_noise: Sequence[Level] | None = None,
    linear: LinearFilter | None = None,
    seed: int = 0,
    report: Callable[[float], object] = lambda share: None,
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
    linear = linear or filter_of(recorded_config(records), signals)
    records = [resampled(record, linear.dt) for record in records]
    noise = _levels(records, measurement_noise)
    others, asking = (Filtered(pieces(part), linear) for part in split(records, ASKING_SHARE, seed))
    rng = generator(Stream.VALIDATION, seed, 1)
    settled = settling_time(linear) / linear.dt
    last, memory = int(np.ceil(np.log2(settled))), settled / np.log(1e3)  # beyond which it forgets where a window began
    windows, found = [0, *(2**i for i in range(last + 1))], list[_Compared]()
    for done, window in enumerate(windows):
        report(done / len(windows))
        compared = _compared(
            asking.samples(window, ASKING),
            others.samples(window, OTHERS),
            covariance=noise_covariance(linear, np.array([window]))[0],
            noise=noise,
            rng=rng,
        )
        if compared is None:
            break
        found.append(compared if window <= memory else replace(compared, change=np.full_like(compared.half, np.nan)))
    if not found:
        raise ValueError(
            f"{sum(len(record.t) for record in records)} samples in {len(records)} records are too few to say anything "
            f"of {', '.join(signals.hidden)}: record more"
        )
    errors = np.stack([np.stack([one.left for one in each.levels]) for each in found], 1)
    result = Observability(
        signals.measured,
        signals.inputs if linear.nu else (),
        signals.hidden,
        dt=linear.dt,
        windows=tuple(windows[: len(found)]),
        noise=noise,
        errors=errors,
        predicted=errors.min(1),
        changes=np.stack([each.change for each in found]),
        linear=np.stack([each.levels[0].linear for each in found]),
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
class _Compared:
    """What a window tells: at each level of noise, and without any of changes, and to who has half of the samples."""

    levels: list[Told]
    change: np.ndarray
    half: np.ndarray


def _compared(
    asking: Samples, others: Samples, *, covariance: np.ndarray, noise: Sequence[Level], rng: np.random.Generator
) -> _Compared | None:
    """Compare samples at all levels of noise; None where there are too few.

    ``covariance`` (ny, size, size) is that of the noise in z for a standard deviation of 1 on each output.
    """
    if len(asking.z) < FEWEST_ASKING or len(others.z) <= FEWEST_OTHERS * others.z.shape[1]:
        return None
    levels = []
    for level in noise:
        variances = np.broadcast_to(np.square(level), len(covariance))
        own = np.einsum("j,jab->ab", variances, covariance)
        scaled = coordinates(others.z, own if np.any(level) else covariance.sum(0))
        share = 1 / (1 + scaled.noise_gain**2) if np.any(level) else 1.0  # of signal in each coordinate
        R = root(own).T
        z, others_z = (share * scaled(each.z + rng.standard_normal(each.z.shape) @ R) for each in (asking, others))
        if np.any(level):
            levels.append(told(z, asking.x, others_z=others_z, others_x=others.x))
            continue
        of_both = [np.hstack([each.x, each.change]) for each in (asking, others)]
        both = told(z, of_both[0], others_z=others_z, others_x=of_both[1])
        nx = asking.x.shape[1]
        change = both.left[nx:]
        levels.append(Told(both.left[:nx], both.linear[:nx]))
        half = told(z, asking.x, others_z=others_z[::2], others_x=others.x[::2]).left
    return _Compared(levels, change, half)


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
            "before them: record longer episodes, or more"
        )
    for i, name in enumerate(found.hidden):
        exact = found.errors[0, :, i]
        best = int(exact.argmin())
        if exact[best] > DETERMINED and halves[best, i] > FALLS * exact[best]:
            yield (
                f"{name}: {100 * exact[best]:.2g} % are left with these samples, {100 * halves[best, i]:.2g} % with "
                "half of them: with more it will be less"
            )
