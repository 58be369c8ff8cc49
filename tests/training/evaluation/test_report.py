"""The picture of a training: what it draws, of simulated and of recorded motions."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from linear_system import Oscillator
from PIL import Image
from recorded_runs import swing
from tracking import DT, tracking_observer

import training.evaluation.report
from training import RecordedSource, SimulatedSource, preset
from training.evaluation.report import held_out, write_report
from training.lessons import Result
from training.sources.recorded import recorded_preset


def source():
    return SimulatedSource(Oscillator(), preset(Oscillator(), changes={"dt": DT, "runs": 100, "inputs": False}))


def drawn(monkeypatch):
    """Titles of the axes of each picture."""
    titles, drawing = [], training.evaluation.report.drawing

    @contextmanager
    def spy(*size):
        with drawing(*size) as figure:
            yield figure
            titles.append([ax.get_title() or ax.get_title("left") for ax in figure.axes])

    monkeypatch.setattr(training.evaluation.report, "drawing", spy)
    return titles


def result(artifact):
    return Result(replace(artifact, training={"pipeline": "input-aware"}), {"inverse": [(1, 1.0), (2, 0.1)]}, {})


def test_motions_of_the_report_are_others_of_the_same_kinds():
    mine, other = held_out(source()), source().runs(report=lambda done: None)
    assert mine.x.shape == other.x.shape
    assert not np.isclose(mine.x[0], other.x[0]).all(-1).any()
    np.testing.assert_array_equal(np.unique(mine.process_noise), np.unique(other.process_noise))
    assert held_out(RecordedSource([swing(0)], recorded_preset([swing(0)], {"held_out": 0.0}), "spring")) is None


def test_a_report_has_losses_and_estimates(tmp_path, monkeypatch):
    titles, artifact = drawn(monkeypatch), replace(tracking_observer(), forward=None)
    write_report(tmp_path / "report.png", result(artifact), source())
    noise = [title for title in titles[0] if title.startswith("measurement noise")]
    assert titles[0][0] == "oscillator, input-aware"
    assert noise[0].startswith("measurement noise 0, process noise 0")
    assert len(noise) == 2
    assert np.asarray(Image.open(tmp_path / "report.png")).std() > 10
