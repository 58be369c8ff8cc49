"""What is known of each system fits the system."""

import pytest

from kkl_gym import SYSTEMS, get_system
from observers import shipped
from training.presets import preset
from training.systems import PROFILES, Profile, profile


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_fits_its_system(name):
    found, system = PROFILES[name], get_system(name)
    assert profile(system) is found
    assert found.task is None or found.task.system == name
    assert found.agent_observer in {None, *shipped()}
    config = preset(system, "input-aware", "fast")
    assert {key: getattr(config, key) for key in found.settings} == dict(found.settings)
    assert found.eigenvalues is None or config.eigenvalues == pytest.approx(found.eigenvalues, abs=1e-6)


def test_every_shipped_system_has_one_and_others_the_defaults(script):
    assert list(PROFILES) == list(SYSTEMS)
    assert profile(get_system(f"{script}:Pendulum")) == Profile()
