"""Whole runs, at toy size."""

import json
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from linear_system import Autonomous, Oscillator, TwoUnits, sylvester
from small_runs import CPU, toy

import training.evaluation.errors
import training.maps.optimise
import training.pipeline
import training.trajectories.record
from kkl_gym import VanDerPol
from observers import Artifact, KKLObserver
from training import checkpoints, errors, preset, train, unseen_trajectories
from training.config import override
from training.evaluation.report import write_report
from training.trajectories.record import record


def test_settings_of_noise_reach_data_and_samples(monkeypatch, tmp_path):
    class ReachedError(Exception):
        pass

    seen = {}

    def note(name):
        def spy(*arguments, **named):
            seen[name] = named["motions"].process_noise_share if name == "record" else named
            if name == "record":
                return record(*arguments, **named)
            raise ReachedError

        return spy

    monkeypatch.setattr(training.pipeline, "record", note("record"))
    monkeypatch.setattr(training.pipeline, "TrajectorySampler", note("sampler"))
    shares = {"process_noise_share": 0.5, "noise_free_share": 0.3, "high_noise_emphasis": 3.0}
    config = toy(VanDerPol(), trajectories=5, duration=1.0, samples=10, **shares)
    with pytest.raises(ReachedError):
        train(VanDerPol(), config, tmp_path / "aware", device=CPU)
    assert seen["record"] == 0.5
    told = {"measurement_noise_max": 1.0, "measurement_noise": 0.5, "noise_free_share": 0.3, "high_noise_emphasis": 3.0}
    assert seen["sampler"].items() >= {**told, "process_noise_max": 0.05}.items()
    with pytest.raises(ReachedError):
        train(VanDerPol(), replace(config, process_noise_share=0.0), tmp_path / "undisturbed", device=CPU)
    assert seen["record"] == 0.0
    assert seen["sampler"].items() >= {**told, "process_noise_max": 0.0}.items()


