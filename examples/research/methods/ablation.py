"""Ablation: two series of pipelines, trained for equal times. Each pipeline differs from the next in a few settings.

One series leads from the paper's SPINN to the package's, the other from a T_inv trained without noise to T_inv alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from examples.research.methods.base import Configuration, Task
from examples.research.methods.kkl import KKLMethod, trained, within
from observers import Artifact
from training.config import Pipeline
from training.evaluation.levels import multiple
from training.presets import Size, preset
from training.spectrum import papers_spectrum

Settings = Mapping[str, Any]

NO_NOISE = 0.02  # stands for no noise: the largest noise level in training, as a share of the system's default
# A single T_inv for free and driven motion, with the same distribution of noise levels for all systems.
TOGETHER: Settings = {
    "free_inverse": False,
    "process_noise_share": 0.0,
    "noise_free_share": 0.2,
    "high_noise_emphasis": 2.0,
}
ADAM: Settings = {"optimiser": "adam", "batch": 4096, "learning_rate": 8e-3}
# SPINN as in the paper's sec. 8.1, with collocation points uniform in X; spectrum and budget are set elsewhere.
PAPERS: Settings = {
    "optimiser": "adam",
    "learning_rate": 1e-3,
    "batch": 2048,
    "collocation": "box",
    "box_factor": 1.0,
    "scaling": "range",
    "transients": False,
    "solved_output_layer": False,
}
# Name and label of each step, and the paper's settings that the step replaces by the preset's.
SPINN_STEPS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("ablation-spinn", "SPINN", ()),
    ("ablation-spinn-soap", "SPINN by SOAP", ("optimiser", "learning_rate", "batch")),
    ("ablation-spinn-spectrum", "... smooth T", ("eigenvalues", "pairs")),
    ("ablation-spinn-motions", "... along motions", ("collocation", "box_factor")),
    ("ablation-spinn-scaling", "... relative errors", ("scaling",)),
    ("ablation-spinn-solved", "... output layer solved", ("solved_output_layer",)),
    ("ablation-spinn-transients", "... transients and noise", ("transients",)),
)


class Ablation(KKLMethod):
    """A pipeline of the package with some settings changed."""

    def __init__(self, name: str, label: str, changes: Callable[[Task], Settings], pipeline: Pipeline) -> None:
        self.name, self.label = name, label  # type: ignore[misc]  # class variables in other methods
        self.changes, self.pipeline = changes, pipeline

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """Train by the package's pipeline."""
        size: Size = "large" if self.pipeline == "input-aware" else "default"
        config = within(preset(task.system, self.pipeline, size=size), task.budget, task.seed)
        config = replace(config, **self.changes(task))
        return trained(task, config)


def papers_modes(task: Task) -> Settings:
    """Return the settings of the paper's spectrum."""
    return {"eigenvalues": papers_spectrum(task.system), "pairs": ()}


def _without(replaced: tuple[str, ...]) -> Callable[[Task], Settings]:
    """Return a function from a task to the paper's settings, without the settings in ``replaced``."""
    return lambda task: {key: value for key, value in {**papers_modes(task), **PAPERS}.items() if key not in replaced}


def _spinn() -> list[Ablation]:
    methods, replaced = list[Ablation](), tuple[str, ...]()
    for name, label, more in SPINN_STEPS:
        replaced += more
        methods.append(Ablation(name, label, _without(replaced), "spinn"))
    return methods


def _without_noise(task: Task) -> Settings:
    most = {"measurement_noise_max": multiple(task.system, NO_NOISE)}
    return {**papers_modes(task), **TOGETHER, **ADAM, **most}


SPINN_METHODS = _spinn()
INVERSE_METHODS = [
    Ablation("ablation-transients", "inverse on transients", _without_noise, "input-aware"),
    Ablation("ablation-noise", "... and noise", lambda task: {**papers_modes(task), **TOGETHER, **ADAM}, "input-aware"),
    Ablation("ablation-modes", "... more modes", lambda task: {**TOGETHER, **ADAM}, "input-aware"),
    Ablation("ablation-soap", "... by SOAP", lambda task: TOGETHER, "input-aware"),
    Ablation("ablation-free", "... inverse of free motion", lambda task: {"process_noise_share": 0.0}, "input-aware"),
]
