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
    small = {
        "trajectories": 5,
        "duration": 1.0,
        "samples": 10,
        "process_noise_share": 0.5,
        "noise_free_share": 0.3,
        "high_noise_emphasis": 3.0,
    }
    config = replace(preset(VanDerPol(), "input-aware", "fast"), **small)
    with pytest.raises(ReachedError):
        train(VanDerPol(), config, tmp_path / "aware", device=CPU)
    told = {
        "measurement_noise_max": 1.0,
        "batch": 1024,
        "device": CPU,
        "measurement_noise": 0.5,
        "noise_free_share": 0.3,
        "high_noise_emphasis": 3.0,
        "error": None,
        "scaling": "relative",
        "parameters": 0,
    }
    assert seen == {"record": 0.5, "sampler": {**told, "process_noise_max": 0.05}}
    with pytest.raises(ReachedError):
        train(VanDerPol(), replace(config, process_noise_share=0.0), tmp_path / "undisturbed", device=CPU)
    assert seen == {"record": 0.0, "sampler": {**told, "process_noise_max": 0.0}}
    spinn = replace(
        preset(VanDerPol(), "spinn", "fast"), process_noise_share=0.5, trajectories=5, duration=20.0, forward_steps=1
    )
    with pytest.raises(ReachedError):
        train(VanDerPol(), replace(spinn, inverse_steps=1), tmp_path / "spinn", device=CPU)
    assert seen["record"] == 0.0
    assert seen["sampler"]["process_noise_max"] == 0.0


def test_training_makes_the_error_fall(tmp_path):
    system = Oscillator()
    config = toy(system, trajectories=100, duration=20.0, inverse_steps=800, width=32)
    runs = unseen_trajectories(system, config.dt, n=20, duration=20.0, seed=0)
    before = train(system, replace(config, inverse_steps=1), tmp_path / "a").artifact
    after = train(system, config, tmp_path / "b").artifact
    errors_before, errors_after = (
        np.median(errors(a, system, runs, measurement_noise=0.0, seed=0).late) for a in (before, after)
    )
    assert errors_after < 0.1 * errors_before
    assert errors_after < 5.0
    driven = unseen_trajectories(system, config.dt, n=20, duration=20.0, seed=0, driven=True)
    assert np.median(errors(after, system, driven, measurement_noise=0.0, seed=0).late) < 10.0


@pytest.mark.parametrize(
    ("method", "options"),
    [("input-aware", {}), ("spinn", {"adaptive": True, "lipschitz_penalty": 0.1})],
)
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(tmp_path, monkeypatch, method, options):
    system = Oscillator()
    config = toy(system, method, duration=20.0, inverse_steps=200, **options)
    whole = train(system, config, tmp_path / "whole", device=CPU).artifact

    monkeypatch.setattr(checkpoints, "SECONDS", 0.0)
    save, saved = training.maps.optimise._save, []

    def save_and_stop(stage, parts, generator, course):
        save(stage, parts, generator, course)
        saved.append(course.step)
        if stage.name == "inverse" and course.step == 100:
            raise KeyboardInterrupt

    monkeypatch.setattr(training.maps.optimise, "_save", save_and_stop)
    with pytest.raises(KeyboardInterrupt):
        train(system, config, tmp_path / "cut", device=CPU)
    monkeypatch.setattr(training.maps.optimise, "_save", save)
    resumed = train(system, config, tmp_path / "cut", resume=True, device=CPU)
    for a, b in zip(whole.inverse.mlp.weights, resumed.artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(a, b)
    assert resumed.losses["inverse"][-1][0] == 200
    assert (whole.free_inverse is not None) == (method == "input-aware")
    if whole.free_inverse:
        for a, b in zip(whole.free_inverse.mlp.weights, resumed.artifact.free_inverse.mlp.weights, strict=True):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="seed = 0 there, 1 here"):
        train(system, replace(config, seed=1), tmp_path / "cut", resume=True, device=CPU)
    with pytest.raises(ValueError, match="--resume"):
        train(system, config, tmp_path / "cut", device=CPU)
    checkpoint = tmp_path / "cut" / "inverse.checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    with pytest.raises(ValueError, match="damaged"):
        train(system, config, tmp_path / "cut", resume=True, device=CPU)


