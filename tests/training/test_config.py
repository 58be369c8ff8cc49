"""Invalid settings."""

import json
from dataclasses import replace

import pytest
from linear_system import Oscillator

from training import preset
from training.config import read_changes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "dt"),
        ({"dt": 5.0, "duration": 3.0}, "shorter than one sample"),
        ({"pairs": ((-0.1, -1.0),)}, "pairs"),
        ({"pairs": ((-0.1, 1.0), (-0.1, 1.0))}, "distinct"),
        ({"eigenvalues": ()}, "needs eigenvalues"),
        ({"batch": 100}, "batch"),
        ({"pipeline": "bogus"}, "pipeline"),
        ({"measurement_noise_max": (0.1, 0.0)}, r"measurement_noise_max\.each\.1"),
        ({"noise_free_share": float("nan")}, "share"),
        ({"policy": "controller", "inputs": False}, "policy"),
        ({"uncertain": {"mu": 1.0}}, "less than 1"),
        ({"estimate_parameters": True, "uncertain": {"all": 0.0}}, "needs uncertain parameters"),
        ({"uncertain": {"mu": 0.1}, "pipeline": "spinn", "forward_steps": 9}, "needs the pipeline 'input-aware'"),
    ],
)
def test_impossible_configurations(change, message):
    with pytest.raises(ValueError, match=message):
        replace(preset(Oscillator(), "input-aware", "fast"), **change)


def test_settings_that_do_not_go_with_the_pipeline():
    for wrong in ({"box_factor": 0.5}, {"forward_steps": 0}, {"collocation": "ball"}):
        with pytest.raises(ValueError, match=r"forward_steps|box_factor|collocation"):
            replace(preset(Oscillator(), "spinn", "fast"), **wrong)
    with pytest.raises(ValueError, match="policy = 'controller' needs"):
        replace(preset(Oscillator(), "spinn", "fast"), policy="controller")
    with pytest.raises(ValueError, match="forward_steps = 10 must be"):
        replace(preset(Oscillator(), "input-aware", "fast"), forward_steps=10)
    with pytest.raises(ValueError, match=r"box_factor = 2.0, transients = False: settings of the pipeline 'spinn'"):
        replace(preset(Oscillator(), "input-aware", "fast"), box_factor=2.0, transients=False)


def test_levels_of_noise_of_all_outputs_or_each(tmp_path):
    path = tmp_path / "settings.json"
    for written, levels in ((0.2, 0.2), ([0.1, 0.3], (0.1, 0.3))):
        path.write_text(json.dumps({"measurement_noise_max": written}))
        changes = read_changes(path)
        assert replace(preset(Oscillator(), "input-aware", "fast"), **changes).measurement_noise_max == levels
    path.write_text(json.dumps({"measurement_noise_max": [0.1, -1]}))
    with pytest.raises(ValueError, match="greater than 0"):
        read_changes(path)
