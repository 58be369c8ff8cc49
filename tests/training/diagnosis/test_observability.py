"""Verdicts on signals whose observability follows from physics."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy
from recorded_runs import as_csv, swing

import training
from training.cli import main
from training.diagnosis import Observability, of_records
from training.diagnosis.records import left_by
from training.records import Record, Signals


def looked(env_id, measured, hidden, **changes):
    wanted = {"steps": 3000, "measurement_noise": [], "seed": 1} | changes
    return training.observability(env_id, measured=measured, hidden=hidden, **wanted)


def verdicts(found):
    return {judged.signal: judged for judged in found.judgements}


def test_pendulums_rate_is_determined_by_its_angle():
    found = looked("Pendulum-v1", [0, 1], [2], measurement_noise=[0.05])
    (rate,) = found.judgements
    assert found.dt == pytest.approx(0.05)
    assert rate.verdict == "determined"
    assert 1 <= rate.window <= 8
    assert found.errors[0, found.windows.index(8), 0] < 0.05
    assert found.errors[0, 0, 0] > 0.9  # one angle alone does not determine the rate
    of_differences = 0.05 * np.sqrt(2) / 0.05 / 3  # error of differences of angles, relative to 3 rad/s
    assert 2 * rate.errors[0] < rate.errors[1] < of_differences


def test_cart_poles_place_is_seen_up_to_a_constant_by_its_velocities():
    found = verdicts(looked("CartPole-v1", [1, 3], [0, 2]))
    assert found["obs[0]"].verdict == "up to a constant"
    assert found["obs[0]"].errors[0] > 0.2
    assert found["obs[2]"].verdict == "determined"


def wandering(records=40, n=150, a=0.95):
    rng = np.random.default_rng(0)
    x = scipy.signal.lfilter([1.0], [1.0, -a], rng.normal(size=(records, n + 100)))[:, 100:, None]
    t = np.arange(n) + 0.0
    return [Record(f"{i}", t, each, x=each, source="wandering") for i, each in enumerate(x)]


def test_unobserved_signals_are_not_determined():
    rng, records = np.random.default_rng(0), wandering()
    for i, record in enumerate(records):  # hidden: noise, a constant per record, a common constant
        x = np.stack([rng.normal(size=len(record.t)), np.full(len(record.t), rng.normal()), np.ones(len(record.t))], 1)
        records[i] = replace(record, x=x, signals=Signals("t", ("y1",), (), ("noise", "weight", "one")))
    found = verdicts(of_records(records, measurement_noise=[]))
    for name in ("noise", "weight"):
        assert (found[name].verdict, found[name].window) == ("not determined", None)
    assert found["one"].verdict == "never moves"


def test_errors_under_noise_are_those_of_a_kalman_filter():
    a, levels = 0.95, [0.5, 2.0]
    found = of_records(wandering(a=a), measurement_noise=levels)
    assert found.noise == (0.0, 0.5, 2.0)
    size = np.concatenate([record.y for record in wandering(20, 50)]).std()
    assert of_records(wandering(20, 50)).noise == pytest.approx((0.0, 0.01 * size, 0.1 * size), rel=0.01)
    for level, error in zip(levels, found.judgements[0].errors[1:]):
        before = scipy.linalg.solve_discrete_are([[a]], [[1.0]], [[1.0]], [[level**2]])[0, 0]
        after = before * level**2 / (before + level**2)
        assert error == pytest.approx(np.sqrt(after * (1 - a**2)), rel=0.12)


def test_too_little_data_is_warned_of():
    short = of_records(wandering(30, 16), measurement_noise=[])
    assert short.windows == (0, 1, 2, 4)
    assert short.warnings == ("too few samples for windows of 8 steps or more; record longer episodes",)
    few = [replace(record, t=0.1 * record.t, source="") for record in wandering(3, 2000)]
    assert "fewer than 5 records" in of_records(few, measurement_noise=[]).warnings[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measurement_noise": [(0.1, 0.2)]}, "one for each of 1 outputs"),
        ({"measurement_noise": 0.1}, r"must be a list of levels, as in \[0.1, 0.3\], got 0.1"),
        ({"records": []}, "no records are given"),
        ({"records": wandering(2, 8)}, "16 samples are too few to judge x1"),
        ({"records": [replace(wandering(1)[0], x=None, signals=Signals())]}, "no hidden states were recorded"),
    ],
)
def test_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        of_records(**{"records": wandering(6, 20)} | changes)
    with pytest.raises(ValueError, match="cannot make 'None-v0'"):
        looked("None-v0", [0], [1])


NONE = [np.nan] * 3


@pytest.mark.parametrize(
    ("errors", "changes", "verdict", "window"),
    [
        ([0.9, 0.04, 0.01], [np.nan, 0.5, 0.5], "determined", 1),
        ([0.5, 0.3, 0.29], [np.nan, 0.5, 0.5], "partly (29 % left)", 1),
        ([0.9, 0.41, 0.4], [np.nan, 0.3, 0.03], "up to a constant", 2),
        ([0.9, 0.07, 0.07], [np.nan, 0.02, 0.02], "partly (7 % left)", 1),  # the change has no smaller error
        ([0.99, 0.95, 1.0], NONE, "not determined", None),
        (NONE, NONE, "never moves", None),
    ],
)
def test_verdicts(errors, changes, verdict, window):
    errors, changes = np.reshape(errors, (1, -1, 1)), np.reshape(changes, (-1, 1))
    of = {"errors": errors, "changes": changes, "warnings": ("too few; record more",)}
    every = Observability(("y",), ("u",), ("x",), dt=0.1, windows=(0, 1, 2), noise=(0.0,), **of)
    (found,) = every.judgements
    assert (found.verdict, found.window) == (verdict, window)
    signals, line, data = every.findings()
    assert signals.found == "x from y and u, in steps of 0.1 s"
    assert line.found.startswith(f"x: {verdict}")
    assert line.verdict == {"determined": "ok", "not determined": "problem"}.get(verdict, "note")
    assert (data.verdict, data.found, data.advice) == ("note", "too few", "record more")


def shown(arguments, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    main(["diagnose", *arguments])
    return capsys.readouterr().out


def test_the_command_on_records(capsys, tmp_path, monkeypatch):
    files = [as_csv(tmp_path / f"{i}.csv", swing(i, n=200)) for i in range(6)]
    options = ["--measured", "position", "--inputs", "force", "--hidden", "speed", "--measurement-noise", "0.5"]
    text = shown(["--data", *files, *options, "--json", str(tmp_path / "found.json")], capsys, monkeypatch)
    assert "speed from position and force" in text
    found = json.loads((tmp_path / "found.json").read_text())
    assert found[1]["found"].startswith("speed: determined from")


def samples(n, modes, seed):
    return np.random.default_rng(seed).uniform(-1, 1, (n, modes))


def test_left_by_is_the_part_of_x_that_z_does_not_determine():
    z, others = samples(500, 3, 0), samples(6000, 3, 1)
    noise, others_noise = (np.sqrt(3) * samples(n, 1, 2)[:, 0] for n in (500, 6000))  # variance 1

    def x(z, noise):
        bent = np.sin(2 * z[:, 0]) * z[:, 1]
        return np.stack([bent, bent + 0.3 * noise, 2 * z[:, 2] + noise, noise, 0 * noise], -1)

    left = left_by(z, x(z, noise), others, x(others, others_noise))
    size = x(z, noise).std(0)
    assert left[0] < 0.05
    np.testing.assert_allclose(left[1:4] * size[1:4], [0.3, 1.0, 1.0], rtol=0.1)
    assert np.isnan(left[4])
