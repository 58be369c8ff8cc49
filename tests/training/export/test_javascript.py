"""The step in JavaScript, run by Node, against the same in Python."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from error_bars import with_error_bars
from exported_steps import apart, exported_of, lost_and_inflated, motion, noise, stepped
from random_tracking import KINDS, signals, tracking

from observers import Expression, KKLObserver, Limits, load
from training.export import Exported
from training.export.step_file import javascript, write_step

REPLAY = Path(__file__).parents[2] / "helpers" / "replay.mjs"
pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="there is no Node.js, node")


def replayed(exported, folder, y, u, told=None):
    """What JavaScript makes of a record, in which NaN is missing."""
    write_step(folder / "step.safetensors", exported)
    (folder / "kkl_observer.mjs").write_text(javascript(), encoding="utf-8")
    rows = [None if np.isnan(row).all() else [None if np.isnan(value) else value for value in row] for row in y]
    done = subprocess.run(
        ["node", REPLAY, folder / "kkl_observer.mjs", folder / "step.safetensors"],
        input=json.dumps({"y": rows, "u": u.tolist(), "noise": told}),
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    "options",
    [
        {"inputs": False, "noise": False, "age": False},
        {"pair": True, "outputs": 2, "process": True, "free_inverse": True},
        {"estimated": True, "process": True},
        {"pair": True, "activation": "relu"},
    ],
)
def test_every_kind_of_map(options, make_artifact, tmp_path):
    artifact = make_artifact(**{name: value for name, value in options.items() if name != "activation"})
    mlp = replace(artifact.inverse.mlp, activation=options.get("activation", "silu"))
    artifact = replace(artifact, inverse=replace(artifact.inverse, mlp=mlp))
    exported = exported_of(artifact, tmp_path, precision="double")  # compared with a step in doubles
    y, u = noise(artifact, 400)
    x_hat = np.array(replayed(exported, tmp_path, y, u)["x_hat"])
    assert np.ptp(x_hat, axis=0).min() > 0.01
    assert apart(exported, x_hat, y, u) < 1e-10


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol", "rossler", "lorenz", "rossler-static"])
def test_what_ships_with_its_monitor(name, tmp_path):
    exported = Exported.read(name)
    artifact = exported.artifact
    y, u = motion(artifact, 900)
    y = y + np.random.default_rng(0).normal(scale=0.2, size=y.shape)
    y[700:] = y[700]  # frozen
    found = replayed(exported, tmp_path, y, u, told=[0.2, 0.01])
    observer = KKLObserver(artifact, 0.2, process_noise=0.01, monitor=True)
    x_hat, score = [observer.reset(y[0])], [0.0]
    for k in range(1, len(y)):
        x_hat.append(observer.step(y[k], u[k - 1]))
        score.append(float(observer.score))
    assert (abs(np.array(found["x_hat"]) - x_hat) / artifact.inverse.x_scale).max() < 1e-4
    assert 0 < max(score[:700]) < 1
    assert score[-1] > 1
    assert np.allclose(found["score"], score, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["van_der_pol", "van_der_pol-static"])
def test_samples_that_are_missing(name, tmp_path):
    exported = Exported.read(name)
    y, u = motion(exported.artifact, 600)
    y[300:350] = np.nan
    found = np.array(replayed(exported, tmp_path, y, u)["x_hat"])
    observer = load(name)
    x_hat = [observer.reset(y[0]), *(observer.step(None if np.isnan(a).any() else a, b) for a, b in zip(y[1:], u))]
    assert (abs(found - x_hat) / exported.artifact.inverse.x_scale).max() < 1e-4


@pytest.mark.parametrize("seen", [0, 1])
def test_several_outputs_of_which_one_is_missing(seen, make_artifact, tmp_path):
    artifact = make_artifact(outputs=2, pair=True)
    tables = np.array([[1.0, 2.0], [2.0, 3.0], [3.0, 8.0]])
    levels = np.array([[0.0, 0.0], [0.5, 1.0], [1.0, 2.0]])
    limits = Limits(levels, tables, 0.01 * tables, 5 * tables, 0.5, 0.1, 0.01, 9.0)
    artifact = replace(artifact, C=np.array([[1.0, 0.5], [0.0, 2.0]]), limits=limits)
    exported = exported_of(artifact, tmp_path)
    y, u = noise(artifact, 200)
    y[100:120, 1 - seen] = np.nan
    found = replayed(exported, tmp_path, y, u, told=[[0.3, 0.9]])
    observer = KKLObserver(artifact, (0.3, 0.9), monitor=True)
    x_hat, score = [observer.reset(y[0])], [0.0]
    for k in range(1, len(y)):
        x_hat.append(observer.step(y[k], u[k - 1]))
        score.append(float(observer.score))
    assert np.abs(np.array(found["x_hat"]) - x_hat).max() < 1e-3
    assert np.allclose(found["score"], score, rtol=1e-4)


@pytest.mark.parametrize(
    ("process", "options"),
    [(False, {"free_inverse": True}), (True, {"free_inverse": True}), (True, {"estimated": True})],
)
def test_error_bars(process, options, make_artifact, tmp_path):
    artifact = with_error_bars(make_artifact(process=process, system="lorenz", **options))
    exported = exported_of(artifact, tmp_path)
    y, u = noise(artifact, 120)
    levels = (0.7, 0.05) if process else (0.7,)
    found = np.array(replayed(exported, tmp_path, y, u, told=levels)["covariance"])
    observer = KKLObserver(artifact, levels[0], process_noise=levels[1] if process else None)
    covariances = []
    for k in range(len(y)):
        observer.step(y[k], u[k - 1]) if k else observer.reset(y[0])
        covariances.append(observer.covariance)
    assert np.allclose(found, covariances, rtol=1e-3, atol=1e-5 * np.abs(covariances).max())


NO_INPUTS = ["[]", "[NaN]", "[null]", "0.5", "null"]


@pytest.mark.parametrize(
    "sample",
    [
        "0.5",
        "[]",
        "undefined",
        "[1, 2]",
        "[Infinity]",
        '["abc"]',
        '"a"',
        "[1n]",
        "[[1]]",
        "({})",
        "Object.create(null)",
    ],
)
def test_what_is_no_sample_or_input_is_refused(sample, make_artifact, tmp_path):
    write_step(tmp_path / "step.safetensors", exported_of(make_artifact(), tmp_path))
    (tmp_path / "kkl_observer.mjs").write_text(javascript(), encoding="utf-8")
    program = f"""
        import {{ readFileSync }} from "node:fs";
        import {{ Observer }} from "./kkl_observer.mjs";
        const observer = new Observer(new Uint8Array(readFileSync("step.safetensors")).buffer);
        for (const first of [[null], [NaN], {sample}]) {{
          try {{ observer.reset(first); }} catch (error) {{ console.log(error.message); }}
        }}
        const steps = [[[1]], [{sample}], ...[{", ".join(NO_INPUTS)}].map((u) => [[1], u])];
        for (const step of steps) {{
          try {{ observer.step(...step); }} catch (error) {{ console.log(error.message); }}
          if (step === steps[0]) observer.reset([1]);
        }}
        const z = [...observer.z];
        observer.reset([1]);
        if (z.some((value, i) => value !== observer.z[i])) throw new Error("the filter has moved");
    """
    done = subprocess.run(["node", "--input-type=module", "-e", program], cwd=tmp_path, capture_output=True, text=True)
    got = "[object Object]" if "(" in sample else sample
    assert done.stdout.splitlines() == [
        *(f"the first sample has 1 finite outputs, got {each}" for each in ("[null]", "[NaN]", got)),
        "call reset(y0) before step",
        f"a sample has 1 outputs, NaN where one is missing, or is null, got {got}",
        *(f"an input has 1 finite entries, got {each}" for each in NO_INPUTS),
    ]
    assert not done.stderr


@pytest.mark.parametrize("options", KINDS)
def test_maps_that_track(options, tmp_path):
    exported = exported_of(tracking(**options), tmp_path, precision="double")  # compared with a step in doubles
    y, u = signals(exported.artifact, 1500)
    y[2:9] = y[700:720] = y[300::7, 0] = np.nan  # from the start on, where T_inv has learned less than it is old
    found = replayed(exported, tmp_path, y, u)
    assert apart(exported, np.array(found["x_hat"]), y, u) < 1e-9
    lost, inflated = lost_and_inflated(exported, y, u)
    assert any(lost[600:700])
    assert inflated.any()


def test_error_bars_of_maps_that_track(tmp_path):
    artifact = tracking(process=True, free_inverse=True)
    factors = artifact.flow.factors
    free = replace(factors, factors=2.0 * factors.factors, doubt=np.full(factors.factors.shape, 0.1))
    doubtful = replace(factors, doubt=np.full(factors.factors.shape, 0.3))
    exported = exported_of(
        replace(artifact, flow=replace(artifact.flow, factors=doubtful, free_factors=free)), tmp_path
    )
    y, u = signals(artifact, 200)
    y[3:9] = np.nan  # which the calibration knows of later too
    u[7:] += 0.1  # from within the window on
    found = np.array(replayed(exported, tmp_path, y, u, told=(0.7, 0.05))["covariance"])
    told = replace(exported, measurement_noise=0.7, process_noise=0.05)
    for k, observer in enumerate(stepped(told, y, u)):
        expected = observer.covariance
        assert np.allclose(found[k], expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max()), k


def test_outputs_that_are_not_linear_are_refused(tmp_path):
    curved = replace(tracking(), C=None, h=Expression([["+", ["x", 0], ["x", 1]]]))
    exported = exported_of(curved, tmp_path)
    with pytest.raises(ValueError, match="not linear, and JavaScript takes y = C x alone"):
        write_step(tmp_path / "step.safetensors", exported)


def test_process_noise_that_t_inv_is_not_told_counts_for_the_filter(tmp_path):
    exported = exported_of(tracking(), tmp_path, precision="double", process_noise=2.0)
    y, u = signals(exported.artifact, 200)
    assert apart(exported, np.array(replayed(exported, tmp_path, y, u)["x_hat"]), y, u) < 1e-9
