"""Shipped maps have the settings of the preset; tests/guard tests their accuracy."""

import pytest

import observers
from kkl_gym import get_system
from training.config import settings_of
from training.presets import preset


@pytest.mark.parametrize("name", observers.shipped())
def test_shipped_maps_have_the_settings_of_the_preset(name):
    artifact = observers.load(name).artifact
    kind = name.removeprefix(artifact.system).removeprefix("-")
    pipeline, size = ("spinn", "default") if kind == "spinn" else ("input-aware", kind or "default")
    assert settings_of(artifact.training) == preset(get_system(artifact.system), pipeline, "fast", size=size)
    assert (artifact.motion is not None and artifact.motion.equations is not None) == (pipeline == "input-aware")
