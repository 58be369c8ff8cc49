"""Error bars for observers from recorded states."""

import dataclasses
from collections.abc import Sequence

import torch
from rich.console import Console

from observers import Artifact
from observers.checks import integer
from training.maps.spread import with_spread
from training.progress import ProgressBars, progress_bars
from training.recorded.calibrating import factors_along, parted, regions_of, stretches
from training.recorded.config import config_of, signal_rate
from training.recorded.fit import sampler_of
from training.records import Record
from training.seeds import Stream, generator


def learn_recorded_error_bars(
    artifact: Artifact,
    records: Sequence[Record],
    held_out: Sequence[Record] | None = None,
    *,
    steps: int = 4000,
    seed: int = 0,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Artifact:
    """Learn the covariance of an observer's errors from records, of T_inv alone where it tracks.

    A small network is fitted to what T_inv is off by along the records that it was trained on, at every age and level
    of noise. There it errs less than elsewhere. Factors from the records that were held out make up for that, so that
    regions of 90 % hold 90 % of the errors.
    """
    artifact = dataclasses.replace(artifact, flow=None)  # the tracker rests on the error bars that it had
    integer("steps", steps, 1)
    integer("seed", seed, 0)
    config, device = config_of(artifact), device or torch.device("cpu")
    train, others = parted(artifact, records, held_out)
    torch.manual_seed(seed)
    with progress_bars(console) as progress:
        with progress.phase("preparing batches"):
            sampler = sampler_of(config, train, artifact.filter, device, like=artifact.inverse)
            runs = stretches(artifact, others)
        regions = regions_of(artifact, runs, signal_rate(train))
        ages = regions.knots * artifact.filter.dt
        inverse = with_spread(
            artifact.inverse, sampler, artifact.nx, ages=ages, steps=steps, seed=seed, progress=progress, device=device
        )
        learned = dataclasses.replace(artifact, inverse=inverse)
        with progress.phase("calibrating the error bars") as report:
            rng = generator(Stream.CALIBRATION, seed, 10)
            factors = factors_along(learned, runs, regions, rng=rng, report=report)
    assert inverse.spread is not None
    spread = dataclasses.replace(inverse.spread, factors=factors)
    return dataclasses.replace(learned, inverse=dataclasses.replace(inverse, spread=spread))


__all__ = ["learn_recorded_error_bars"]
