"""Shipped maps are what the preset makes; tests/guard holds how accurate they are."""

import numpy as np
import pytest

import observers
from kkl_gym import get_system
from training.config import settings_of
from training.evaluation.errors import unseen_trajectories
from training.presets import preset


@pytest.mark.parametrize("name", observers.shipped())
def test_shipped_maps_are_what_the_preset_makes(name):
    artifact = observers.load(name).artifact
    kind = name.removeprefix(artifact.system).removeprefix("-")
    pipeline, size = ("spinn", "default") if kind == "spinn" else ("input-aware", kind or "default")
    assert settings_of(artifact.training) == preset(get_system(artifact.system), pipeline, "fast", size=size)
    assert (artifact.motion is not None and artifact.motion.equations is not None) == (pipeline == "input-aware")


def test_coasting_runs_as_a_model_of_the_system():
    system, observer = get_system("van_der_pol"), observers.load("van_der_pol", 0.0, process_noise=0.0)
    runs = unseen_trajectories(system, 0.01, n=20, duration=15.0, seed=0)
    y = system.output(runs.x)
    x_hat = observer.reset(y[0])
    for k in range(1, 1501):
        x_hat = observer.step(y[k] if k <= 1400 else None)
    relative = np.linalg.norm(x_hat - runs.x[-1], axis=-1) / np.linalg.norm(runs.x[-1], axis=-1)
    assert np.median(relative) < 0.02
