"""What each idea earns, step by step, networks trained for equal times.

One staircase leads from the paper's SPINN to the package's, the other from inverses without T to the default.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

from examples.research.methods.base import Configuration, Task
from examples.research.methods.kkl import KKLMethod, within
from kkl_gym.system import System
from observers import Artifact
from training.config import Pipeline
from training.evaluation.levels import multiple
from training.pipeline import train
from training.presets import preset
from training.spectrum import papers_spectrum
from training.tuning import Probe, Spectrum

PENALTY = 0.03  # of the mean square error for a factor e in the Lipschitz constant
NO_NOISE = 0.02  # of the system's own measurement noise: the largest in training of those that are to know none
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
        """Settings that differ from the preset's: the paper's spectrum, unless another one is compared."""
        return {"eigenvalues": papers_spectrum(task.system), "pairs": ()}

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """The package's pipeline."""
        config = within(preset(task.system, self.pipeline, "fast"), task.budget, task.seed)
        config = replace(config, **self.changes(task))
        return train(task.system, config, task.folder, resume=True, device=task.device).artifact


class PapersSPINN(Ablation):
    """The paper's SPINN as its sec. 8.1 describes it: points uniform in X, and its spectrum, all at a small budget."""

    name: ClassVar[str] = "ablation-spinn"
    label: ClassVar[str] = "SPINN"
    pipeline: ClassVar[Pipeline] = "spinn"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """All that the package's SPINN has beyond the paper's; each class below gives some of it back."""
        papers = {
            **super().changes(task),
            "optimiser": "adam",
            "learning_rate": 1e-3,
            "batch": 2048,
            "collocation": "box",
            "box_factor": 1.0,
            "scaling": "range",
            "transients": False,
            "solved_output_layer": False,
            "adaptive": False,
        }
        return {name: value for name, value in papers.items() if name not in self.given_back()}

    @classmethod
    def given_back(cls) -> set[str]:
        """Settings that are the preset's, those of the classes before included."""
        return {name for each in cls.__mro__ for name in vars(each).get("own", ())}


class SPINNBySOAP(PapersSPINN):
    """The same by SOAP."""

    name: ClassVar[str] = "ablation-spinn-soap"
    label: ClassVar[str] = "SPINN by SOAP"
    own: ClassVar[tuple[str, ...]] = ("optimiser", "learning_rate", "batch")


class SmoothSPINN(SPINNBySOAP):
    """The same with a spectrum that makes T smooth."""

    name: ClassVar[str] = "ablation-spinn-spectrum"
    label: ClassVar[str] = "... smooth T"
    own: ClassVar[tuple[str, ...]] = ("eigenvalues", "pairs")


class MovingSPINN(SmoothSPINN):
    """The same along motions, most of them from 2X, instead of uniform points in X."""

    name: ClassVar[str] = "ablation-spinn-motions"
    label: ClassVar[str] = "... along motions"
    own: ClassVar[tuple[str, ...]] = ("collocation", "box_factor")


class ScaledSPINN(MovingSPINN):
    """The same with states in standard deviations, and relative errors."""

    name: ClassVar[str] = "ablation-spinn-scaling"
    label: ClassVar[str] = "... relative errors"
    own: ClassVar[tuple[str, ...]] = ("scaling",)


class SolvedSPINN(ScaledSPINN):
    """The same, the output layer of T solved for in the end."""

    name: ClassVar[str] = "ablation-spinn-solved"
    label: ClassVar[str] = "... output layer solved"
    own: ClassVar[tuple[str, ...]] = ("solved_output_layer",)


class SPINNOfAnyAge(SolvedSPINN):
    """The same at every age and level of noise."""

    name: ClassVar[str] = "ablation-spinn-transients"
    label: ClassVar[str] = "... transients and noise"
    own: ClassVar[tuple[str, ...]] = ("transients",)


class AdaptiveSPINN(SPINNOfAnyAge):
    """The same with points where the residual is large drawn more often."""

    name: ClassVar[str] = "ablation-spinn-adaptive"
    label: ClassVar[str] = "... adaptive points"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """One setting more."""
        return {**super().changes(task), "adaptive": True}


class LipschitzSPINN(AdaptiveSPINN):
    """The same with a penalty on the Lipschitz constant of T_inv."""

    name: ClassVar[str] = "ablation-spinn-lipschitz"
    label: ClassVar[str] = "... Lipschitz penalty"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """One setting more."""
        return {**super().changes(task), "lipschitz_penalty": PENALTY}


class Transients(Ablation):
    """No T: one inverse fitted to what the filter shows along motions from X, half of them driven."""

    name: ClassVar[str] = "ablation-transients"
    label: ClassVar[str] = "inverse on transients"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """No noise."""
        return {**super().changes(task), **EARLIER, "measurement_noise_max": multiple(task.system, NO_NOISE)}


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
    """The default with modes chosen anew for the system and its own level of noise."""

    name: ClassVar[str] = "ablation-tuned"
    label: ClassVar[str] = "... tuned spectrum"

    def changes(self, task: Task) -> Mapping[str, Any]:
        """The last of the spectra that ``kkl-gym tune`` shows as chosen; what it writes begins with the default's."""
        spectrum = tuned_spectrum(task.system, task.budget.dt, task.budget.duration)
        return {"eigenvalues": spectrum.eigenvalues, "pairs": spectrum.pairs}


@cache
def tuned_spectrum(system: System, dt: float, duration: float) -> Spectrum:
    """Choose modes for a system's own level of noise; systems are tuned once."""
    return Probe(system, dt, duration).choose(multiple(system, 1.0))[-1].spectrum