PIPELINES = ("input-aware", "spinn")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Of each pipeline a configuration, the folder of an uninterrupted run, and its artifact."""
    runs = {}
    for method in PIPELINES:
        config = toy(Oscillator(), method, duration=20.0, inverse_steps=200)
        folder = tmp_path_factory.mktemp(method)
        runs[method] = config, folder, train(Oscillator(), config, folder, device=CPU).artifact
    return runs


def same_weights(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one.mlp.weights, other.mlp.weights, strict=True))


@pytest.mark.parametrize("method", PIPELINES)
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(tmp_path, monkeypatch, method, whole):
    config, _, expected = whole[method]
    monkeypatch.setattr(checkpoints, "SECONDS", 0.0)
    save = checkpoints.save

    def save_and_stop(path, state, *, fingerprint):
        save(path, state, fingerprint=fingerprint)
        if path.name.startswith("inverse") and checkpoints.load(path)["step"] == 100:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            train(Oscillator(), config, tmp_path, device=CPU)
    resumed = train(Oscillator(), config, tmp_path, resume=True, device=CPU)
    assert resumed.losses["inverse"][-1][0] == 200
    assert same_weights(expected.inverse, resumed.artifact.inverse)
    if method == "input-aware":
        assert same_weights(expected.free_inverse, resumed.artifact.free_inverse)
    checkpoint = tmp_path / "inverse.checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    with pytest.raises(ValueError, match="damaged"):
        train(Oscillator(), config, tmp_path, resume=True, device=CPU)


def test_another_run_is_not_resumed(whole):
    class Disturbed(Oscillator):
        process_noise = 0.5

    class Changed(Oscillator):
        name = "oscillator"

        def f(self, x):
            return x[1], -2.0 * x[0]

    config, folder, _ = whole["input-aware"]
    for system, other, message in (
        (Oscillator(), replace(config, seed=1), "seed = 0 there, 1 here"),
        (Disturbed(), config, r"process_noise = 0\.05 there, 0\.5 here"),
        (Changed(), config, "equations"),
    ):
        with pytest.raises(ValueError, match=message):
            train(system, other, folder, resume=True, device=CPU)
    with pytest.raises(ValueError, match="--resume"):
        train(Oscillator(), config, folder, device=CPU)


def test_artifact_of_a_run_records_what_made_it(whole, tmp_path):
    _, folder, artifact = whole["spinn"]
    artifact.save(tmp_path / "o.safetensors")
    read = Artifact.read(tmp_path / "o.safetensors")
    assert read.training["pipeline"] == "spinn"
    assert read.training["seed"] == 0
    assert read.versions["torch"] == torch.__version__
    assert read.nu == 0
    assert json.loads((folder / "config.json").read_text())["forward_steps"] == 200
    x = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    np.testing.assert_allclose(read.forward(x), artifact.forward(x))


def test_errors_of_a_trained_map_are_small(tmp_path):
    system = Oscillator()
    config = toy(system, trajectories=60, duration=20.0, inverse_steps=500, width=32)
    artifact = train(system, config, tmp_path).artifact
    for driven, most in ((False, 5.0), (True, 10.0)):
        runs = unseen_trajectories(system, config.dt, n=20, duration=20.0, seed=0, driven=driven)
        assert np.median(errors(artifact, system, runs, measurement_noise=0.0, seed=0).late) < most


def test_closing_the_loop_is_a_second_stage(tmp_path):
    system = Oscillator()
    config = toy(system, duration=1.0, closed_loop_trajectories=10, inverse_steps=5)
    result = train(system, config, tmp_path)
    assert list(result.losses) == ["free", "inverse", "closed-loop"]
    assert result.artifact.training["closed_loop_trajectories"] == 10
    again = train(system, config, tmp_path, resume=True)
    assert same_weights(result.artifact.inverse, again.artifact.inverse)
    with pytest.raises(ValueError, match="no inputs"):
        train(Autonomous(), toy(Autonomous(), closed_loop_trajectories=20, inverse_steps=5), tmp_path / "b")


def test_truncation_beyond_the_trajectories_is_an_error_before_they_are_simulated(tmp_path, monkeypatch):
    monkeypatch.delattr(training.pipeline, "record")
    with pytest.raises(ValueError, match="make them longer"):
        train(Oscillator(), toy(Oscillator(), "spinn"), tmp_path)


@pytest.mark.slow
def test_linear_system_gives_the_sylvester_solution(tmp_path):
    system = Oscillator()
    sizes = {"trajectories": 200, "duration": 30.0, "samples": 200, "width": 64, "depth": 2, "batch": 1024}
    steps = {"forward_steps": 12000, "inverse_steps": 50, "learning_rate": 2e-3, "physics_weight": 1.0}
    config = replace(override(preset(system, "spinn", "fast"), sizes | steps), activation="silu")
    artifact = train(system, config, tmp_path).artifact
    M = sylvester(np.diag(config.eigenvalues), np.ones((len(config.eigenvalues), 1)))
    x = np.random.default_rng(0).uniform(*system.box(), (1000, 2))
    error = artifact.forward(x) - x @ M.T
    relative = np.sqrt((error**2).mean() / ((x @ M.T) ** 2).mean())
    assert relative < 1e-3


def test_the_papers_own_way_is_told_neither_noise_nor_age(tmp_path):
    papers = {"collocation": "box", "box_factor": 1.0, "scaling": "range", "transients": False}
    config = toy(
        Oscillator(), "spinn", duration=20.0, inverse_steps=5, forward_steps=5, solved_output_layer=False, **papers
    )
    artifact = train(Oscillator(), config, tmp_path).artifact
    assert artifact.inverse.features == ("z_y",)
    np.testing.assert_allclose(artifact.forward.x_scale, 1.0, atol=0.01)  # the box, not the motions beyond it
    np.testing.assert_allclose(artifact.inverse.x_scale, 1.0, atol=0.01)


def test_two_outputs_train_and_run(tmp_path):
    system = TwoUnits()
    config = toy(system, duration=2.0, closed_loop_trajectories=10, inverse_steps=10)
    result = train(system, config, tmp_path / "run", device=CPU)
    write_report(tmp_path / "report.png", result, system)
    result.artifact.save(tmp_path / "a.safetensors")
    read = Artifact.read(tmp_path / "a.safetensors")
    assert read.ny == 2
    assert read.C is None
    np.testing.assert_allclose(read.output(np.array([0.1, 0.2])), [100.0, 0.12])
    assert read.measurement_noise == system.measurement_noise == (100.0, 0.12)
    for inverse in (read.inverse, read.free_inverse):
        assert inverse.measurement_noise_max == (200.0, 0.24)
        assert inverse.noise_gain.shape == (2, len(inverse.whiten))
    y, u = np.zeros((10, 3, 2)), np.zeros((9, 3, 1))
    estimates = [KKLObserver(read, levels).estimate(y, u) for levels in (None, (100.0, 0.12), (10.0, 0.2), (0.0, 0.1))]
    assert estimates[0].shape == (10, 3, 2)
    np.testing.assert_array_equal(estimates[0], estimates[1])
    assert not np.allclose(estimates[0], estimates[2])
    assert not np.allclose(estimates[0], estimates[3])
    y[1:, 1, 1] = np.nan
    assert np.isfinite(KKLObserver(read).estimate(y, u)).all()


def test_levels_that_do_not_fit_the_outputs_are_an_error_before_any_work(tmp_path):
    with pytest.raises(ValueError, match="measurement_noise_max must be one number, or one for each of 1 outputs"):
        train(Oscillator(), toy(Oscillator(), measurement_noise_max=(0.1, 0.3)), tmp_path)


def test_an_output_that_cannot_be_told_from_outside_is_left_out(tmp_path):
    @dataclass(frozen=True)
    class Sine(Oscillator):
        name: ClassVar[str] = "sine"

        def h(self, x):
            return (np.sin(x[0]),)

    artifact = train(Sine(), toy(Sine(), duration=1.0, inverse_steps=2, inputs=False), tmp_path, device=CPU).artifact
    assert not artifact.knows_output
