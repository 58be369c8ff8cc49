"""What a training run will take, before it is started: ``kkl-gym train --dry-run``."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from kkl_gym.system import System
from training.config import Config
from training.pipeline import Result, shares, train
from training.trajectories.record import CHUNK, recording_ages

RUNS = 3  # one to warm up, and two whose difference is timed
FEW = 2  # batches in each stage of the first two
CPU_SECONDS = 8.0  # of each stage of the last: batches take from a millisecond to a second
WARM_UP_TRAJECTORIES = 50
# Arrays that exist at once in the largest stage, as counted in training/pipeline.py: those of states in NumPy and in
# torch, and those of the filter's states.
STATES, TORCH_STATES, FILTER_STATES, TORCH_FILTER_STATES = 3, 3, 5, 2
PROGRAM = 0.5e9  # bytes of Python, torch and one chunk of trajectories


@dataclass(frozen=True)
class Estimate:
    """What a run will take."""

    pairs: int
    parameters: int
    bytes: float
    seconds: dict[str, float]


def estimate(
    system: System,
    config: Config,
    *,
    device: torch.device | None = None,
    report: Callable[[int], object] = lambda done: None,
) -> Estimate:
    """Estimate a run by short ones of the same sizes: a few trajectories and batches."""
    brief = replace(
        config,
        cpu_seconds=None,
        forward_steps=min(FEW, config.forward_steps),
        inverse_steps=min(FEW, config.inverse_steps),
    )
    # What is done for the first time takes longer, on a GPU by seconds.
    _short_run(system, brief, device=device, most=WARM_UP_TRAJECTORIES)
    report(1)
    few = _short_run(system, brief, device=device)
    report(2)
    parts = shares(config, few.artifact.nu)
    more = _short_run(system, replace(config, cpu_seconds=CPU_SECONDS / min(parts.values())), device=device)
    seconds = {"simulating": few.seconds["simulating"] * max(1.0, config.trajectories / CHUNK)}
    for stage in few.losses:
        batches = config.forward_steps if stage == "forward" else config.inverse_steps
        (done, _), (done_later, _) = few.losses[stage][-1], more.losses[stage][-1]
        if done_later > done:
            each = max(0.0, more.seconds[stage] - few.seconds[stage]) / (done_later - done)
        else:
            each = few.seconds[stage] / done
        limit = math.inf if config.cpu_seconds is None else parts[stage] * config.cpu_seconds
        seconds[stage] = min(few.seconds[stage] + (batches - done) * each, limit)
    pairs = config.trajectories * len(recording_ages(max(1, round(config.duration / config.dt)), config.samples))
    size = few.artifact.filter.size
    maps = (few.artifact.inverse, few.artifact.free_inverse, few.artifact.forward)
    return Estimate(
        pairs=pairs,
        parameters=sum(part.size for found in maps if found for part in (*found.mlp.weights, *found.mlp.biases)),
        bytes=PROGRAM
        + pairs * (system.nx * (8 * STATES + 4 * TORCH_STATES) + size * (8 * FILTER_STATES + 4 * TORCH_FILTER_STATES)),
        seconds=seconds,
    )


def _short_run(system: System, config: Config, *, device: torch.device | None, most: int = 0) -> Result:
    """The same on so many trajectories at most, by default as many as are simulated at once."""
    most = most or CHUNK
    short = replace(
        config,
        trajectories=min(most, config.trajectories),
        closed_loop_trajectories=min(most, config.closed_loop_trajectories),
    )
    with TemporaryDirectory() as folder:
        return train(system, short, Path(folder), device=device)
