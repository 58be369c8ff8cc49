"""What each idea earns: from the paper's pipeline to this package's, step by step, networks trained for equal times."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

from kkl_gym.system import System
from observers import Artifact
from training.config import Pipeline
from training.methods.base import Configuration, Task
from training.methods.kkl import KKLMethod, within
from training.pipeline import train
from training.presets import preset
from training.spectrum import papers_spectrum
from training.tuning import Probe, Spectrum

FEATURES = 1500
NO_NOISE = 0.01  # the largest measurement noise in the training of those that are to know none
TUNED_FOR = 0.5
# How inverses were trained before there was one for free motion, samples drawn alike for all systems; and before SOAP.
TOGETHER: dict[str, Any] = {
    "free_inverse": False,
    "process_noise_share": 0.0,
    "noise_free_share": 0.2,
    "high_noise_emphasis": 2.0,
}
EARLIER: dict[str, Any] = {**TOGETHER, "optimiser": "adam", "batch": 4096, "learning_rate": 8e-3}


class Ablation(KKLMethod):
    """A pipeline of the package with some settings changed."""

    pipeline: ClassVar[Pipeline] = "input-aware"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """Say which settings differ from the preset's: the spectrum, which is the paper's unless another is the point.

        Parameters
        ----------
        task : Task
            The training.

        Returns
        -------
        mapping
            Settings of a :class:`training.config.Config` by name.
        """
        return {"eigenvalues": papers_spectrum(task.system), "pairs": ()}

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
    """The same, but the output layer of T by least squares, along motions from 2X, on which T is then inverted."""

    name: ClassVar[str] = "ablation-solved"
    label: ClassVar[str] = "SPINN, T solved"
    pipeline: ClassVar[Pipeline] = "spinn"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """Random features in place of a trained network."""
        return {"forward_steps": 0, "random_features": FEATURES, "box_factor": 2.0, **super().changes(task)}


class Transients(Ablation):
    """No T: one inverse fitted to what the filter shows along motions from X, half of them driven."""

    name: ClassVar[str] = "ablation-transients"
    label: ClassVar[str] = "inverse on transients"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """No noise."""
        return {**super().changes(task), **EARLIER, "measurement_noise_max": NO_NOISE}


class NoiseAware(Ablation):
    """The same, also under noise of every level, which it is told."""

    name: ClassVar[str] = "ablation-noise"
    label: ClassVar[str] = "... and noise"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """All that is not the default's."""
        return {**super().changes(task), **EARLIER}


class MoreModes(Ablation):
    """The same with the default's spectrum."""

    name: ClassVar[str] = "ablation-modes"
    label: ClassVar[str] = "... more modes"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """Its modes are the preset's."""
        return EARLIER


class BySOAP(Ablation):
    """The same by SOAP."""

    name: ClassVar[str] = "ablation-soap"
    label: ClassVar[str] = "... by SOAP"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """One map for free and driven motion."""
        return TOGETHER


class OwnFree(Ablation):
    """The default, which has an inverse of its own for free motion, but no process noise in training."""

    name: ClassVar[str] = "ablation-free"
    label: ClassVar[str] = "... inverse of free motion"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """No process noise in training."""
        return {"process_noise_share": 0.0}


class Tuned(Ablation):
    """The default with modes chosen anew for the system and a noise level of 0.5."""

    name: ClassVar[str] = "ablation-tuned"
    label: ClassVar[str] = "... tuned spectrum"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """The last of the spectra that ``kkl-gym tune`` shows as chosen; what it writes begins with the default's."""
        spectrum = tuned_spectrum(task.system, task.budget.dt, task.budget.duration)
        return {"eigenvalues": spectrum.eigenvalues, "pairs": spectrum.pairs}


@cache
def tuned_spectrum(system: System, dt: float, duration: float) -> Spectrum:
    """Choose modes for noise of 0.5; systems are tuned once.

    Parameters
    ----------
    system : System
        Any system.
    dt : float
        Sampling interval in seconds.
    duration : float
        Length of the runs in seconds.

    Returns
    -------
    Spectrum
        The last one of the choice, which is made anew.
    """
    return Probe(system, dt, duration).choose(TUNED_FOR)[-1].spectrum
