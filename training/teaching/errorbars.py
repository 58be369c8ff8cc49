"""Error bars for an observer that is there already: the covariance of its errors, learned and then calibrated."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from rich.console import Console

from kkl_gym.system import System
from observers import Artifact, InverseMap
from observers.decoder import Decoders
from training.config import Config, settings_of
from training.maps.regions import LEVELS, Regions, level_of, squared_distance
from training.maps.samplers import TrajectorySampler
from training.maps.spread import with_spread
from training.pipeline import LEAD_IN_SHARE
from training.progress import ProgressBars, progress_bars
from training.seeds import Stream, generator
from training.teaching.monitor import sound_trajectories
from training.trajectories.controllers import Controller
from training.trajectories.parameters import blind, uncertain_plant
from training.trajectories.record import Motions, record, recording_ages
from training.trajectories.signals import DRIVEN, KINDS


def learn_error_bars(
    artifact: Artifact,
    system: System,
    *,
    steps: int = 4000,
    trajectories: int = 1000,
    seed: int = 0,
    policy: Controller | None = None,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Artifact:
    """Learn the covariance of an observer's errors, of T_inv alone where it tracks.

    Motions are simulated as in its training, but others. A small network is fitted to what T_inv is off by on them, at
    every age and level of noise, by Gaussian likelihood. Then factors are found on further motions, so that regions of
    90 % hold 90 % of the errors at each age and level of noise, on free and on driven motions. Where parameters are
    uncertain that is so over plants as :func:`training.trajectories.parameters.uncertain_plant` draws them, and less at
    the ends of the ranges.
    """
    artifact.check(system.name, system.parameters, dt=artifact.filter.dt, ny=system.ny, nu=system.nu)
    artifact = dataclasses.replace(artifact, flow=None)  # the tracker rests on the error bars that it had
    if steps < 1 or trajectories < 100 or seed < 0:
        raise ValueError(
            f"need a step at least, 100 trajectories and a seed that is not negative, got {steps}, {trajectories}, "
            f"{seed}"
        )
    for inverse in (artifact.inverse, artifact.free_inverse):
        if inverse is not None and not {"measurement_noise", "age"} <= set(inverse.features):
            raise ValueError(
                f"error bars need a map that is told measurement noise and age, this one is told "
                f"{', '.join(inverse.features)}: train one with kkl-gym train"
            )
    config, policy = settings_of(artifact.training), policy and blind(policy, system.nx)
    plant = uncertain_plant(system, artifact.parameter_ranges)
    with progress_bars(console) as progress:
        run = _Run(artifact, plant, config, steps, trajectories, seed, policy, device or torch.device("cpu"), progress)
        torch.manual_seed(seed)
        driven = run.learned("driven" if artifact.nu else "all", artifact.inverse)
        free = None if artifact.free_inverse is None else run.learned("free", artifact.free_inverse)
        learned = dataclasses.replace(artifact, inverse=driven, free_inverse=free)
        with progress.phase("calibrating the error bars", 2 * len(run.tables)) as report:
            return run.calibrated(learned, report)


@dataclasses.dataclass
class _Run:
    """What the stages share."""

    artifact: Artifact
    plant: System
    config: Config
    steps: int
    trajectories: int
    seed: int
    policy: Controller | None
    device: torch.device
    progress: ProgressBars

    def __post_init__(self) -> None:
        largest = self.artifact.process_noise_max
        self.tables = (0.0,) if largest is None else (0.0, largest)  # levels of process noise
        self.duration = self.config.duration
        self.regions = Regions.of(self.artifact, self.duration, pace=self.plant.pace)

    def learned(self, name: str, inverse: InverseMap) -> InverseMap:
        """The map with a network of its errors, fitted on motions as in its training."""
        free, config = inverse is self.artifact.free_inverse, self.config
        linear = self.artifact.filter
        if free or not linear.nu:
            linear = type(linear)(linear.A, linear.B, linear.dt)
        noisy = self.artifact.process_noise_max is not None
        motions = Motions(
            kinds=() if free else DRIVEN if self.artifact.free_inverse else KINDS,
            lead_in_share=LEAD_IN_SHARE if free else 0.0,
            lead_in_input=config.lead_in_input if free else 0.0,
            process_noise_share=config.process_noise_share if noisy else 0.0,
            box_factor=config.box_factor,
            policy=None if free else self.policy,
        )
        rng, count = generator(Stream.CALIBRATION, self.seed, 2 if free else 1), round(self.duration / linear.dt)
        data = record(
            self.plant,
            linear,
            n=self.trajectories,
            steps=count,
            ages=recording_ages(count, config.samples),
            rng=rng,
            motions=motions,
            report=self.progress.bar(f"simulating {name} motions", self.trajectories),
        )
        nx = self.artifact.nx
        sampler = TrajectorySampler(
            dataclasses.replace(data, x=data.x[..., : inverse.mlp.outputs]),
            linear,
            measurement_noise_max=inverse.measurement_noise_max,
            batch=config.batch,
            device=self.device,
            measurement_noise=self.artifact.measurement_noise,
            noise_free_share=config.noise_free_share,
            high_noise_emphasis=config.high_noise_emphasis,
            process_noise_max=self.artifact.process_noise_max or 0.0,
            parameters=inverse.mlp.outputs - nx,
            like=inverse,
        )
        return with_spread(
            inverse,
            sampler,
            nx,
            ages=self.regions.knots * linear.dt,
            tables=len(self.tables),
            name=f"error bars, {name}",
            steps=self.steps,
            seed=self.seed,
            progress=self.progress,
            device=self.device,
        )

    def calibrated(self, artifact: Artifact, report: Callable[[float], object]) -> Artifact:
        """The observer with factors by which its regions hold as many errors as they should."""
        inverse, free = artifact.inverse, artifact.free_inverse
        driven_factors, free_factors = [], []
        for table, process_noise in enumerate(self.tables):
            x, z, noise = self._runs(artifact, process_noise, generator(Stream.CALIBRATION, self.seed, 3 + table))
            report(2 * table + 1)
            moved = np.asarray(z[..., len(artifact.filter.A) :].any(-1))
            groups = (moved, ~moved) if free is not None else (np.ones_like(moved), None)
            distances = [
                self._distances(artifact, x, z + level * noise, level=level, process_noise=process_noise)
                for level in LEVELS
            ]
            driven_factors.append(self.regions.factors(distances, groups[0]))
            if groups[1] is not None:
                free_factors.append(self.regions.factors(distances, groups[1]))
            report(2 * table + 2)

        def with_factors(inverse: InverseMap, factors: list[np.ndarray]) -> InverseMap:
            assert inverse.spread is not None
            tables = np.array(factors) if len(factors) > 1 else factors[0]
            return dataclasses.replace(inverse, spread=dataclasses.replace(inverse.spread, factors=tables))

        return dataclasses.replace(
            artifact,
            inverse=with_factors(inverse, driven_factors),
            free_inverse=None if free is None else with_factors(free, free_factors),
        )

    def _runs(
        self, artifact: Artifact, process_noise: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States, filter states without noise, and what the largest noise adds to these, at the regions' ages."""
        linear, system = artifact.filter, self.plant
        x, u = sound_trajectories(
            artifact,
            system,
            n=2 * self.trajectories,
            duration=self.duration,
            rng=rng,
            policy=self.policy,
            process_noise=process_noise,
            kinds=DRIVEN,
        )
        ages, u = self.regions.ages, u[..., : linear.nu]
        z = linear.run(system.output(x), u, ages)
        largest = np.broadcast_to(artifact.inverse.measurement_noise_max, (system.ny,))
        noise = linear.run(largest * rng.standard_normal((*x.shape[:2], system.ny)), np.zeros_like(u), ages)
        return x[ages][..., : artifact.nx], z, noise

    def _distances(
        self, artifact: Artifact, x: np.ndarray, z: np.ndarray, *, level: float, process_noise: float
    ) -> np.ndarray:
        """Squared distances of the errors in units of the covariance, (ages, n)."""
        decoders = Decoders.of(
            artifact, slice(artifact.nx), measurement_noise=level_of(artifact, level), process_noise=process_noise
        )
        parts, x_hat = decoders.estimate(z, (self.regions.ages * artifact.filter.dt)[:, None])
        return squared_distance(x - x_hat, decoders.covariance(parts))
