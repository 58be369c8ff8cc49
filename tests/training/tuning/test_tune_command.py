"""``kkl-gym tune``: what it writes, and what that is worth."""

import json
import re

import linear_system
import numpy as np
import pandas as pd
import pytest
from linear_system import Oscillator
from scipy.stats import spearmanr

import training.tuning.check
import training.tuning.probe
from training.cli import main
from training.config import override, read_changes
from training.presets import preset
from training.smoothness import Smoothness, intervals, smoothness
from training.spectrum import Spectrum, papers_spectrum
from training.tuning import Choice, Probe
from training.tuning.check import rank_correlation
from training.tuning.intervals import CANDIDATE, PAPERS, Judged

OSCILLATOR = f"{linear_system.__file__}:Oscillator"


@pytest.fixture(autouse=True)
def _few_modes_to_choose_from(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(training.tuning.probe, "REAL_MODES", 6)
    monkeypatch.setattr(training.tuning.probe, "DECAYS", 2)


def test_a_spectrum_for_training_and_a_check_of_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(training.tuning.check, "TRAJECTORIES", 20)
    monkeypatch.setattr(training.tuning.check, "RUNS", 10)
    options = "--measurement-noise 0.5 --duration 4 --modes 12 --check 0.1 --jobs 1 --out out"
    main(["tune", OSCILLATOR, *options.split()])
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"config.json", "front.csv", "front.png"}
    chosen = read_changes(tmp_path / "out" / "config.json")
    default = preset(Oscillator(), "input-aware", "fast").eigenvalues
    assert chosen["eigenvalues"][: len(default)] == default
    wanted = {"measurement_noise_max": 2.0, "noise_free_share": 0.05, "high_noise_emphasis": 4.0, "dt": 0.01}
    assert {key: chosen[key] for key in wanted} == wanted
    front = pd.read_csv("out/front.csv")
    assert list(front) == ["noise", "kind", "modes", "error"]
    assert set(front.noise) == {0.0, 0.1, 0.5, 1.0}
    rows = pd.read_csv("out/check.csv")
    assert {"chosen", "paper's", "Bessel"} <= set(rows.kind)
    assert rows.trained.between(0.1, 150).all()
    said = re.search(r"rank correlation (\S+), of (\d+) spectra", capsys.readouterr().out)
    assert float(said[1]) == pytest.approx(spearmanr(rows.predicted, rows.trained).statistic, abs=0.05)
    assert int(said[2]) == len(rows)
    assert np.isnan(rank_correlation([1.0, 2.0], [1.0, 2.0]))
    small = "--trajectories 10 --duration 2 --samples 20 --width 8 --inverse-steps 3 --batch 64 --no-monitor --out run"
    main(["train", OSCILLATOR, "--config", "out/config.json", *small.split()])
    described = json.loads((tmp_path / "run" / "config.json").read_text())
    assert described["eigenvalues"] == list(chosen["eigenvalues"])
    assert (described["measurement_noise_max"], described["width"]) == (2.0, 8)


def test_noise_is_the_systems_own_and_results_lie_under_runs(tmp_path):
    main(["tune", f"{linear_system.__file__}:TwoOutputs", "--duration", "4", "--modes", "2"])
    folder = tmp_path / "runs" / "tuning" / "two-outputs-0.1-0.3"
    assert json.loads((folder / "config.json").read_text())["measurement_noise_max"] == [0.4, 1.2]
    noise = pd.read_csv(folder / "front.csv").noise.unique()
    assert noise.tolist() == ["0.0", "0.02, 0.06", "0.1, 0.3", "0.2, 0.6"]


class Saddle(Oscillator):
    """Runs away within seconds without a policy."""

    name, dt, u_max = "saddle", 0.05, (2.0,)
    X, bounds = ((-0.2, 0.2), (-0.2, 0.2)), ((-2.0, 2.0), (-2.0, 2.0))

    def f(self, x):
        return x[1], 4.0 * x[0]


def test_plants_that_run_away_take_a_policy(tmp_path, capsys):
    tune = ["tune", f"{__file__}:Saddle", "--measurement-noise", "0", "--duration", "6", "--modes", "2"]
    with pytest.raises(SystemExit, match=r"of 80 motions from X only 0 stayed within the bounds; .* \(--policy\)"):
        main(tune)
    main([*tune, "--policy", "controller"])
    again = "".join(capsys.readouterr().out.split()).rpartition("withit:")[2]  # lines break anywhere
    config = "runs/tuning/saddle-controller-0/config.json"
    assert again == "".join(f"kkl-gym train {__file__}:Saddle --config {config} --policy controller".split())
    chosen = json.loads((tmp_path / config).read_text())
    assert len(chosen["eigenvalues"]) + 2 * len(chosen["pairs"]) == 2
    assert (chosen["measurement_noise_max"], chosen["noise_free_share"], chosen["dt"]) == (0.0004, 0.9, 0.05)


def judged(slowest, exponent, error, kind=CANDIDATE):
    spectrum = Spectrum((slowest,))
    return Choice(spectrum, error, kind), Smoothness(spectrum, 0.1, np.array([0.2]), np.array([exponent]))


@pytest.mark.parametrize(
    ("exponents", "best"), [((0.5, 0.9, 0.95), 1), ((0.5, 0.6, 0.3), 1), ((np.nan, np.nan, 0.99), 2)]
)
def test_the_least_error_of_a_smooth_interval_or_the_smoothest(exponents, best):
    rows = [judged(-1.0 - i, exponent, 1.0 + i) for i, exponent in enumerate(exponents)]
    rows.append(judged(-1.5, 1.0, 0.1, PAPERS))  # for comparison only
    found = Judged(*map(list, zip(*rows, strict=True)))
    assert found.best is found.choices[best]


def test_an_interval_for_spinn(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("training.smoothness.FOLLOWED", 60.0)
    main(["tune", OSCILLATOR, "--pipeline", "spinn", "--duration", "4", "--measurement-noise", "0.2", "--out", "out"])
    changes, rows = read_changes(tmp_path / "out" / "config.json"), pd.read_csv("out/intervals.csv")
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
