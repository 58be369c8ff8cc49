"""Choosing a spectrum, against closed forms on a linear system."""

import json
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import linear_system
import numpy as np
import pandas as pd
import pytest
from linear_system import F, Oscillator
from scipy.linalg import expm
from scipy.stats import spearmanr

import training.tuning.check
import training.tuning.probe
from kkl_gym import SYSTEMS, get_system
from kkl_gym.simulate import simulate
from observers import load
from training.cli import main
from training.config import read_changes
from training.kalman import ExtendedKalmanFilter
from training.presets import preset
from training.seeds import Stream, generator
from training.trajectories.derivatives import with_sensitivity
from training.tuning import Probe, Spectrum
from training.tuning.check import rank_correlation

SPECTRUM = Spectrum((-2.0, -0.7), ((-0.3, 1.0),))


@pytest.fixture(scope="module")
def probe():
    return Probe(Oscillator(), duration=6.0, motions=8)


def test_motions_start_where_no_other_stream_of_random_numbers_does():
    drawn = generator(Stream.TUNING, 3).uniform(*Oscillator().box(), (16, 2))
    np.testing.assert_array_equal(Probe(Oscillator(), duration=6.0, motions=8, seed=3).x[0], drawn[:8])
    with pytest.raises(ValueError, match="seed = -1"):
        Probe(Oscillator(), seed=-1)


def relative(probe, covariance):
    """What a covariance at each of the probe's ages amounts to."""
    root = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    size = np.linalg.norm(probe.x[probe.ages], axis=-1)
    return 100 * probe.share @ np.minimum(root[:, None] / size, 2.0).mean(1)


def test_no_linear_decoder_of_noisy_z_does_better_and_one_does_as_well(probe, monkeypatch):
    monkeypatch.setattr(training.tuning.probe, "RESOLUTION", 0.0)
    rng, n, sigma = np.random.default_rng(0), 8000, 0.4
    flow = expm(np.array([[0.0, 0.01], [-0.01, 0.0]]))
    x = [rng.normal(size=(n, 2)) / np.sqrt(np.diag(probe._known))]
    for _ in range(600):
        x.append(x[-1] @ flow.T)
    y = probe.system.output(np.array(x)) + sigma * rng.normal(size=(601, n, 1))
    linear = Spectrum(SPECTRUM.eigenvalues, SPECTRUM.pairs).filter(1, 0.01)
    z = linear.run(y, np.zeros((600, n, 0)), probe.ages)
    left = []
    for i, age in enumerate(probe.ages):
        best, *_ = np.linalg.lstsq(z[i], x[age], rcond=None)
        error = x[age] - z[i] @ best
        left.append(error.T @ error / (n - z.shape[-1]))
    assert relative(probe, np.array(left)) == pytest.approx(probe.error(SPECTRUM, sigma), rel=0.02)


def test_the_least_error_is_that_of_a_kalman_filter(probe):
    kalman = ExtendedKalmanFilter(
        probe.system, 0.01, Q=np.zeros((2, 2)), R=0.09 * np.eye(1), start=(np.zeros(2), np.linalg.inv(probe._known))
    )
    kalman.reset(probe.y[0])
    P = [kalman.P[0]]
    for y in probe.y[1:]:
        kalman.step(y)
        P.append(kalman.P[0])
    assert relative(probe, np.array(P)[probe.ages]) == pytest.approx(probe.least(0.3), rel=1e-6)
    assert probe.least(0.3) < probe.error(SPECTRUM, 0.3)


def test_errors_fall_with_modes_and_those_of_the_library_are_those_of_the_spectrum(probe):
    found = probe.choose(0.3, 7)
    assert 3 <= found[-1].spectrum.modes <= 7
    alone = [probe.error(Spectrum((value,)), 0.3) for value in probe.library.eigenvalues]
    alone += [probe.error(Spectrum((), (pair,)), 0.3) for pair in probe.library.pairs]
    assert min(alone) >= found[1].error
    assert probe.error(found[-1].spectrum, 0.3) == pytest.approx(found[-1].error, rel=1e-5)
    assert probe.least(0.3) < found[-1].error < probe.error(Spectrum((-2.0, -0.7)), 0.3)