def test_a_run_is_not_resumed_for_another_process_noise(tmp_path):
    config = toy(Oscillator(), duration=1.0)
    train(Oscillator(), config, tmp_path, device=CPU)

    class Disturbed(Oscillator):
        process_noise = 0.5

    with pytest.raises(ValueError, match=r"process_noise = 0\.05 there, 0\.5 here"):
        train(Disturbed(), config, tmp_path, resume=True, device=CPU)


def test_resuming_notices_a_changed_equation(tmp_path):
    @dataclass(frozen=True)
    class Changed(Oscillator):
        name: ClassVar[str] = "oscillator"

        def f(self, x):
            return x[1], -2.0 * x[0]

    train(Oscillator(), toy(Oscillator()), tmp_path)
    with pytest.raises(ValueError, match="equations"):
        train(Changed(), toy(Oscillator()), tmp_path, resume=True)


def test_closing_the_loop_is_a_second_stage(tmp_path):
    system = Oscillator()
    config = toy(system, duration=5.0, closed_loop_trajectories=10, inverse_steps=50)
    result = train(system, config, tmp_path)
    assert list(result.losses) == ["free", "inverse", "closed-loop"]
    assert result.artifact.training["closed_loop_trajectories"] == 10
    again = train(system, config, tmp_path, resume=True)
    for a, b in zip(result.artifact.inverse.mlp.weights, again.artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(a, b)
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


def test_a_pair_of_modes_can_be_trained(tmp_path):
    system = Oscillator()
    config = toy(system, eigenvalues=(-3.0,), pairs=((-0.5, 1.0),), inverse_steps=20)
    train(system, config, tmp_path).artifact.save(tmp_path / "a.safetensors")
    artifact = Artifact.read(tmp_path / "a.safetensors")
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(artifact.filter.A)), [-3, -0.5 - 1j, -0.5 + 1j])
    assert artifact.filter.size == 3 * (1 + system.nu)


def test_training_on_a_solved_map(tmp_path):
    sizes = {
        "random_features": 200,
        "forward_steps": 0,
        "box_factor": 1.5,
        "inverse_steps": 800,
        "duration": 15.0,
        "width": 32,
    }
    config = toy(Oscillator(), "spinn", **sizes)
    result = train(Oscillator(), config, tmp_path)
    assert list(result.losses) == ["inverse"]
    assert result.artifact.forward.mlp.weights[0].shape == (200, 2)
    runs = unseen_trajectories(Oscillator(), config.dt, n=20, duration=20.0, seed=0, domain="1.5X")
    # long after the start, whose last traces in z an inverse of exact T(x) magnifies
    assert np.median(errors(result.artifact, Oscillator(), runs, measurement_noise=0.0, seed=0, skip=12.0).late) < 5.0


def test_the_papers_own_way_is_told_neither_noise_nor_age(tmp_path):
    papers = {"collocation": "box", "box_factor": 1.0, "scaling": "range", "transients": False}
    config = toy(Oscillator(), "spinn", duration=20.0, solved_output_layer=False, **papers)
    artifact = train(Oscillator(), config, tmp_path).artifact
    assert artifact.inverse.features == ("z_y",)
    np.testing.assert_allclose(artifact.forward.x_scale, 1.0, atol=0.01)  # the box, not the motions beyond it
    np.testing.assert_allclose(artifact.inverse.x_scale, 1.0, atol=0.01)


def test_artifact_of_a_run_records_what_made_it(tmp_path):
    system = Oscillator()
    artifact = train(system, toy(system, "spinn", duration=20.0), tmp_path).artifact
    artifact.save(tmp_path / "o.safetensors")
    read = Artifact.read(tmp_path / "o.safetensors")
    assert read.training["pipeline"] == "spinn"
    assert read.training["seed"] == 0
    assert read.versions["torch"] == torch.__version__
    assert read.forward is not None
    assert read.nu == 0
    assert json.loads((tmp_path / "config.json").read_text())["forward_steps"] == 200
    x = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    np.testing.assert_allclose(read.forward(x), artifact.forward(x))


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
