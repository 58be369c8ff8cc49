"""Covariances of an observer's errors against these errors, on records that it was not trained on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from observers import Artifact
from training.maps.regions import FEWEST, LEVELS, Regions, distances_along, level_of
from training.recorded.config import config_of
from training.recorded.preparing import split
from training.recorded.windows import samples_as_old
from training.records import Record, check_signals, pieces, resampled

STRETCHES = 600
MEMORIES = 2.0  # of the filter's memory, that stretches are long at most


def parted(
    artifact: Artifact, records: Sequence[Record], held_out: Sequence[Record] | None
) -> tuple[list[Record], list[Record]]:
    """Part records as in an observer's training, on its grid.

    Parameters
    ----------
    artifact : Artifact
        From recorded states.
    records : sequence of Record
        All of them; those that were trained on, and on the grid, if others are given.
    held_out : sequence of Record or None
        Those that were not trained on, if that is known.

    Returns
    -------
    train, held_out : list of Record
        None of them is empty.

    Raises
    ------
    ValueError
        If the records are of other signals or without states, or nothing is held out.
    """
    config = config_of(artifact)
    check_signals([*records, *(held_out or ())])
    signals, names = records[0].signals, artifact.signals or {}
    if records[0].x is None:
        raise ValueError("no hidden states were recorded; name their columns (--hidden)")
    for role in ("measured", "hidden", *(["inputs"] if artifact.nu else [])):
        if (here := getattr(signals, role)) != (there := tuple(names[role])):
            raise ValueError(f"{records[0].name}: {role} are {', '.join(here)}, but the observer's {', '.join(there)}")
    if held_out is None:
        parts = split([resampled(record, config.dt) for record in records], config.held_out, config.seed)
        records, held_out = parts
    if not any(record.x is not None for record in held_out):
        raise ValueError(
            "no record was held out from the training, and errors on those that were trained on are too small: train "
            "with --held-out 0.2"
        )
    return list(records), list(held_out)


@dataclass(frozen=True)
class Stretches:
    """Parts of records side by side, each from a sample at which the filter may be switched on.

    Parameters
    ----------
    x, y, u : ndarray, shapes (steps + 1, n, nx), (steps + 1, n, ny) and (steps, n, nu)
        Behind the end of a record x is NaN, and the others stay.
    """

    x: np.ndarray
    y: np.ndarray
    u: np.ndarray

    @property
    def steps(self) -> int:
        """Their length."""
        return len(self.u)


def stretches(artifact: Artifact, records: Sequence[Record]) -> Stretches:
    """Take parts of records that begin all over them.

    Parameters
    ----------
    artifact : Artifact
        An observer for them.
    records : sequence of Record
        On its grid.

    Returns
    -------
    Stretches
        As long as the filter's memory twice, or as the longest record.

    Raises
    ------
    ValueError
        If there are too few samples to begin at.
    """
    whole = [piece for piece in pieces(records) if piece.x is not None and len(piece.t) > 2]
    owner, first = samples_as_old([piece.part(slice(None, -1)) for piece in whole], 0) if whole else ((), ())
    if len(owner) < FEWEST:
        raise ValueError(
            f"what was held out has {len(owner)} samples to begin at, too few to calibrate error bars on ({FEWEST}): "
            "record more, or hold more out"
        )
    if len(owner) > STRETCHES:
        chosen = np.linspace(0, len(owner) - 1, STRETCHES).round().astype(int)
        owner, first = owner[chosen], first[chosen]
    memory = artifact.inverse.age_max / artifact.filter.dt
    steps = max(2, min(round(MEMORIES * memory), max(len(piece.t) for piece in whole) - 1))
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


def regions_of(artifact: Artifact, runs: Stretches, rate: float) -> Regions:
    """Where along stretches errors are looked at, of signals that change at a rate in 1/s."""
    return Regions.of(artifact, runs.steps * artifact.filter.dt, pace=1 / rate)


def told_apart(
    artifact: Artifact,
    runs: Stretches,
    regions: Regions,
    *,
    rng: np.random.Generator,
    lenient: bool = False,
    report: Callable[[float], object] | None = None,
) -> np.ndarray:
    """Find factors for an observer's covariances.

    Parameters
    ----------
    artifact : Artifact
        The observer, with factors of 1.
    runs : Stretches
        That it was not trained on.
    regions : Regions
        Where they are looked at.
    rng : numpy.random.Generator
        Of the noise that is added to the samples.
    lenient : bool
        As :meth:`training.maps.regions.Regions.factors` takes it.
    report : callable, optional
        Told which share is done.

    Returns
    -------
    ndarray, shape (levels, knots)
        The factors.

    Raises
    ------
    ValueError
        If there are too few errors.
    """
    distances = list[np.ndarray]()
    for done, share in enumerate(LEVELS, 1):
        level = level_of(artifact, share)
        y = runs.y + np.asarray(level) * rng.standard_normal(runs.y.shape)
        distances.append(distances_along(artifact, runs.x, y, runs.u, level=level, ages=regions.ages))
        if report is not None:
            report(done / len(LEVELS))
    return regions.factors(distances, np.isfinite(runs.x[regions.ages]).all(-1), lenient=lenient)


__all__ = ["Stretches", "parted", "regions_of", "stretches", "told_apart"]