def test_more_noise_is_worse_and_slower_modes_average_it(probe):
    assert probe.error(SPECTRUM, 0.1) < probe.error(SPECTRUM, 0.4)
    slow, fast = Spectrum((), ((-0.5, 1.0),)), Spectrum((), ((-5.0, 1.0),))
    assert probe.error(slow, 0.5) < probe.error(fast, 0.5)


def test_bessel_filters_have_their_poles(probe):
    (third,) = probe.bessel(0.1, [3], [2.0])
    assert third.spectrum.modes == 3
    poles = [*third.spectrum.eigenvalues, *(complex(*pair) for pair in third.spectrum.pairs)]
    s = 2.0j  # at the cutoff the gain is down by 3 dB
    gain = np.prod(
        [abs(p) / abs(s - p) * (abs(p) / abs(s - np.conj(p)) if isinstance(p, complex) else 1) for p in poles]
    )
    assert gain == pytest.approx(1 / np.sqrt(2), rel=1e-6)


class Escaping(Oscillator):
    name = "escaping"

    def f(self, x):
        return 5.0 * x[0], 5.0 * x[1]


def test_a_system_whose_motions_leave_its_bounds():
    with pytest.raises(ValueError, match="stayed within the bounds"):
        Probe(Escaping(), duration=5.0)


@dataclass(frozen=True)
class Decaying(Oscillator):
    """Underflows to zero within a second or two; two outputs of different size, one of them at rest."""

    name = "decaying"

    def f(self, x):
        return -400.0 * x[0] + x[1], -500.0 * x[1]

    def h(self, x):
        return x[0] + 1e3 * x[1], 0.0 * x[0]


def test_motions_that_end_in_a_point():
    probe = Probe(Decaying(), dt=0.004, duration=4.0, motions=2)
    assert np.abs(probe.x[-1]).max() < 1e-300
    (*_, last) = probe.choose(0.3, 5)
    assert 0 < last.error < 200


@dataclass(frozen=True)
class Seen(Oscillator):
    """Both states are outputs."""

    name = "seen"

    def h(self, x):
        return x[0], x[1]


def test_several_outputs_have_all_modes_each():
    probe = Probe(Seen(), duration=6.0, motions=4)
    found = probe.choose(0.3, 4)
    assert probe.error(found[-1].spectrum, 0.3) == pytest.approx(found[-1].error, rel=1e-6)
    one = Probe(Oscillator(), duration=6.0, motions=4)
    assert found[-1].error < one.error(found[-1].spectrum, 0.3)


@dataclass(frozen=True)
class Still(Oscillator):
    """An output that tells nothing."""

    name = "still"

    def h(self, x):
        return (0.0 * x[0],)


def test_an_output_that_does_not_move_leaves_the_start_unknown():
    probe = Probe(Still(), duration=6.0, motions=4)
    assert not len(probe.frequencies)
    (only,) = probe.choose(0.3)
    assert only.error == pytest.approx(
        relative(
            probe,
            np.array(
                [expm(age * 0.01 * F) @ np.linalg.inv(probe._known) @ expm(age * 0.01 * F).T for age in probe.ages]
            ),
        ),
        rel=1e-4,
    )


def test_chaotic_motions_are_followed_as_far_as_numbers_go():
    """The recursion of Riccati, which forgets what is lost, against the sum over all samples."""
    probe = Probe(get_system("lorenz"), dt=0.02, duration=20.0, motions=2)
    assert 1e4 < np.abs(probe.Phi).max() < 1e5
    assert len(probe.x) < 900
    P, nx = np.broadcast_to(np.linalg.inv(probe._known), (2, 3, 3)), 3
    H, R, left = np.array([[0.0, 1.0, 0.0]]), 0.25, []
    for k in range(len(probe.x)):
        if k:
            joint = np.hstack([probe.x[k - 1], np.tile(np.eye(nx).ravel(), (2, 1))])
            step = simulate(with_sensitivity(probe.system, driven=False), joint, 1, 0.02)[1][:, nx:].reshape(2, nx, nx)
            P = step @ P @ step.mT
        K = P @ H.T / (H @ P @ H.T + R)
        P = (np.eye(nx) - K @ H) @ P
        left.append(P)
    root = np.sqrt(np.trace(np.array(left)[probe.ages], axis1=-2, axis2=-1))
    size = np.linalg.norm(probe.x[probe.ages], axis=-1)
    expected = 100 * probe.share @ np.minimum(root / size, 2.0).mean(1)
    assert probe.least(0.5) == pytest.approx(expected, rel=1e-3)


