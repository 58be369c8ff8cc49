"""``python -m examples.research sizes``."""

import json

import pandas as pd
import pytest
from rich.console import Console

from examples.research.speed.sizes import Sizes
from observers import Artifact

TINY = {"trajectories": 20, "duration": 5.0, "samples": 20, "inverse_steps": 5, "batch": 64}


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.json"
    path.write_text(json.dumps(TINY))
    return path


def run(tiny, **options):
    command = Sizes("van_der_pol", config=tiny, trajectories=3, num_envs=4, out=tiny.parent / "out", **options)
    return command.run(Console(width=100))


def test_each_width_is_trained_once_measured_and_drawn(tiny, monkeypatch):
    frame = run(tiny, widths=(4, 8))
    out = tiny.parent / "out"
    pd.testing.assert_frame_equal(pd.read_csv(out / "sizes.csv"), frame, rtol=1e-4)
    assert (out / "sizes.png").stat().st_size > 5000
    for row in frame.itertuples():
        mlp = Artifact.read(out / f"van_der_pol-{row.width}.safetensors").inverse.mlp
        assert [len(bias) for bias in mlp.biases[:-1]] == [row.width] * 3
        assert row.weights == sum(weight.size for weight in mlp.weights)
        assert row.us_a_row > 0
        assert row.us_single > 0
        assert 0 < row.smape_without_noise != row.smape_under_noise

    def never(*args, **kwargs):
        raise AssertionError("trained again")

    monkeypatch.setattr("torch.Tensor.backward", never)
    again = run(tiny, widths=(8,))
    measured = [name for name in frame if not name.startswith("us")]
    pd.testing.assert_frame_equal(again[measured], frame[frame.width == 8][measured].reset_index(drop=True))


def test_observers_of_other_settings_are_not_taken_for_these(tiny):
    run(tiny, widths=(4,))
    tiny.write_text(json.dumps({**json.loads(tiny.read_text()), "inverse_steps": 6}))
    with pytest.raises(ValueError, match="inverse_steps"):
        run(tiny, widths=(4,))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"widths": ()}, "widths must be positive and differ"),
        ({"widths": (4, 4)}, "widths must be positive and differ"),
        ({"widths": (0,)}, "widths must be positive and differ"),
        ({"num_envs": 0}, "num_envs must be positive, got 0"),
        ({"trajectories": 0}, "trajectories must be positive, got 0"),
        ({"seed": -1}, "seed must not be negative, got -1"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        Sizes("van_der_pol", **options).run(Console())
