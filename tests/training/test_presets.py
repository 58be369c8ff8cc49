"""The configurations behind --preset."""

from linear_system import Oscillator

from kkl_gym import VanDerPol
from training import preset, presets
from training.config import Config


def test_paper_preset_has_the_papers_table():
    config = preset(VanDerPol(), "spinn", "paper")
    assert (config.width, config.depth, config.activation, config.learning_rate) == (512, 4, "silu", 1e-3)
    assert config.physics_weight == 0.1
    assert len(config.eigenvalues) == 5
    assert (max(config.eigenvalues), min(config.eigenvalues)) == (-1.5, -3.0)
    assert isinstance(config, Config)
    assert all(value < 0 for value in presets.eigenvalues(Oscillator()))
