"""Covariances of an observer's errors against these errors, on records that it was not trained on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from observers import Artifact
from training.maps.regions import FEWEST, LEVELS, Regions, distances_along, errors_along, level_of
from training.recorded.config import config_of
from training.recorded.preparing import check_plant, file_of, fingerprints, split
from training.recorded.windows import samples_as_old
from training.records import Record, check_dt, check_signals, pieces, resampled

STRETCHES, SAMPLES = 600, 2_000_000  # at most, of stretches and of their samples together
MEMORIES = 2.0  # of the filter's memory, that stretches are long at most


def parted(
    artifact: Artifact, records: Sequence[Record], held_out: Sequence[Record] | None
) -> tuple[list[Record], list[Record]]:
    """Part records as in an observer's training, on its grid."""
    config = config_of(artifact)
    check_signals([*records, *(held_out or ())])
    check_plant(artifact, records[0])
    if held_out is None:
        check_dt(records, config.dt)
        ordered = _as_trained(artifact, records)
        records, held_out = split([resampled(record, config.dt) for record in ordered], config.held_out, config.seed)
    if not held_out:
        raise ValueError(
            "no record was held out from the training, and errors on those that were trained on are too small: train "
            "with a share held out (held_out, --held-out 0.2)"
        )
    return list(records), list(held_out)


def _as_trained(artifact: Artifact, records: Sequence[Record]) -> list[Record]:
    """Records in the order of the training, on which hangs what was held out; ValueError if they are others."""
    there, here = dict(artifact.training.get("records", {})), fingerprints(records)
    for what, names in (
        ("has changed since the training", [name for name in there if here.get(name, there[name]) != there[name]]),
        ("is missing", [name for name in there if name not in here]),
        ("was not there in the training", [name for name in here if name not in there]),
    ):
        if names:
            raise ValueError(
                f"{', '.join(names)} {what}: what was held out from the training of {artifact.system!r}, and only "
                "that, says how large errors are; name the records of the training, all of them and as they were"
            )
    order = list(there)
    return sorted(records, key=lambda record: order.index(file_of(record)))


Found = TypeVar("Found")


@dataclass(frozen=True)
class Stretches:
    """Parts of records side by side, each from a sample at which the filter may be switched on."""

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray

    @property
    def steps(self) -> int:
        """Their length."""
        return len(self.u)


def stretches(artifact: Artifact, records: Sequence[Record]) -> Stretches:
    """Take parts of records that begin all over them."""
    whole, owner, first = _begins(records)
    memory = artifact.inverse.age_max / artifact.filter.dt
    steps = max(2, min(round(MEMORIES * memory), max(len(piece.t) for piece in whole) - 1))
    most = min(STRETCHES, max(2 * FEWEST, SAMPLES // steps))
    if len(owner) > most:
        chosen = np.linspace(0, len(owner) - 1, most).round().astype(int)
        owner, first = owner[chosen], first[chosen]
    rows = first + np.arange(steps + 1)[:, None]
    lengths = np.array([len(piece.t) for piece in whole])[owner]
    begins = np.concatenate([[0], np.cumsum([len(piece.t) for piece in whole])])[owner]
    where = begins + np.minimum(rows, lengths - 1)
    x = np.concatenate([np.asarray(piece.x) for piece in whole])[where]
    x[rows >= lengths] = np.nan
    u = np.zeros((steps, len(first), 0))
    if artifact.nu:
        u = np.concatenate([np.asarray(piece.u) for piece in whole])[where[:-1]]
    return Stretches(x, np.concatenate([piece.y for piece in whole])[where], u)


def require_enough(records: Sequence[Record]) -> None:
    """See that error bars can be calibrated on records."""
    _begins(records)


def _begins(records: Sequence[Record]) -> tuple[list[Record], np.ndarray, np.ndarray]:
    """Records without gaps, and the samples that stretches may begin at, of which of them; ValueError if too few."""
    whole = [piece for piece in pieces(records) if piece.x is not None and len(piece.t) > 2]
    owner = first = np.zeros(0, int)
    if whole:
        owner, first = samples_as_old([piece.part(slice(None, -1)) for piece in whole], 0)
    if len(owner) < FEWEST:
        raise ValueError(
            f"what was held out has {len(owner)} samples with states to begin at, too few to calibrate error bars on "
            f"({FEWEST}): record more, or hold more out"
        )
    return whole, owner, first


def regions_of(artifact: Artifact, runs: Stretches, rate: float) -> Regions:
    """Where along stretches errors are looked at, of signals that change at a rate in 1/s."""
    return Regions.of(artifact, runs.steps * artifact.filter.dt, pace=1 / rate)


def factors_along(
    artifact: Artifact,
    runs: Stretches,
    regions: Regions,
    *,
    rng: np.random.Generator,
    report: Callable[[float], object] | None = None,
) -> np.ndarray:
    """Find factors for an observer's covariances. Shapes: returns (levels, knots)."""
    return regions.factors(_along(distances_along, artifact, runs, regions, rng, report), _known(runs, regions))


def factors_and_doubts_along(
    artifact: Artifact,
    runs: Stretches,
    regions: Regions,
    *,
    rng: np.random.Generator,
    report: Callable[[float], object] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find factors and doubts (levels, knots) for the covariances of an observer that tracks."""
    return regions.factors_and_doubts(_along(errors_along, artifact, runs, regions, rng, report), _known(runs, regions))


def _along(
    look: Callable[..., Found],
    artifact: Artifact,
    runs: Stretches,
    regions: Regions,
    rng: np.random.Generator,
    report: Callable[[float], object] | None,
) -> list[Found]:
    """What a function finds of an observer along runs at each level of noise."""
    found = []
    for done, share in enumerate(LEVELS, 1):
        level = level_of(artifact, share)
        y = runs.y + np.asarray(level) * rng.standard_normal(runs.y.shape)
        found.append(look(artifact, runs.x, y, runs.u, level=level, ages=regions.ages))
        if report is not None:
            report(done / len(LEVELS))
    return found


def _known(runs: Stretches, regions: Regions) -> np.ndarray:
    """Where states are known, (ages, n)."""
    return np.asarray(np.isfinite(runs.x[regions.ages]).all(-1))


__all__ = [
    "Stretches",
    "factors_along",
    "factors_and_doubts_along",
    "parted",
    "regions_of",
    "require_enough",
    "stretches",
]
