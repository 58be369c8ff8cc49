"""The lesson of the map: T_inv, with T before it in the paper's way."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from kkl_gym.system import System
from observers import ForwardMap, InverseMap, LinearFilter
from training.lessons.run import Run
from training.maps.coordinates import StateScale
from training.maps.forward import ForwardProblem, transients, truncation_step
from training.maps.inverse import ForwardMapSampler, InverseProblem, Sampler, TrajectorySampler
from training.maps.networks import Network, averaged, on_torch
from training.seeds import Stream, generator
from training.sources import Pairs, Source
from training.sources.simulated import SimulatedSource
from training.spectrum import Spectrum


@dataclass(frozen=True)
class Maps:
    """A filter and the maps that were learned for it."""

    filter: LinearFilter
    inverse: InverseMap
    free_inverse: InverseMap | None = None
    forward: ForwardMap | None = None


def learn_map(source: Source, run: Run) -> Maps:
    """Learn T_inv along motions of a source, transients and every level of noise included.

    With inputs there are two maps: of driven motion, and of z_y alone for as long as no input has acted. In the paper's
    way (pipeline "spinn") T is learned first, on motions and on its equation, and z = T(x) replaces the filter's.

    Parameters
    ----------
    source : Source
        Where motions come from.
    run : Run
        The training under way, with the configuration.

    Returns
    -------
    Maps
        The filter and its maps.

    Raises
    ------
    ValueError
        If the motions leave the system's bounds, or are too short for the filter.
    FloatingPointError
        If the loss is no longer a number.
    """
    return _MapLesson(source, run).learned()


class _MapLesson:
    def __init__(self, source: Source, run: Run) -> None:
        config = run.config
        self.source, self.run, self.config = source, run, config
        self.spectrum = Spectrum(config.eigenvalues, config.pairs)
        self.linear = self.spectrum.filter(source.ny, config.dt, source.nu)
        self.free = isinstance(source, SimulatedSource) and source.has_free_map
        self.share = 1 / (1 + self.free + (config.pipeline == "spinn"))

    def learned(self) -> Maps:
        if self.config.pipeline == "spinn":
            return self._papers()
        free = None
        if self.free:
            unforced = self.spectrum.filter(self.source.ny, self.config.dt)
            sampler = self._along(self._pairs(unforced, free=True), unforced)
            free = sampler.inverse_map(self._fit("free", sampler), unforced)
        sampler = self._along(self._pairs(self.linear), self.linear)
        networks = [self._fit(name, sampler, i) for i, name in enumerate(self._names())]
        inverse = sampler.inverse_map(networks[0], self.linear)
        if len(networks) > 1:
            inverse = dataclasses.replace(inverse, mlp=averaged(networks))
        return Maps(self.linear, inverse, free)

    def _names(self) -> list[str]:
        count = self.config.members
        return ["inverse"] if count == 1 else [f"inverse-{i + 1}" for i in range(count)]

    def _pairs(self, linear: LinearFilter, free: bool = False) -> Pairs:
        name = f"{self.source.name}, free" if free else self.source.name
        report = self.run.progress.bar(f"motions of {name}", self.config.trajectories)
        with self.run.timed("motions"):
            pairs = self.source.pairs(linear, free=free, report=report)
        report(self.config.trajectories)
        return pairs

    def _along(self, pairs: Pairs, linear: LinearFilter, error: np.ndarray | None = None) -> TrajectorySampler:
        """Batches along motions; z may have an error of some covariance beside."""
        config = self.config
        with self.run.progress.phase("preparing batches"):
            return TrajectorySampler(
                pairs,
                linear,
                measurement_noise_max=config.measurement_noise_max,
                batch=config.batch,
                device=self.run.device,
                noise_free_share=config.noise_free_share,
                high_noise_emphasis=config.high_noise_emphasis,
                scaling=config.scaling,
                error=error,
                **self.source.sampling(linear),
            )

    def _fit(self, name: str, sampler: Sampler, member: int = 0) -> Network:
        """A network that gives x on the sampler's batches."""
        config, device = self.config, self.run.device
        inputs, x, *_ = sampler(torch.Generator(device).manual_seed(0))
        network = Network(
            inputs.shape[1], x.shape[1], width=config.width, depth=config.depth, activation=config.activation
        ).to(device)
        problem = InverseProblem(network, sampler, device)
        seed, share = config.seed * config.members + member, self.share / config.members
        self.run.minimise(name, problem, problem.loss, config.inverse_steps, share=share, seed=seed)
        return network

    def _papers(self) -> Maps:
        """T, trained on motions and on its equation, and T_inv on z = T(x)."""
        source, config, linear, run = self.source, self.config, self.linear, self.run
        if not isinstance(source, SimulatedSource):
            raise ValueError("the pipeline 'spinn' needs the equations of a system; train with 'input-aware'")
        system = source.system
        first = truncation_step(
            system, linear, steps=source.steps, epsilon=config.truncation, box_factor=config.box_factor
        )
        settled = source.ages >= first  # the filter's start no longer matters
        pairs, rng = self._pairs(linear), generator(Stream.TRAINING, config.seed, 3)
        x = pairs.x.reshape(-1, system.nx)
        points = x if config.collocation == "motions" else system.draw_starts(rng, len(x))
        forward = self._forward(system, rng, pairs, points, settled)
        run.samples["inverse_samples"] = len(points)
        with run.progress.phase("T along the motions"):
            T_x = np.stack([forward(each) for each in pairs.x])
            z = transients(T_x, pairs.z[0], linear=linear, ages=source.ages)
        error = (pairs.z - z)[settled].reshape(-1, linear.size)
        sampler: Sampler
        if config.transients:
            sampler = self._along(dataclasses.replace(pairs, z=z), linear, error.T @ error / len(error))
        else:
            T = on_torch(forward, run.device)
            sampler = ForwardMapSampler(
                T, error, points=points, batch=config.batch, device=run.device, scaling=config.scaling
            )
        return Maps(linear, sampler.inverse_map(self._fit("inverse", sampler), linear), forward=forward)

    def _forward(
        self, system: System, rng: np.random.Generator, pairs: Pairs, points: np.ndarray, settled: np.ndarray
    ) -> ForwardMap:
        """T, trained."""
        config, linear, run = self.config, self.linear, self.run
        run.samples["forward_samples"] = int(settled.sum()) * config.trajectories + len(points)
        network = Network(system.nx, linear.size, width=config.width, depth=config.depth, activation=config.activation)
        problem = ForwardProblem(
            network,
            system,
            linear=linear,
            pairs=(pairs.x[settled].reshape(-1, system.nx), pairs.z[settled].reshape(-1, linear.size)),
            points=points,
            scale=StateScale.of(points, config.scaling),
            physics_weight=config.physics_weight,
            batch=config.batch,
            device=run.device,
        )
        run.minimise("forward", problem, problem.loss, config.forward_steps, share=self.share)
        if config.solved_output_layer:
            with run.timed("forward"), run.progress.phase("solving for T's output layer", linear.size) as report:
                problem.solve_output_layer(rng, report)
        return problem.forward_map()


__all__ = ["Maps", "learn_map"]
