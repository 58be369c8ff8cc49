"""Choosing an interval of eigenvalues for a physics-informed map."""

from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest
from linear_system import Oscillator

from training.cli import main
from training.config import override, read_changes
from training.presets import preset
from training.smoothness import Smoothness, intervals, smoothness
from training.spectrum import Spectrum, papers_spectrum
from training.tuning import Choice, Probe
from training.tuning.intervals import CANDIDATE, PAPERS, Judged, judge

SYSTEM = str(Path(linear_system.__file__)) + ":Oscillator"


def one(slowest, exponent, error, kind=CANDIDATE):
    spectrum = Spectrum((slowest,))
    return Choice(spectrum, error, kind), Smoothness(spectrum, 0.1, np.array([0.2]), np.array([exponent]))


@pytest.mark.parametrize(
    ("exponents", "best"),
    [((0.5, 0.9, 0.95), 1), ((0.9, 0.9, 0.9), 0), ((0.5, 0.6, 0.3), 1), ((np.nan, np.nan, 0.99), 2)],
)
def test_the_least_error_of_a_smooth_interval_or_the_smoothest(exponents, best):
    rows = [one(-1.0 - i, exponent, 1.0 + i) for i, exponent in enumerate(exponents)]
    rows.append(one(-1.5, 1.0, 0.1, PAPERS))  # for comparison only
    found = Judged(*map(list, zip(*rows, strict=True)))
    assert found.best is found.choices[best]


def test_the_command_writes_what_training_takes(tmp_path, capsys):
    options = ["--pipeline", "spinn", "--duration", "4", "--measurement-noise", "0.2", "--out", str(tmp_path)]
    main(["tune", SYSTEM, *options])
    assert {"config.json", "intervals.csv"} == {path.name for path in tmp_path.iterdir()}
    changes, rows = read_changes(tmp_path / "config.json"), pd.read_csv(tmp_path / "intervals.csv")
    candidates = intervals(Oscillator(), 0.01)
    assert changes["eigenvalues"] in [candidate.eigenvalues for candidate in candidates]
    assert override(preset(Oscillator(), "spinn", "fast"), changes).eigenvalues == changes["eigenvalues"]
    smooth = rows[(rows.kind == CANDIDATE) & (rows.exponent > 0.85)]
    assert smooth.loc[smooth.error.idxmin()].slowest == pytest.approx(changes["eigenvalues"][0], rel=1e-4)
    assert list(rows.kind) == [CANDIDATE] * len(candidates) + [PAPERS]
    papers = Spectrum(papers_spectrum(Oscillator()))
    (alone,) = smoothness(Oscillator(), [papers], 0.01)
    assert rows.roughness.iloc[-1] == pytest.approx(alone.roughness.max(), rel=1e-4)
    assert rows.error.iloc[-1] == pytest.approx(Probe(Oscillator(), duration=4.0).error(papers, 0.2), rel=1e-4)
    shown = capsys.readouterr().out
    assert "--pipeline spinn" in shown
    assert "outside the paper's" in shown


def test_no_check_of_intervals():
    with pytest.raises(SystemExit, match="check trains input-aware maps"):
        main(["tune", SYSTEM, "--pipeline", "spinn", "--check", "1"])


def test_judging_tells_how_far_it_is():
    told = []
    found = judge(Oscillator(), 0.05, duration=10.0, measurement_noise=0.2, report=told.append)
    assert told == pytest.approx(np.arange(1, 2 * len(found.choices) + 1) / (2 * len(found.choices)))
