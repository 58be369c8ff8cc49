"""What the outputs of a system tell of its states: near each by its equations, and everywhere by its motions."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from kkl_gym.system import System
from observers.checks import noise_levels
from training.checking.observability import untold
from training.checking.subject import Subject
from training.evaluation.levels import Level
from training.observable.found import Observability
from training.observable.recorded import ASKING, ASKING_SHARE, OTHERS, Filtered, of_records
from training.presets import eigenvalues
from training.recorded.preparing import split
from training.records import Record, Signals
from training.spectrum import Spectrum
from training.tuning.probe import Probe

MOTIONS = 60  # that are followed
LOCALLY, GLOBALLY = (
    0.1,
    0.3,
)  # errors, up to which the equations say that y tells a state, and from which motions deny it
FAR, OFTEN = 1.0, 0.1  # standard deviations between states of like outputs, and how often they are so far apart


def of_system(
    system: System,
    *,
    dt: float | None = None,
    duration: float | None = None,
    measurement_noise: Sequence[Level] | None = None,
    seed: int = 0,
    report: Callable[[float], object] = lambda share: None,
) -> Observability:
    """Find what the outputs of a system tell of its states in motion without input.

    Errors follow from the equations, to first order near each motion (:class:`training.tuning.Probe`), for the filter
    that an input-aware training takes by default. Whether states that are far apart have the same outputs they do not
    say. So motions from X are compared as records are, too (:func:`training.observable.of_records`): windows are from
    there, and errors of states of which that is so.
    """
    dt = system.dt if dt is None else dt
    duration = system.duration if duration is None else duration
    if measurement_noise is None:
        measurement_noise = [system.measurement_noise]
    levels = [noise_levels("measurement_noise", level, system.ny) for level in measurement_noise]
    probe = Probe(system, dt, duration, motions=MOTIONS, seed=seed)
    spectrum = Spectrum(eigenvalues(system, dt))
    linear = spectrum.filter(system.ny, dt)
    report(0.2)
    signals = Signals("t", tuple(f"y{i + 1}" for i in range(system.ny)), (), tuple(system.state_names))
    t = dt * np.arange(len(probe.x))
    records = [
        Record(f"motion {i + 1}", t, y, x=x, signals=signals)
        for i, (y, x) in enumerate(zip(np.moveaxis(probe.y, 1, 0), np.moveaxis(probe.x, 1, 0)))
    ]
    found = of_records(
        records, measurement_noise=[], linear=linear, seed=seed, report=lambda share: report(0.2 + 0.8 * share)
    )
    noise = tuple(dict.fromkeys([0.0, *levels]))
    size = probe.x.std((0, 1))
    predicted = np.array([probe.error_of_states(spectrum, level) / size for level in noise])
    least = [
        probe.error_of_states(None, level) / size if np.min(level) else np.full(system.nx, np.nan) for level in noise
    ]
    unknown = [finding.found for finding in untold(Subject(system, dt, duration), probe).values()]
    torn = (predicted[0] <= LOCALLY) & (found.predicted[0] >= GLOBALLY)
    folded = list[str]()
    if torn.any():
        others, asking = (Filtered(part, linear) for part in split(records, ASKING_SHARE, seed))
        folded += _folded(found, torn, others=others, asking=asking)
    return replace(
        found,
        noise=noise,
        predicted=np.where(torn, np.maximum(predicted, found.predicted), predicted),
        least=np.array(least),
        warnings=(*folded, *unknown, *found.warnings),
    )


def _folded(found: Observability, torn: np.ndarray, *, others: Filtered, asking: Filtered) -> Iterator[str]:
    """Of states that y tells near each state, but not everywhere: two states of like outputs, if there are."""
    window = found.windows[-1]
    one, other = asking.samples(window, ASKING), others.samples(window, OTHERS)
    near, distances = other.nearest(one.z)
    apart = abs(other.x[near] - one.x) / one.x.std(0)
    far = (apart > FAR)[:, torn].any(1)
    if far.mean() < OFTEN:
        return
    pair = int(np.where(far, distances, np.inf).argmin())
    names = ", ".join(name for name, here in zip(found.hidden, torn) if here)
    states = " and ".join(f"({', '.join(f'{value:.3g}' for value in x)})" for x in (one.x[pair], other.x[near[pair]]))
    yield (
        f"{names}: y tells them near each state, but not which of several states it is: {states} had nearly the same y "
        f"for {window} steps. That is so of a symmetry; measure what it changes, or estimate what it leaves as it is"
    )
