"""From records with states to an artifact: the stages of ``kkl-gym train --data``, in :func:`train_recorded`."""

import dataclasses
import hashlib
import json
import math
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

import kkl_gym
from observers import Artifact, InverseMap, LinearFilter
from training.filter_noise import stationary_covariance
from training.jobs import claimed_run
from training.maps.coordinates import settling_time
from training.maps.inverse import InverseProblem
from training.maps.networks import Network, averaged
from training.maps.optimise import Log, Stage, log_to, optimise
from training.maps.samplers import TrajectorySampler
from training.progress import LOG, ProgressBars, progress_bars
from training.recorded.config import RecordedConfig
from training.recorded.errors import RecordedErrors, recorded_errors
from training.recorded.preparing import filter_of, fingerprints, split
from training.recorded.windows import windows
from training.records import Record, check_memory, pieces, resampled
from training.trajectories.record import recording_ages


@dataclass(frozen=True)
class Recorded:
    """What a training on recorded states leaves behind."""

    artifact: Artifact
    losses: dict[str, list[tuple[int, float]]]
    held_out: list[Record]
    errors: RecordedErrors


def train_recorded(
    records: Sequence[Record],
    config: RecordedConfig,
    folder: Path,
    *,
    name: str,
    resume: bool = False,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Recorded:
    """Learn an observer from recorded states, where nobody knows the equations.

    1. The records are resampled to one dt, and some of them, or of each, are held out.
    2. The filter runs along them. Any sample may be its start: states are paired with what it holds at every age.
    3. Networks are fitted to these pairs, with noise of every level added to z, as for simulated ones. Their mean is
       T_inv.
    """
    if not records or any(record.x is None for record in records):
        raise ValueError("no hidden states were recorded; name their columns (--hidden), or give equations to simulate")
    device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")
    identity = {"name": name, "records": [record.fingerprint for record in records], **dataclasses.asdict(config)}
    with claimed_run(folder, identity, resume), log_to(folder) as log, progress_bars(console, folder / LOG) as progress:
        began = time.monotonic()
        torch.manual_seed(config.seed)
        signals = records[0].signals
        if unknown := [name for name in config.arbitrary_zero if name not in signals.measured]:
            raise ValueError(
                f"arbitrary_zero names {', '.join(map(repr, unknown))}; measured are {', '.join(signals.measured)}"
            )
        linear = filter_of(config, signals)
        check_memory(records, settling_time(linear), lambda text: progress.say(f"warning: {text}"))
        with progress.phase("preparing batches"):
            kept, held_out = split([resampled(record, config.dt) for record in records], config.held_out, config.seed)
            sampler = sampler_of(config, kept, linear, device)
        run = _Run(config, sampler, folder, resume, device, progress, log, identity)
        networks = [run.member(i, len(signals.hidden)) for i in range(config.members)]
        inverse = sampler.inverse_map(networks[0], linear)
        artifact = Artifact(
            filter=linear,
            inverse=inverse if len(networks) == 1 else dataclasses.replace(inverse, mlp=averaged(networks)),
            system=name,
            parameters={},
            measurement_noise=0.0,
            training={
                "pipeline": "recorded",
                **dataclasses.asdict(config),
                "records": fingerprints(records),
                "seconds": round(time.monotonic() - began),
                "device": device.type,
                "threads": torch.get_num_threads(),
                "resumed": resume,
            },
            versions={
                "kkl-gym": kkl_gym.__version__,
                "python": platform.python_version(),
                "torch": torch.__version__,
                "numpy": np.__version__,
            },
            signals={
                "measured": signals.measured,
                "inputs": signals.inputs if config.inputs else (),
                "hidden": signals.hidden,
            },
            environment=records[0].environment,
        )
        found = recorded_errors(artifact, held_out)
    known = {signal: error for signal, error in found.relative.items() if math.isfinite(error)}  # as JSON can hold it
    training = {**artifact.training, "held_out_errors": known, "held_out_after": found.after}
    artifact = dataclasses.replace(artifact, training=training)
    return Recorded(artifact, run.losses, held_out, found)


def sampler_of(
    config: RecordedConfig,
    records: Sequence[Record],
    linear: LinearFilter,
    device: torch.device,
    like: InverseMap | None = None,
) -> TrajectorySampler:
    """Make what draws batches of recorded states and filter states, with noise added to that of the records."""
    ages = recording_ages(math.ceil(settling_time(linear) / config.dt), config.samples)
    measured = records[0].signals.measured
    untold = config.untold_noise * np.broadcast_to(np.asarray(config.measurement_noise_max), linear.B.shape[1])
    return TrajectorySampler(
        windows(pieces(records), linear, ages=ages, n=config.windows),
        linear,
        measurement_noise_max=config.measurement_noise_max,
        batch=config.batch,
        device=device,
        measurement_noise=0.0,
        noise_free_share=config.noise_free_share,
        high_noise_emphasis=config.high_noise_emphasis,
        error=np.einsum("j,jab->ab", untold**2, stationary_covariance(linear)) if config.untold_noise else None,
        scaling="range",  # errors count by their own size, not the state's
        silent=linear.equilibrium[:, [measured.index(name) for name in config.arbitrary_zero]],
        like=like,
    )


@dataclass
class _Run:
    """What the fits of all members share."""

    config: RecordedConfig
    sampler: TrajectorySampler
    folder: Path
    resume: bool
    device: torch.device
    progress: ProgressBars
    log: Log | None
    identity: dict[str, Any]
    losses: dict[str, list[tuple[int, float]]] = field(default_factory=dict)

    def member(self, i: int, nx: int) -> Network:
        """One network, from random numbers of its own."""
        config, device = self.config, self.device
        inputs = self.sampler(torch.Generator(device).manual_seed(0))[0].shape[1]
        network = Network(inputs, nx, width=config.width, depth=config.depth, activation=config.activation).to(device)
        problem = InverseProblem(network, self.sampler, device)
        stage = Stage(
            name=f"inverse-{i + 1}",
            steps=config.inverse_steps,
            learning_rate=config.learning_rate,
            folder=self.folder,
            fingerprint=hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()[:16],
            seed=config.seed * config.members + i,
            cpu_seconds=math.inf if config.cpu_seconds is None else config.cpu_seconds / config.members,
            optimiser=config.optimiser,
        )
        self.losses[stage.name] = optimise(
            stage, problem, problem.loss, self.progress, log=self.log, resume=self.resume
        )
        return network