def test_the_command_writes_what_training_takes(tmp_path, capsys):
    system, chosen = str(Path(linear_system.__file__)) + ":Oscillator", {}
    for noise in ("0", "0.5"):
        folder = tmp_path / noise
        main(["tune", system, "--measurement-noise", noise, "--duration", "4", "--modes", "3", "--out", str(folder)])
        chosen[noise] = read_changes(folder / "config.json")
        assert {"config.json", "front.csv", "front.png"} == {path.name for path in folder.iterdir()}
    assert chosen["0"]["eigenvalues"] != chosen["0.5"]["eigenvalues"]
    assert (chosen["0"]["measurement_noise_max"], chosen["0.5"]["measurement_noise_max"]) == (0.002, 2.0)
    assert (chosen["0"]["noise_free_share"], chosen["0.5"]["noise_free_share"]) == (0.9, 0.05)
    assert chosen["0"]["high_noise_emphasis"] == chosen["0.5"]["high_noise_emphasis"] == 4.0
    small = ["--trajectories", "10", "--duration", "2", "--samples", "20", "--width", "8", "--inverse-steps", "3"]
    config = ["--config", str(tmp_path / "0.5" / "config.json"), "--no-monitor", "--out", str(tmp_path / "run")]
    main(["train", system, *config, *small, "--batch", "64"])
    described = json.loads((tmp_path / "run" / "config.json").read_text())
    assert described["pairs"] == [list(pair) for pair in chosen["0.5"]["pairs"]]
    assert described["width"] == 8


def test_what_is_known_of_a_linear_system_does_not_depend_on_the_policy(probe):
    """It is its inputs that a policy chooses, which the observer knows."""
    driven = Probe(Oscillator(), duration=6.0, motions=8, policy=lambda x: np.tanh(x[:, :1]))
    np.testing.assert_array_equal(driven.x[0], probe.x[0])
    assert (np.abs(driven.x[-1] - probe.x[-1]) > 0.01).any(1).all()
    np.testing.assert_allclose(driven.Phi, probe.Phi, rtol=1e-9)
    np.testing.assert_allclose(driven.error_of_states(None, 0.3), probe.error_of_states(None, 0.3), rtol=1e-9)


@dataclass(frozen=True)
class Unstable(Oscillator):
    """A saddle, which runs away within seconds without a policy."""

    name = "saddle"
    X = ((-0.2, 0.2), (-0.2, 0.2))
    bounds = ((-2.0, 2.0), (-2.0, 2.0))
    u_max = (2.0,)

    def f(self, x):
        return x[1], 4.0 * x[0]


