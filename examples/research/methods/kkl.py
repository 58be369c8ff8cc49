"""The methods whose KKL observers have the package's own format: its default, and the paper's SPINN."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from examples.research.methods.base import Budget, Configuration, Method, Task
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.estimator import Estimator
from observers.names import resolve
from training.config import Config
from training.evaluation.levels import Level
from training.lessons import train
from training.presets import preset
from training.spectrum import evenly_spaced

# Candidate intervals of real eigenvalues of A, in 1 / System.pace; the first is the paper's.
SPECTRA = ((-3.0, -1.5), (-8.0, -1.0), (-20.0, -2.0))
# Candidates of SPINN, which needs a smooth T: the paper's, and two so fast that z depends on little of the past.
SMOOTH_SPECTRA = ((-3.0, -1.5), (-20.0, -2.0), (-40.0, -6.0))


def spectrum(system: System, fastest: float, slowest: float) -> tuple[float, ...]:
    """Return 2 nx + 1 logarithmically spaced eigenvalues for each output."""
    return evenly_spaced(2 * system.nx + 1, slowest / system.pace, fastest / system.pace)


class KKLMethod(Method[Artifact]):
    """A method that trains an artifact."""

    def observer(self, trained: Artifact, system: System, dt: float, measurement_noise: Level, /) -> Estimator[Any]:
        """Return the observer; it assumes no process noise, and no more measurement noise than in its training."""
        return KKLObserver(trained, trained.inverse.within(measurement_noise), process_noise=0.0).estimator

    def save(self, trained: Artifact, path: Path) -> None:
        """Write an artifact for ``observers.load``."""
        trained.save(path)

    def load(self, path: Path) -> Artifact:
        """Read the artifact."""
        return Artifact.read(path)


def within(config: Config, budget: Budget, seed: int) -> Config:
    """Return a configuration with the benchmark's data, networks and limit of CPU time, for T_inv without a tracker."""
    return replace(
        config,
        tracking=False,
        dt=budget.dt,
        trajectories=budget.trajectories,
        duration=budget.duration,
        samples=budget.samples,
        width=budget.width,
        depth=budget.depth,
        activation=budget.activation,  # type: ignore[arg-type]
        forward_steps=budget.steps if config.forward_steps else 0,
        inverse_steps=budget.steps,
        cpu_seconds=budget.cpu_seconds if math.isfinite(budget.cpu_seconds) else None,
        seed=seed,
    )


def trained(task: Task, config: Config) -> Artifact:
    """Train by the package's pipeline, on the CPU like all methods."""
    return train(task.system, config, task.folder, resume=True, device=torch.device("cpu")).artifact


class Default(KKLMethod):
    """The package's method (``kkl-gym train``): T_inv takes filtered y and u, the noise level and the age.

    One T_inv is trained on driven motions, one on free motions, both with noise. Each has as many simulated
    trajectories as every other method. Some free motions start at states that inputs have reached from X.
    Each T_inv has half of the time, although the benchmark uses only the one for free motions. The only configuration
    is the preset, which was chosen during the package's development.
    """

    name: ClassVar[str] = "default"
    label: ClassVar[str] = "T_inv alone"

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """Train by the package's pipeline."""
        config = within(preset(task.system, size="large"), task.budget, task.seed)
        return trained(task, config)


class Shipped(KKLMethod):
    """The shipped default maps, trained on 500 trajectories whatever the budget: ``--methods shipped``."""

    name: ClassVar[str] = "shipped"
    label: ClassVar[str] = "default maps, as shipped"
    suffix: ClassVar[str] = ""

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """Read the shipped map; there is nothing to train."""
        return Artifact.read(resolve(task.system.name + self.suffix))


class ShippedSPINN(Shipped):
    """The shipped SPINN maps: ``--methods shipped-spinn``."""

    name: ClassVar[str] = "shipped-spinn"
    label: ClassVar[str] = "SPINN, as shipped"
    suffix: ClassVar[str] = "-spinn"


class ShippedLarge(Shipped):
    """T_inv alone of the shipped large maps: ``--methods shipped-large``."""

    name: ClassVar[str] = "shipped-large"
    label: ClassVar[str] = "T_inv alone, as shipped"
    suffix: ClassVar[str] = "-large"

    def observer(self, trained: Artifact, system: System, dt: float, measurement_noise: Level, /) -> Estimator[Any]:
        """Return T_inv of the large map, without a model."""
        return super().observer(replace(trained, motion=None), system, dt, measurement_noise)


class SPINN(KKLMethod):
    """The paper's pipeline: a physics-informed T, then T_inv fitted to z from T (``kkl-gym train --pipeline spinn``).

    It simulates as many trajectories as every method has, with the same distribution of starts in X.
    """

    name: ClassVar[str] = "spinn"
    label: ClassVar[str] = "SPINN"

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Return three spectra."""
        return tuple({"spectrum": list(interval)} for interval in SMOOTH_SPECTRA)

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """Train by the package's pipeline."""
        fastest, slowest = configuration["spectrum"]
        changes = {"eigenvalues": spectrum(task.system, fastest, slowest), "pairs": (), "box_factor": 1.0}
        config = within(preset(task.system, "spinn", changes=changes), task.budget, task.seed)
        return trained(task, config)
