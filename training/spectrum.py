"""The eigenvalues of A: the filter that they make, and whether T is smooth for them, judged before any training."""

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import LinearFilter
from training.maps.coordinates import settling_time
from training.seeds import Stream, generator
from training.trajectories.motions import filter_states, recording_ages

FASTEST_MODE = 0.5  # bound of |eigenvalue| * dt: a faster mode holds no more than the last samples
SMOOTH = 0.85  # least exponent of a smooth T: differences in z fall as distance^0.85 where neighbours come closer
MOTIONS = 300  # that are followed
ASKING = 40  # of them whose states look for neighbours, among the states of the others
SAMPLES = 160  # states along a motion
FAR = 64  # the nearest neighbour is compared with the one of this rank
FEWEST_STATES = 1000  # from which exponents are taken
FOLLOWED = 300.0  # length of motions in multiples of 1 / rate
FINEST = 0.05  # least sampling interval in multiples of 1 / rate; finer ones only cost time
AT_REST = 1e-6  # part of X's half-width below which the variation of a state no longer counts
SLOWEST, FASTEST = 1 / 6, 8.0  # slow ends of the first and the last interval, in multiples of the rate
STEP = 2**0.5  # from one interval to the next
FORGOTTEN = 30.0  # times 1 / |slow end|, by which a filter has forgotten its start
SPREAD = 4.0  # fast end of an interval over its slow end


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of A for each output."""

    eigenvalues: tuple[float, ...] = ()
    pairs: tuple[tuple[float, float], ...] = ()

    @property
    def poles(self) -> np.ndarray:
        """All eigenvalues, complex, (modes,)."""
        above = [complex(a, w) for a, w in self.pairs]
        return np.array([*map(complex, self.eigenvalues), *above, *np.conj(above)])

    def filter(self, ny: int, dt: float, nu: int = 0) -> LinearFilter:
        """The filter with these modes for each output: real ones, then a block [[a, w], [-w, a]] a pair; B = 1."""
        A = scipy.linalg.block_diag(*self.eigenvalues, *([[a, w], [-w, a]] for a, w in self.pairs))
        return LinearFilter(np.kron(np.eye(ny), A), np.kron(np.eye(ny), np.ones((len(A), 1))), dt, nu)


def evenly_spaced(n: int, slowest: float, fastest: float) -> tuple[float, ...]:
    """Space real eigenvalues evenly in the logarithm."""
    return tuple((-np.geomspace(-slowest, -fastest, n)).tolist())


def papers_spectrum(system: System) -> tuple[float, ...]:
    """2 nx + 1 eigenvalues in [-3, -1.5] (paper, sec. 8), in one over the seconds of the system's pace."""
    return tuple((np.linspace(-1.5, -3.0, 2 * system.nx + 1) / system.pace).tolist())


def check_continuous(system: System) -> None:
    """Raise ValueError if a system is in discrete time, to which the equation of T does not apply."""
    if system.discrete:
        raise ValueError(
            f"{system.name} is in discrete time, and the pipeline 'spinn' solves an equation of continuous time: take "
            "the pipeline 'input-aware'"
        )


def smoothness(system: System, spectra: Iterable[Spectrum], dt: float) -> Iterator[np.ndarray]:
    """For each spectrum, exponents (ny * modes,) of differences in z between neighbouring states of different motions.

    Motions without input are simulated once, half of them from X and half from 1.5 X, and the filters run beside
    them. Those states count at which a filter has forgotten its start to one part in a million. NaN where too few do.
    """
    check_continuous(system)
    rate = system.typical_rate
    step = max(dt, FINEST / rate)
    filters = [spectrum.filter(system.ny, step) for spectrum in spectra]
    times = [2.0 * settling_time(linear) for linear in filters]
    steps = int(np.ceil((FOLLOWED / rate + max(times)) / step))
    ages, rng = recording_ages(steps, SAMPLES), generator(Stream.TUNING, 0)
    x0 = np.concatenate([system.draw_starts(rng, MOTIONS // 2, factor) for factor in (1.0, 1.5)])
    x = simulate(system, rng.permutation(x0), steps, step)
    inside = np.isfinite(x).all(-1)
    x = np.where(inside[..., None], x, x[0])  # states beyond the bounds do not count; h and the filter need numbers
    y, no_input = system.output(x), np.zeros((steps, MOTIONS, 0))
    x, settled = x[ages], [inside[ages] & (ages * step >= time)[:, None] for time in times]
    if max(one.sum() for one in settled) < FEWEST_STATES:
        raise ValueError(
            f"motions of {system.name} leave bounds = {system.bounds} within {min(times):.3g} s, before the filter "
            "of any spectrum has forgotten its start; widen the bounds or shrink X"
        )
    for linear, rows in zip(filters, settled, strict=True):
        yield _exponents(system, x=x, z=filter_states(linear, y, no_input, ages), settled=rows)


def _exponents(system: System, *, x: np.ndarray, z: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """Compare the z (ages, motions, size) of neighbours among the settled states of x (ages, motions, nx)."""
    asking, others = settled[:, :ASKING], settled[:, ASKING:]  # neighbours are of different motions
    low, high = system.box()
    least = AT_REST * (high - low) / 2
    too_few = settled.sum() < FEWEST_STATES or not asking.any() or others.sum() < FAR
    if too_few or (x[settled].std(0) <= least).all():
        return np.full(z.shape[-1], np.nan)
    x = x / np.maximum(x[settled].std(0), least)
    z_scale = z[settled].std(0)
    z = z / np.where(z_scale > 0, z_scale, 1.0)
    distances, rows = scipy.spatial.cKDTree(x[:, ASKING:][others]).query(x[:, :ASKING][asking], k=[1, FAR])
    differences = z[:, ASKING:][others][rows] - z[:, :ASKING][asking][:, None]
    # By the distance to the far neighbour, so that few states far from all others do not outweigh the rest.
    reach = np.maximum(distances[:, 1:], np.finfo(float).tiny)
    closer = np.sqrt(((distances[:, :1] / reach) ** 2).mean(0))
    first, last = np.sqrt(((differences / reach[..., None]) ** 2).mean(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(last > 0, np.log(first / last) / np.log(closer), 1.0)  # of a constant output: 1


def intervals(system: System, dt: float, duration: float = np.inf) -> list[Spectrum]:
    """Spectra to choose from, slow ones first: 2 nx + 1 real eigenvalues for each output, even in the logarithm."""
    rate = system.typical_rate
    fastest = min(FASTEST, FASTEST_MODE / (SPREAD * dt * rate))
    slowest = min(SLOWEST, fastest)
    slow = rate * np.geomspace(slowest, fastest, 1 + round(np.log(fastest / slowest) / np.log(STEP)))
    slow = slow[slow >= min(FORGOTTEN / duration, slow[-1])]
    return [Spectrum(tuple(float(f"{v:.6g}") for v in evenly_spaced(2 * system.nx + 1, -a, -SPREAD * a))) for a in slow]


@functools.cache
def smooth_spectrum(system: System, dt: float, duration: float = np.inf) -> Spectrum:
    """Choose the slowest of the :func:`intervals` for which T is smooth, as slow modes average noise best.

    Where T is smooth for none, the one with the largest exponents is chosen, and of equal ones the fastest.
    """
    spectra, least = intervals(system, dt, duration), list[float]()
    for spectrum, exponents in zip(spectra, smoothness(system, spectra, dt), strict=True):
        least.append(float(np.nan_to_num(exponents, nan=-np.inf).min()))
        if least[-1] >= SMOOTH:
            return spectrum
    return spectra[max(range(len(spectra)), key=lambda i: (least[i], i))]
