"""Levels of measurement noise."""

import dataclasses

import linear_system
import numpy as np
import pytest
from linear_system import TwoOutputs

from kkl_gym import VanDerPol
from training.evaluation.levels import beyond, level_for, multiple, read_level, show_level


def test_levels_as_people_write_them():
    assert read_level("0.1,0.3") == (0.1, 0.3)
    assert show_level((0.1, 0.3)) == "0.1, 0.3"
    assert multiple(VanDerPol(), 0.02) == 0.01
    assert multiple(TwoOutputs(), 2.0) == (0.2, 0.6)
    for wrong in ("", "1,", "0.1;0.3"):
        with pytest.raises(ValueError, match=r"is no level of noise: .* as in 0\.1,0\.3"):
            read_level(wrong)


def trained_up_to(artifact, largest):
    return dataclasses.replace(artifact, inverse=dataclasses.replace(artifact.inverse, measurement_noise_max=largest))


def test_the_default_level_is_the_systems_own_within_the_maps_range(make_artifact):
    artifact = make_artifact()  # trained up to 1
    assert level_for(artifact, VanDerPol()) == 0.5
    assert level_for(trained_up_to(artifact, 0.1), VanDerPol()) == 0.1
    assert level_for(make_artifact(noise=False), VanDerPol()) == 0.5
    assert level_for(artifact, TwoOutputs()) == 0.3  # this map takes one level for all outputs: the larger one
    two = make_artifact(system=f"{linear_system.__file__}:TwoOutputs", outputs=2)  # trained up to 1 and 2
    assert level_for(two, TwoOutputs()) == (0.1, 0.3)
    assert level_for(trained_up_to(two, (1.0, 0.2)), TwoOutputs()) == (0.1, 0.2)
    assert not beyond(artifact, 1.0)
    assert not beyond(two, (0.1, 2.0))
    assert not beyond(make_artifact(noise=False), np.inf)
    assert beyond(artifact, 1.5) == "measurement noise 1.5 is beyond the map's range, 0 to 1"
    assert beyond(two, (0.1, 2.5)) == "measurement noise 0.1, 2.5 is beyond the map's range, 0 to 1, 0 to 2"
    assert "takes one level of measurement noise for all outputs" in beyond(artifact, (0.1, 0.3))
