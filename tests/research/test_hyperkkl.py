"""HyperKKL's protocol: the inputs, the traffic model, the command at toy size, and the published table."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import research

from examples.research.hyperkkl import INPUTS, RANGES, SYSTEMS, Duffing, Traffic, inputs, page
from training import preset, train

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize("kind", INPUTS[1:])
def test_inputs_have_the_printed_ranges(kind, beyond):
    t = 0.05 * np.arange(4000)
    u = inputs(kind, beyond, 500, t, np.random.default_rng(0))[..., 0]
    (low, high), (slowest, fastest) = RANGES[kind][beyond]
    size = np.abs(u).max(0)
    assert np.abs(u).max() <= high
    assert size.min() >= (0.99 * low if kind != "constant" else 0.0)
    assert size.max() > 0.98 * high
    turns = (np.diff(np.sign(u), axis=0) != 0).sum(0) * np.pi / t[-1]
    assert turns.min() >= 0.95 * slowest
    assert turns.max() <= 1.05 * fastest


def test_traffic_conserves_cars():
    x = np.random.default_rng(0).uniform(0.01, 0.1, 5)
    change = 500 * sum(Traffic().f(x))
    assert change == pytest.approx(1.2 + 0.3 - 30 * (x[-1] - x[-1] ** 2 / 0.25))


def test_the_command_measures_an_observer_that_is_there(tmp_path):
    system = Duffing()
    sizes = {"trajectories": 20, "duration": 20.0, "samples": 20, "width": 4, "inverse_steps": 9, "runs": 100}
    train(system, preset(system, changes=sizes)).artifact.save(tmp_path / "duffing.safetensors")
    research("hyperkkl", "--systems", "duffing", "--trials", "2", "--out", str(tmp_path))
    frame = pd.read_csv(tmp_path / "results.csv")
    assert len(frame) == 2 * (len(INPUTS) + len(INPUTS) - 1)
    assert (frame.kalman[frame.noise == 0] < 1e-3).all()
    assert (tmp_path / "table.md").read_text() == page(frame)
    with pytest.raises(SystemExit, match="unknown system 'sir'; there are duffing"):
        research("hyperkkl", "--systems", "sir", "--out", str(tmp_path))


def test_the_page_has_the_committed_figures():
    frame = pd.read_csv(RESULTS / "hyperkkl.csv")
    assert page(frame) in (RESULTS / "hyperkkl.md").read_text(encoding="utf-8")
    assert set(frame.system) == set(SYSTEMS)