def test_plants_that_run_away_take_a_policy(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tune = ["tune", f"{__file__}:Unstable", "--measurement-noise", "0.01", "--duration", "6", "--modes", "2"]
    with pytest.raises(SystemExit, match=r"of 80 motions from X only 0 stayed within the bounds; .* \(--policy\)"):
        main(tune)
    main([*tune, "--policy", "controller"])
    again = "".join(capsys.readouterr().out.split()).rpartition("withit:")[2]  # lines break anywhere
    config = "runs/tuning/saddle-controller-0.01/config.json"
    assert again == "".join(f"kkl-gym train {__file__}:Unstable --config {config} --policy controller".split())
    assert len(json.loads((tmp_path / config).read_text())["eigenvalues"]) == 2


def test_results_lie_under_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    system = str(Path(linear_system.__file__)) + ":Oscillator"
    main(["tune", system, "--measurement-noise", "0.25", "--duration", "4", "--modes", "2"])
    front = pd.read_csv(tmp_path / "runs" / "tuning" / "oscillator-0.25" / "front.csv")
    assert list(front) == ["noise", "kind", "modes", "error"]
    assert set(front.noise) == {0.0, 0.05, 0.25, 0.5}


def test_noise_and_sampling_interval_are_the_systems_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["--duration", "4", "--modes", "2"]
    main(["tune", f"{linear_system.__file__}:TwoOutputs", *small])
    folder = tmp_path / "runs" / "tuning" / "two-outputs-0.1-0.3"
    assert json.loads((folder / "config.json").read_text())["measurement_noise_max"] == [0.4, 1.2]
    noise = pd.read_csv(folder / "front.csv").noise.unique()
    assert noise.tolist() == ["0.0", "0.02, 0.06", "0.1, 0.3", "0.2, 0.6"]
    main(["tune", f"{linear_system.__file__}:Reactor", "--measurement-noise", "0", *small])
    folder = tmp_path / "runs" / "tuning" / "reactor-0"
    assert json.loads((folder / "config.json").read_text())["dt"] == 0.05
    assert pd.read_csv(folder / "front.csv").noise.unique().tolist() == [0.0, 0.4, 2.0]


def test_choices_begin_with_given_modes(probe):
    given = Spectrum(probe.library.eigenvalues[:2], probe.library.pairs[:1])
    begun = replace(probe, start=given)
    found = begun.choose(0.5, most=8)
    assert found[0].spectrum == given
    assert found[0].error == pytest.approx(probe.error(given, 0.5), rel=1e-6)
    for before, after in pairwise(found):
        assert after.error < before.error
        assert after.spectrum.eigenvalues[:2] == given.eigenvalues
        assert len(set(after.spectrum.poles)) == after.spectrum.modes  # none twice
    assert 4 < found[-1].spectrum.modes <= 8
    anew = begun.choose(0.5, most=8, anew=True)
    assert [choice.spectrum for choice in anew] == [choice.spectrum for choice in probe.choose(0.5, most=8)]


def test_what_is_written_begins_with_the_default(tmp_path):
    system = str(Path(linear_system.__file__)) + ":Oscillator"
    main(["tune", system, "--duration", "4", "--modes", "15", "--out", str(tmp_path)])
    default = preset(Oscillator(), "input-aware", "fast").eigenvalues
    assert read_changes(tmp_path / "config.json")["eigenvalues"][: len(default)] == default


def test_predictions_are_compared_with_trained_observers(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(training.tuning.check, "TRAJECTORIES", 20)
    system = str(Path(linear_system.__file__)) + ":Oscillator"
    main(["tune", system, "--duration", "4", "--modes", "5", "--check", "0.3", "--jobs", "1", "--out", str(tmp_path)])
    rows = pd.read_csv(tmp_path / "check.csv")
    assert {"chosen", "paper's", "Bessel"} <= set(rows.kind)
    assert rows.trained.between(0.1, 150).all()
    expected = spearmanr(rows.predicted, rows.trained).statistic
    assert f"rank correlation {expected:.2f}, of {len(rows)} spectra" in capsys.readouterr().out
    assert np.isnan(rank_correlation([1.0, 2.0], [1.0, 2.0]))


@pytest.mark.parametrize(
    "options",
    [
        ["--measurement-noise", "-1"],
        ["--modes", "0"],
        ["--duration", "0"],
        ["--dt", "0"],
        ["--check", "0"],
        ["--policy", "controller", "--check", "1"],
        ["--policy", "controller", "--pipeline", "spinn"],
    ],
)
def test_bad_options(options, tmp_path):
    with pytest.raises(SystemExit, match="must"):
        main(["tune", "lorenz", *options, "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no JSON"),
        ("[1]", "object of settings"),
        ('{"modes": 3}', "modes"),
        ('{"pipeline": "spinn"}', "pipeline"),
        ('{"eigenvalues": -1}', "eigenvalues"),
        ('{"eigenvalues": ["-1"]}', "eigenvalues"),
        ('{"pairs": [[-1, 2, 3]]}', "pairs"),
        ('{"samples": 20.5}', "samples"),
        ('{"dt": true}', "dt"),
        ('{"free_inverse": 1}', "free_inverse"),
        ('{"activation": "relu"}', "activation"),
        ('{"cpu_seconds": "a"}', "cpu_seconds"),
    ],
)
def test_files_that_hold_no_settings(text, message, tmp_path):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_changes(tmp_path / "c.json")


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_command_trains_as_the_shipped_maps_were_trained(name):
    config = preset(get_system(name), "input-aware", "fast")
    made, now = load(name).artifact.training, json.loads(json.dumps(asdict(config)))
    same = {entry: value for entry, value in now.items() if entry in made}
    assert {"eigenvalues", "pairs", "inverse_steps", "learning_rate", "process_noise_share"} <= set(same)
    for entry, value in same.items():
        assert value == made[entry], entry


def test_a_file_of_settings(tmp_path):
    (tmp_path / "c.json").write_text(
        '{"eigenvalues": [-1, -2.5], "pairs": [[-1, 2]], "cpu_seconds": null, "samples": 20}'
    )
    assert read_changes(tmp_path / "c.json") == {
        "eigenvalues": (-1, -2.5), "pairs": ((-1, 2),), "cpu_seconds": None, "samples": 20,
    }  # fmt: skip


@dataclass(frozen=True)
class InOtherUnits(Oscillator):
    """The oscillator with x2 in thousandths, about another point."""

    name = "in-other-units"
    X = ((4.0, 6.0), (6000.0, 8000.0))
    bounds = ((-25.0, 35.0), (-23000.0, 37000.0))

    def f(self, x):
        return 1e-3 * x[1] - 7.0, -1e3 * (x[0] - 5.0)

    def h(self, x):
        return (x[0],)


def test_predictions_do_not_depend_on_the_units_of_states(probe):
    other = Probe(InOtherUnits(), duration=6.0, motions=8)
    assert other.error(SPECTRUM, 0.3) == pytest.approx(probe.error(SPECTRUM, 0.3), rel=1e-6)
    assert other.least(0.3) == pytest.approx(probe.least(0.3), rel=1e-6)
    in_units = probe.error_of_states(SPECTRUM, 0.3) * [1.0, 1000.0]
    np.testing.assert_allclose(other.error_of_states(SPECTRUM, 0.3), in_units, rtol=1e-6)


def test_errors_of_states_are_those_of_a_kalman_filter(probe):
    start, noise = np.linalg.inv(probe._known), 0.3
    expected = []
    for age in probe.ages:
        flow = np.array([expm(k * 0.01 * F) for k in range(age + 1)])
        known = np.linalg.inv(start) + sum(np.outer(row, row) for row in flow[:, 0]) / noise**2
        expected.append(np.sqrt(np.diag(flow[-1] @ np.linalg.inv(known) @ flow[-1].T)))
    np.testing.assert_allclose(probe.error_of_states(None, noise), probe.share @ np.array(expected), rtol=1e-6)
    assert (probe.error_of_states(SPECTRUM, noise) > probe.error_of_states(None, noise)).all()
    unknown = probe.unknown_of_starts(noise)  # of the start, in its own standard deviations
    np.testing.assert_allclose(
        unknown, np.linalg.inv(known) * np.sqrt(np.outer(*2 * [np.diag(probe._known)])), rtol=1e-6
    )


def test_outputs_may_be_noisy_to_different_degrees():
    probe, one = (Probe(system, duration=6.0, motions=4) for system in (Seen(), Oscillator()))
    assert probe.error(SPECTRUM, (0.3, 0.3)) == probe.error(SPECTRUM, 0.3)
    assert probe.least((0.3, 1e6)) == pytest.approx(one.least(0.3), rel=1e-6)
    assert probe.error(SPECTRUM, (0.3, 1e6)) == pytest.approx(one.error(SPECTRUM, 0.3), rel=1e-4)


def test_starts_are_drawn_as_the_system_says():
    @dataclass(frozen=True)
    class OnACircle(Oscillator):
        name = "on-a-circle"

        def draw_starts(self, rng, n, factor=1.0):
            angle = rng.uniform(0, 2 * np.pi, n)
            return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    probe = Probe(OnACircle(), duration=2.0, motions=4)
    np.testing.assert_allclose(np.linalg.norm(probe.x, axis=-1), 1.0, rtol=1e-6)
