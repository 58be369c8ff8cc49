"""How good an observer is on recorded states that it was not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from observers import Artifact, KKLObserver
from training.maps.coordinates import settling_time
from training.records import Record, pieces


@dataclass(frozen=True)
class RecordedErrors:
    """Errors on recorded states, relative to their standard deviations."""

    relative: dict[str, float]
    after: float
    seconds: float

    def __str__(self) -> str:
        """For people, on one line."""
        each = ", ".join(f"{name} {error:.3g}" for name, error in self.relative.items())
        return f"{each} ({self.seconds:.4g} s, after {self.after:.2g} s of transient)"


def recorded_errors(
    artifact: Artifact,
    records: Sequence[Record],
    after: float | None = None,
    *,
    measurement_noise: float | tuple[float, ...] = 0.0,
) -> RecordedErrors:
    """Run an observer along records and compare its estimates with the recorded states."""
    after = settling_time(artifact.filter) if after is None else after
    first = int(np.ceil(after / artifact.filter.dt - 1e-6))  # times are rounded
    apart, x = [np.zeros((0, artifact.nx))], [np.zeros((0, artifact.nx))]
    rng = np.random.default_rng(0)
    for record in pieces(records):
        if record.x is not None:
            y = record.y + np.asarray(measurement_noise) * rng.standard_normal(record.y.shape)
            apart.append((estimates(artifact, replace(record, y=y), measurement_noise) - record.x)[first:])
            x.append(record.x[first:])
    error, truth = np.concatenate(apart), np.concatenate(x)
    known = ~np.isnan(error).any(-1)
    error, truth = error[known], truth[known]
    names = (artifact.signals or {})["hidden"]
    if not len(error):
        return RecordedErrors(dict.fromkeys(names, float("nan")), after, 0.0)
    moves = np.ptp(truth, 0) > 0  # rounding may leave a standard deviation of what stands still
    relative = np.sqrt(np.mean(error**2, 0)) / np.where(moves, truth.std(0), np.nan)
    return RecordedErrors(dict(zip(names, relative.tolist())), after, len(error) * artifact.filter.dt)


def estimates(artifact: Artifact, record: Record, measurement_noise: float | tuple[float, ...] = 0.0) -> np.ndarray:
    """An observer's estimates along a record without gaps on its grid, (n, nx), told a level of noise."""
    return KKLObserver(artifact, measurement_noise).estimate(record.y, record.u if artifact.nu else None)
