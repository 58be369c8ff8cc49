"""The picture of a training: what it draws, of simulated and of recorded motions."""

import numpy as np
from linear_system import Oscillator
from recorded_runs import swing
from tracking import DT

from training import RecordedSource, SimulatedSource, preset
from training.evaluation.report import held_out
from training.sources.recorded import recorded_preset


def source():
    return SimulatedSource(Oscillator(), preset(Oscillator(), changes={"dt": DT, "runs": 100, "inputs": False}))


def test_motions_of_the_report_are_others_of_the_same_kinds():
    mine, other = held_out(source()), source().runs(report=lambda done: None)
    assert mine.x.shape == other.x.shape
    assert not np.isclose(mine.x[0], other.x[0]).all(-1).any()
    np.testing.assert_array_equal(np.unique(mine.process_noise), np.unique(other.process_noise))
    assert held_out(RecordedSource([swing(0)], recorded_preset([swing(0)], {"held_out": 0.0}), "spring")) is None
