"""What each idea earns: from the paper's pipeline to this package's, step by step, networks trained for equal times."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

from kkl_gym.system import System
from observers import Artifact
from training.config import Method as Pipeline
from training.config import papers_spectrum, preset
from training.methods.base import Configuration, Task
from training.methods.kkl import KKLMethod, within
from training.pipeline import train
from training.tuning import Probe, Spectrum

FEATURES = 1500
NO_NOISE = 0.01  # the largest measurement noise in the training of those that are to know none
TUNED_FOR = 0.5


class Ablation(KKLMethod):
    """A pipeline of the package with some settings changed."""

    pipeline: ClassVar[Pipeline] = "input-aware"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """Settings that differ from the preset's; the paper's spectrum, unless another is the point."""
        return {"eigenvalues": papers_spectrum(task.system)}

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """The package's pipeline."""
        config = within(preset(task.system, self.pipeline, "fast"), task.budget, task.seed)
        config = replace(config, **self.changes(task))
        return train(task.system, config, task.folder, resume=True, device=task.device).artifact


class PapersSPINN(Ablation):
    """SPINN with the spectrum of the paper (the benchmark's chooses among three)."""

    name: ClassVar[str] = "ablation-spinn"
    label: ClassVar[str] = "SPINN"
    pipeline: ClassVar[Pipeline] = "spinn"


class Solved(Ablation):
    """The same, but the output layer of T found by least squares instead of descent."""

    name: ClassVar[str] = "ablation-solved"
    label: ClassVar[str] = "SPINN, T solved in X"
    pipeline: ClassVar[Pipeline] = "spinn"
    reach: ClassVar[float] = 1.0

    def changes(self, task: Task) -> Mapping[str, Any]:
        """Random features in place of a trained network."""
        return {
            "forward_steps": 0,
            "features": FEATURES,
            "reach": self.reach,
            **super().changes(task),
        }


class SolvedBeyond(Solved):
    """The same with T, and the states on which it is inverted, along motions from 2X."""

    name: ClassVar[str] = "ablation-solved-2x"
    label: ClassVar[str] = "... in 2X"
    reach: ClassVar[float] = 2.0


class Transients(Ablation):
    """No T: the inverse fitted to what the filter shows along motions from X, half of them driven."""

    name: ClassVar[str] = "ablation-transients"
    label: ClassVar[str] = "inverse on transients"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """No noise."""
        return {**super().changes(task), "noise_max": NO_NOISE}


class NoiseAware(Ablation):
    """The same, also under noise of every level, which it is told; the package's default has more modes beside."""

    name: ClassVar[str] = "ablation-noise"
    label: ClassVar[str] = "... and noise"


class Tuned(Ablation):
    """Complex modes chosen for the system and a noise level of 0.5 in place of the default's real ones."""

    name: ClassVar[str] = "ablation-tuned"
    label: ClassVar[str] = "... tuned spectrum"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """The modes that ``kkl-gym tune`` chooses."""
        spectrum = tuned_spectrum(task.system, task.budget.dt, task.budget.duration)
        return {"eigenvalues": spectrum.eigenvalues, "pairs": spectrum.pairs}


class OneLevel(Tuned):
    """The same for noise up to that level only."""

    name: ClassVar[str] = "ablation-one-level"
    label: ClassVar[str] = "... noise up to 0.5"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """The same, and the largest noise."""
        return {**super().changes(task), "noise_max": TUNED_FOR}


@cache
def tuned_spectrum(system: System, dt: float, duration: float) -> Spectrum:
    """The one chosen for noise of 0.5."""
    return Probe(system, dt, duration).choose(TUNED_FOR)[-1].spectrum
