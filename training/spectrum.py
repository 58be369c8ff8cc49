"""The eigenvalues of A: the filter that they define, and a test, before any training, of whether they make T smooth."""

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

FASTEST_MODE = 0.5  # bound of |eigenvalue| * dt: a faster mode remembers only the last samples
SMOOTH = 0.85  # least exponent p of a smooth T: between close states, differences in z fall as distance^p
MOTIONS = 300  # number of simulated motions
ASKING = 40  # number of motions whose states are compared with neighbours on the other motions
SAMPLES = 160  # number of states along a motion
FAR = 64  # rank, by distance, of the far neighbour with which the nearest one is compared
FEWEST_STATES = 1000  # least number of states for an exponent
FOLLOWED = 300.0  # length of motions after the transient, in multiples of 1 / System.typical_rate
FINEST = 0.05  # least sampling interval, in multiples of 1 / System.typical_rate; shorter intervals only cost time
AT_REST = 1e-6  # a state that varies less, in half-widths of X, counts as constant
SLOWEST, FASTEST = 1 / 6, 8.0  # slow ends of the slowest and fastest interval of eigenvalues, in System.typical_rate
STEP = 2**0.5  # ratio of the slow ends of consecutive intervals
FORGOTTEN = 30.0  # a filter has forgotten its start after this multiple of 1 / |slow end|
SPREAD = 4.0  # ratio of an interval's fast end to its slow end


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of A for each output; ``pairs`` of (a, w) stand for a +- iw."""

    eigenvalues: tuple[float, ...] = ()
    pairs: tuple[tuple[float, float], ...] = ()

    @property
    def poles(self) -> np.ndarray:
        """All eigenvalues as complex numbers, (modes,)."""
        above = [complex(a, w) for a, w in self.pairs]
        return np.array([*map(complex, self.eigenvalues), *above, *np.conj(above)])

    def filter(self, ny: int, dt: float, nu: int = 0) -> LinearFilter:
        """Make a filter with these modes for each output: real ones, then [[a, w], [-w, a]] for each pair; B = 1."""
        A = scipy.linalg.block_diag(*self.eigenvalues, *([[a, w], [-w, a]] for a, w in self.pairs))
        return LinearFilter(np.kron(np.eye(ny), A), np.kron(np.eye(ny), np.ones((len(A), 1))), dt, nu)


def evenly_spaced(n: int, slowest: float, fastest: float) -> tuple[float, ...]:
    """Space n real eigenvalues evenly in the logarithm."""
    return tuple((-np.geomspace(-slowest, -fastest, n)).tolist())


def papers_spectrum(system: System) -> tuple[float, ...]:
    """Return 2 nx + 1 eigenvalues, evenly spaced in [-3, -1.5] (paper, sec. 8), divided by the system's pace."""
    return tuple((np.linspace(-1.5, -3.0, 2 * system.nx + 1) / system.pace).tolist())


def check_continuous(system: System) -> None:
    """Raise ValueError if a system is in discrete time, to which the equation of T does not apply."""
    if system.discrete:
        raise ValueError(
            f"{system.name} is in discrete time, and the pipeline 'spinn' solves an equation of continuous time: take "
            "the pipeline 'input-aware'"
        )


def smoothness(system: System, spectra: Iterable[Spectrum], dt: float) -> Iterator[np.ndarray]:
    """Yield for each spectrum the exponents (ny * modes,) of z between neighbouring states, as ``SMOOTH`` defines them.

    Motions without input are simulated once, half of them from X and half from 1.5 X, and all filters run along them.
    A state counts only after a filter's start has decayed to a millionth; exponents are NaN if too few states count.
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
    x = np.where(inside[..., None], x, x[0])  # states out of bounds do not count, but h and the filter need numbers
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
    """Return the exponents of z (ages, motions, size) between neighbouring settled states x (ages, motions, nx)."""
    asking, others = settled[:, :ASKING], settled[:, ASKING:]  # neighbours must lie on different motions
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
    # Differences are divided by the distance of the far neighbour, lest a few isolated states outweigh the rest.
    reach = np.maximum(distances[:, 1:], np.finfo(float).tiny)
    closer = np.sqrt(((distances[:, :1] / reach) ** 2).mean(0))
    first, last = np.sqrt(((differences / reach[..., None]) ** 2).mean(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(last > 0, np.log(first / last) / np.log(closer), 1.0)  # 1 for a constant component of z


def intervals(system: System, dt: float, duration: float = np.inf) -> list[Spectrum]:
    """Return candidate spectra, slow ones first, each of 2 nx + 1 real eigenvalues evenly spaced in the logarithm."""
    rate = system.typical_rate
    fastest = min(FASTEST, FASTEST_MODE / (SPREAD * dt * rate))
    slowest = min(SLOWEST, fastest)
    slow = rate * np.geomspace(slowest, fastest, 1 + round(np.log(fastest / slowest) / np.log(STEP)))
    slow = slow[slow >= min(FORGOTTEN / duration, slow[-1])]
    return [Spectrum(tuple(float(f"{v:.6g}") for v in evenly_spaced(2 * system.nx + 1, -a, -SPREAD * a))) for a in slow]


@functools.cache
def smooth_spectrum(system: System, dt: float, duration: float = np.inf) -> Spectrum:
    """Choose the slowest of the :func:`intervals` with a smooth T, or else the one whose least exponent is largest."""
    spectra, least = intervals(system, dt, duration), list[float]()
    for spectrum, exponents in zip(spectra, smoothness(system, spectra, dt), strict=True):
        least.append(float(np.nan_to_num(exponents, nan=-np.inf).min()))
        if least[-1] >= SMOOTH:
            return spectrum
    return spectra[max(range(len(spectra)), key=lambda i: (least[i], i))]
