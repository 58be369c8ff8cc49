"""The demo's observer in JavaScript, run by Node, against KKLObserver."""

import json
import runpy
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from error_bars import with_error_bars
from exported_steps import MAPS, apart, exported_of, in_doubles, mapped, motion, noise, operated, stepped, tracked
from random_tracking import KINDS, signals, tracking

from observers import KKLObserver, Limits
from training.export.exported import Exported

REPLAY, DEMO = Path(__file__).parent / "helpers" / "replay.mjs", Path(__file__).parents[1] / "docs" / "demo"
write_step = runpy.run_path(str(DEMO / "step_file.py"))["write_step"]
pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="there is no Node.js, node")


def replayed(exported, folder, y, u, levels=None):
    """Estimates, scores and covariances of the JavaScript observer along a record; NaN marks missing outputs."""
    write_step(folder / "step.safetensors", exported)
    shutil.copy(DEMO / "kkl_observer.js", folder / "kkl_observer.mjs")
    rows = [None if np.isnan(row).all() else [None if np.isnan(value) else value for value in row] for row in y]
    done = subprocess.run(
        ["node", REPLAY, folder / "kkl_observer.mjs", folder / "step.safetensors"],
        input=json.dumps({"y": rows, "u": u.tolist(), "noise": levels}),
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return {name: np.array(values) for name, values in json.loads(done.stdout).items() if None not in values}


def watched(artifact, y, u, levels, **options):
    """Estimates and scores of KKLObserver along a record."""
    observer = KKLObserver(artifact, levels, monitor=True, **options)
    x_hat, score = [observer.reset(y[0])], [0.0]
    for sample, held in zip(y[1:], u, strict=False):
        x_hat.append(observer.step(None if np.isnan(sample).all() else sample, held))
        score.append(float(observer.score))
    return np.array(x_hat), np.array(score)


@pytest.mark.parametrize("index", range(len(MAPS)))
def test_every_kind_of_map(index, tmp_path):
    exported, y, u, expected = mapped(index)
    assert apart(exported, replayed(exported, tmp_path, y[:, 1], u[:, 1])["x_hat"], expected[:, 1]) < 1e-9


@pytest.mark.parametrize("index", range(len(KINDS)))
def test_maps_that_track(index, tmp_path):
    exported, y, u, expected = tracked(index)
    assert apart(exported, replayed(exported, tmp_path, y, u)["x_hat"], expected) < 1e-9


def test_equations_of_all_operations(tmp_path):
    exported, y, u, expected = operated(["atan2", ["u", 0], ["x", 1]])
    assert apart(exported, replayed(exported, tmp_path, y, u)["x_hat"], expected) < 1e-9


def test_process_noise_that_is_no_feature_of_t_inv_changes_the_tracker(tmp_path):
    exported, y, u, _ = tracked(0)
    other = replace(exported, process_noise=2.0)
    found = replayed(other, tmp_path, y[:200], u[:200])["x_hat"]
    assert apart(exported, found, in_doubles(other, y[:200], u[:200])) < 1e-9


@pytest.mark.parametrize("name", ["lorenz", "lorenz-spinn"])
def test_shipped_maps_with_monitor_and_missing_samples(name, tmp_path):
    exported = Exported.read(name)
    y, u = motion(exported.artifact, 900)
    y = y + np.random.default_rng(0).normal(scale=0.2, size=y.shape)
    y[300:350] = np.nan
    y[700:] = y[700]  # a frozen sensor
    found = replayed(exported, tmp_path, y, u, levels=[0.2, 0.01])
    x_hat, score = watched(exported.artifact, y, u, 0.2, process_noise=0.01)
    assert apart(exported, found["x_hat"], x_hat) < 1e-4
    assert 0 < max(score[:700]) < 1 < score[-1]
    assert np.allclose(found["score"], score, rtol=1e-3, atol=1e-4)


def test_several_outputs_of_which_one_is_missing(make_artifact, tmp_path):
    artifact = make_artifact(outputs=2, pair=True)
    tables = np.array([[1.0, 2.0], [2.0, 3.0], [3.0, 8.0]])
    levels = np.array([[0.0, 0.0], [0.5, 1.0], [1.0, 2.0]])
    limits = Limits(levels, tables, 0.01 * tables, 5 * tables, 0.5, 0.1, 0.01, 9.0)
    artifact = replace(artifact, C=np.array([[1.0, 0.5], [0.0, 2.0]]), limits=limits)
    y, u = noise(artifact, 200)
    y[100:120, 1] = y[140:160, 0] = np.nan
    found = replayed(exported_of(artifact, tmp_path), tmp_path, y, u, levels=[[0.3, 0.9]])
    x_hat, score = watched(artifact, y, u, (0.3, 0.9))
    assert np.abs(found["x_hat"] - x_hat).max() < 1e-3
    assert np.allclose(found["score"], score, rtol=1e-4)


def error_bars_of_maps(make_artifact):
    for process, options in ((False, {"free_inverse": True}), (True, {"estimated": True})):
        artifact = with_error_bars(make_artifact(process=process, system="lorenz", **options))
        yield artifact, *noise(artifact, 120)


def error_bars_of_trackers(make_artifact):
    for index in (1, 5, 7):
        artifact = tracking(**KINDS[index])
        y, u = signals(artifact, 200)
        y[3:9] = np.nan
        u[7:] += 0.1  # from a sample within the first window
        yield artifact, y, u


@pytest.mark.parametrize("cases", [error_bars_of_maps, error_bars_of_trackers])
def test_error_bars(cases, make_artifact, tmp_path):
    for artifact, y, u in cases(make_artifact):
        exported, process = exported_of(artifact, tmp_path), artifact.process_noise_max is not None
        other = replace(exported, measurement_noise=0.7, process_noise=0.05 if process else exported.process_noise)
        found = replayed(exported, tmp_path, y, u, levels=(0.7, 0.05) if process else (0.7,))["covariance"]
        for k, observer in enumerate(stepped(other, y, u)):
            expected = observer.covariance
            assert np.allclose(found[k], expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max()), k


SAMPLES = ["0.5", "[]", "undefined", "[1, 2]", "[Infinity]", '["abc"]', "[1n]", "({})", "Object.create(null)"]
INPUTS = ["[]", "[NaN]", "[null]", "0.5", "null"]
REFUSED = f"""
    import {{ readFileSync }} from "node:fs";
    import {{ Observer }} from "./kkl_observer.mjs";
    const bytes = readFileSync("step.safetensors");
    const observer = new Observer(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
    const refused = (call) => {{ try {{ call(); console.log("taken"); }} catch (e) {{ console.log(e.message); }} }};
    const samples = [{", ".join(SAMPLES)}], inputs = [{", ".join(INPUTS)}];
    refused(() => observer.step([1]));
    for (const y of [[null], [NaN], ...samples]) refused(() => observer.reset(y));
    observer.reset([1]);
    for (const y of samples) refused(() => observer.step(y));
    for (const u of inputs) refused(() => observer.step([1], u));
    const z = [...observer.z];
    observer.reset([1]);
    if (z.some((value, i) => value !== observer.z[i])) throw new Error("the filter has moved");
"""


def test_invalid_samples_and_inputs_are_refused(make_artifact, tmp_path):
    write_step(tmp_path / "step.safetensors", exported_of(make_artifact(), tmp_path))
    shutil.copy(DEMO / "kkl_observer.js", tmp_path / "kkl_observer.mjs")
    done = subprocess.run(["node", "--input-type=module", "-e", REFUSED], cwd=tmp_path, capture_output=True, text=True)
    samples = ["an object" if "(" in sample else sample.replace("1n", "1") for sample in SAMPLES]
    wanted = [
        "call reset(y0) before step",
        *(f"the first sample has 1 finite outputs, got {each}" for each in ("[null]", "[NaN]", *samples)),
        *(f"a sample has 1 outputs, NaN where one is missing, or is null, got {each}" for each in samples),
        *(f"an input has 1 finite entries, got {each}" for each in INPUTS),
    ]
    assert not done.stderr
    assert [line.replace(" ", "") for line in done.stdout.splitlines()] == [line.replace(" ", "") for line in wanted]
