"""Training of tracking observers from systems, at toy size."""

import io
import json
from dataclasses import dataclass, replace
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from linear_system import Autonomous, Oscillator, TwoUnits, sylvester
from rich.console import Console
from small_runs import CPU, toy
from unstable_system import Falling

from kkl_gym import KKLObservation, get_system
from kkl_gym.simulate import simulate
from observers import Artifact, KKLObserver
from training import SimulatedSource, errors, preset, run, train, unseen_trajectories
from training.evaluation.report import write_report


class Slow(Oscillator):
    """The oscillator with 20 samples per second, for a fast calibration."""

    name = "oscillator"
    dt = 0.05
    pace = 1.0


class Table(Slow):
    """The restoring force is a table, interpolated by NumPy, which no expression represents."""

    name = "table"

    def f(self, x):
        return x[1], -np.interp(x[0], [-30.0, 0.0, 30.0], [-30.0, 0.0, 30.0])


def trained(system, folder=None, *, resume=False, **changes):
    """Train an observer of a system; return the result and the printed text."""
    printed = Console(file=io.StringIO(), width=300)
    found = train(system, toy(system, **changes), folder, resume=resume, device=CPU, console=printed)
    return found, printed.file.getvalue()


LONG = {"duration": 20.0, "inverse_steps": 200}
KINDS = {
    "equations": (Slow(), "inverse", LONG),
    "flow": (Table(), "flow", {**LONG, "inputs": False, "flow_steps": 200}),
    "spinn": (Slow(), "inverse", {**LONG, "pipeline": "spinn"}),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """For each of KINDS, the folder of an uninterrupted run, the result, and the printed text."""
    found = {}
    for kind, (system, _, changes) in KINDS.items():
        folder = tmp_path_factory.mktemp(kind)
        found[kind] = folder, *trained(system, folder, **changes)
    return found


def test_an_observer_tracks_by_its_equations(whole, tmp_path):
    _, result, printed = whole["equations"]
    assert "track" not in printed
    result.artifact.save(tmp_path / "a.safetensors")
    artifact = Artifact.read(tmp_path / "a.safetensors")
    assert list(result.losses) == ["free", "inverse"]
    assert set(result.seconds) == {"motions", "free", "inverse", "calibrating"}
    x, u = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 50, 2))
    later = simulate(Slow(), x, 1, 0.05, u=u[None, :, :1])[-1]
    np.testing.assert_allclose(artifact.motion.step(x, u[:, :1], 0.05), later, atol=1e-5)
    ages = artifact.motion.factors.ages
    assert artifact.motion.factors.factors.shape == (2, 6, len(ages))  # first axis: without and with process noise
    for inverse in (artifact.inverse, artifact.free_inverse):
        assert inverse.error_covariance.covariance.shape == (6, len(ages), 2, 2)
    assert artifact.limits.duration == 20.0
    runs = unseen_trajectories(Slow(), 0.05, n=100, duration=20.0, seed=0, driven=True)
    tracked, alone = (
        np.median(errors(each, Slow(), runs, measurement_noise=0.1, seed=0).late)
        for each in (artifact, replace(artifact, motion=None))
    )
    assert tracked < 4.0 < alone  # in percent; this T_inv is a toy


def test_equations_that_no_expression_holds_give_way_to_a_flow(whole):
    _, result, printed = whole["flow"]
    assert "by a learned flow: an observer of 'table' cannot hold f(x) + g(x) u as an expression" in printed
    motion = result.artifact.motion
    assert motion.equations is None
    assert list(result.losses) == ["inverse", "flow"]
    x = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    later = simulate(Table(), x, 1, 0.05)[-1]
    off = (motion.step(x, np.zeros((200, 0)), 0.05) - later) / motion.x_scale
    assert np.sqrt(np.mean(off**2)) < 3e-4
    assert (motion.error > 0).all()
    assert motion.process_noise * motion.x_scale == pytest.approx(np.array(Table().scale) * 0.05 / np.sqrt(3))


def parts(artifact):
    """Yield all arrays that training and calibration determine."""
    for inverse in (artifact.inverse, artifact.free_inverse):
        if inverse is not None:
            yield from (*inverse.mlp.weights, inverse.error_covariance.covariance)
    if artifact.motion is not None:
        yield artifact.motion.factors.factors
        yield from () if artifact.motion.flow is None else artifact.motion.flow.mlp.weights
    yield artifact.limits.mean


@pytest.mark.parametrize("kind", KINDS)
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(tmp_path, monkeypatch, kind, whole):
    system, stage, changes = KINDS[kind]
    monkeypatch.setattr(run, "CHECKPOINT_SECONDS", 0.0)
    save = run.save_checkpoint

    def save_and_stop(path, state, *, fingerprint):
        save(path, state, fingerprint=fingerprint)
        if path.name.startswith(stage) and run.load_checkpoint(path)["step"] == 100:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "save_checkpoint", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            trained(system, tmp_path, **changes)
    resumed, _ = trained(system, tmp_path, resume=True, **changes)
    assert resumed.losses[stage][-1][0] == 200
    for expected, found in zip(parts(whole[kind][1].artifact), parts(resumed.artifact), strict=True):
        np.testing.assert_array_equal(expected, found)
    checkpoint = tmp_path / f"{stage}.checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    with pytest.raises(ValueError, match="damaged"):
        trained(system, tmp_path, resume=True, **changes)


def test_another_run_is_not_resumed(whole):
    class Disturbed(Slow):
        name = "oscillator"
        process_noise = 0.5

    class Changed(Slow):
        name = "oscillator"

        def f(self, x):
            return x[1], -2.0 * x[0]

    folder, *_ = whole["equations"]
    for system, changes, message in (
        (Slow(), {"seed": 1}, "seed = 0 there, 1 here"),
        (Disturbed(), {}, r"process_noise = 0\.05 there, 0\.5 here"),
        (Changed(), {}, "equations"),
    ):
        with pytest.raises(ValueError, match=message):
            trained(system, folder, resume=True, **LONG, **changes)
    with pytest.raises(ValueError, match="--resume"):
        trained(Slow(), folder, **LONG)


def test_an_artifact_of_spinn_has_a_forward_map_and_no_motion(whole):
    folder, result, printed = whole["spinn"]
    artifact = result.artifact
    assert "track" not in printed  # no message, since spinn maps never track
    assert (artifact.motion, artifact.nu, artifact.forward.mlp.inputs) == (None, 0, 2)
    assert artifact.inverse.error_covariance is not None
    assert (artifact.training["pipeline"], artifact.training["seed"]) == ("spinn", 0)
    assert artifact.versions["torch"] == torch.__version__
    assert json.loads((folder / "config.json").read_text())["forward_steps"] == 200


def test_a_source_gives_the_same_motions_to_every_training(whole):
    system, _, changes = KINDS["equations"]
    source = SimulatedSource(system, toy(system, **changes))
    train(source, device=CPU)
    for expected, found in zip(parts(whole["equations"][1].artifact), parts(train(source, device=CPU).artifact)):
        np.testing.assert_array_equal(expected, found)
    with pytest.raises(ValueError, match="pass config only with a System"):
        train(source, toy(system))


def test_outputs_that_no_expression_holds_cannot_be_tracked():
    class Sine(Slow):
        name = "sine"

        def h(self, x):
            return (np.sin(x[0]),)

    result, printed = trained(Sine(), duration=1.0, inverse_steps=2, inputs=False)
    artifact = result.artifact
    assert "does not track: an observer of 'sine' cannot hold h(x) as an expression" in printed
    assert (artifact.knows_output, artifact.motion, artifact.limits) == (False, None, None)
    assert artifact.inverse.error_covariance is not None


def test_an_unstable_plant_is_trained_under_a_policy(tmp_path):
    result, _ = trained(Falling(), policy="controller", inverse_steps=300, dt=0.05, duration=20.0)
    artifact = result.artifact
    assert list(result.losses) == ["inverse"]
    assert (artifact.free_inverse, artifact.training["policy"]) == (None, "controller")
    assert artifact.motion.equations is not None
    assert (artifact.limits.mean < 1.0).all()
    with pytest.raises(ValueError, match="no inputs"):
        trained(Autonomous(), policy="controller")
    script, body = tmp_path / "mine.py", "def hold(x):\n    return (-{} * x[:, :1] - 0.5 * x[:, 1:]).clip(-1, 1)\n"
    small = {"policy": f"{script}:hold", "inverse_steps": 2, "dt": 0.05}
    script.write_text(body.format(2.0))
    trained(Falling(), tmp_path / "run", **small)
    script = tmp_path / "other" / "mine.py"
    script.parent.mkdir()
    script.write_text(body.format(3.0))
    with pytest.raises(ValueError, match="policy_actions"):
        trained(Falling(), tmp_path / "run", resume=True, **small | {"policy": f"{script}:hold"})


@pytest.mark.slow
def test_linear_system_gives_the_sylvester_solution(tmp_path):
    system = Oscillator()
    sizes = {"trajectories": 200, "duration": 30.0, "samples": 200, "width": 64, "depth": 2, "batch": 1024}
    steps = {"forward_steps": 12000, "inverse_steps": 50, "learning_rate": 2e-3, "physics_weight": 1.0}
    config = replace(preset(system, "spinn", "fast"), **sizes | steps, activation="silu")
    artifact = train(system, config, tmp_path).artifact
    M = sylvester(np.diag(config.eigenvalues), np.ones((len(config.eigenvalues), 1)))
    x = np.random.default_rng(0).uniform(*system.box(), (1000, 2))
    error = artifact.forward(x) - x @ M.T
    relative = np.sqrt((error**2).mean() / ((x @ M.T) ** 2).mean())
    assert relative < 1e-3


def test_the_papers_own_way_takes_neither_noise_nor_age(monkeypatch):
    papers = {"pipeline": "spinn", "collocation": "box", "scaling": "range", "transients": False}
    result, _ = trained(Slow(), duration=20.0, inverse_steps=5, forward_steps=5, solved_output_layer=False, **papers)
    artifact = result.artifact
    assert artifact.inverse.features == ("z_y",)
    np.testing.assert_allclose(artifact.forward.x_scale, 1.0, atol=0.01)  # the scale of the box X
    np.testing.assert_allclose(artifact.inverse.x_scale, 1.0, atol=0.01)
    assert artifact.inverse.error_covariance is None
    np.testing.assert_allclose(artifact.limits.levels[-1], 0.2)  # the largest level in training
    monkeypatch.delattr(SimulatedSource, "pairs")
    with pytest.raises(ValueError, match="make them longer"):
        trained(Slow(), pipeline="spinn")


def test_two_outputs_have_noise_of_their_own(tmp_path):
    class Both(TwoUnits):
        name = "two-units"
        dt = 0.05
        pace = 1.0

    system = Both()
    result, _ = trained(system, duration=2.0, inverse_steps=10)
    write_report(tmp_path / "report.png", result, system)
    result.artifact.save(tmp_path / "a.safetensors")
    read = Artifact.read(tmp_path / "a.safetensors")
    assert (read.ny, read.C) == (2, None)
    np.testing.assert_allclose(read.output(np.array([0.1, 0.2])), [100.0, 0.12])
    assert read.measurement_noise == system.measurement_noise == (100.0, 0.12)
    for inverse in (read.inverse, read.free_inverse):
        assert inverse.measurement_noise_max == (200.0, 0.24)
        assert inverse.noise_gain.shape == (2, len(inverse.whiten))
    np.testing.assert_allclose(read.limits.levels[-1], (200.0, 0.24))
    np.testing.assert_allclose(read.motion.least_measurement_noise, (0.1, 0.12e-3))
    y, u = np.zeros((10, 3, 2)), np.zeros((9, 3, 1))
    estimates = [KKLObserver(read, levels).estimate(y, u) for levels in (None, (100.0, 0.12), (10.0, 0.2), (0.0, 0.1))]
    same = [np.allclose(estimates[0], others, rtol=1e-12) for others in estimates[1:]]
    assert same == [True, False, False]
    y[1:, 1, 1] = np.nan
    assert np.isfinite(KKLObserver(read).estimate(y, u)).all()
    with pytest.raises(ValueError, match="measurement_noise_max must be one number, or one for each of 1 outputs"):
        trained(Slow(), measurement_noise_max=(0.1, 0.3))


@dataclass(frozen=True)
class Still(Slow):
    """States in units of 1e6 and 1e-6, and a constant state; starts lie on a circle."""

    name: ClassVar[str] = "still"
    X: ClassVar = ((-1e-6, 1e-6), (-1e6, 1e6), (200.0, 400.0))
    bounds: ClassVar = ((-3e-5, 3e-5), (-3e7, 3e7), (0.0, 900.0))
    u_max: ClassVar = ()
    G: ClassVar = ()
    process_noise: ClassVar = 0.0

    def draw_starts(self, rng, n, factor=1.0):
        angle = rng.uniform(0, 2 * np.pi, n)
        return factor * np.column_stack([1e-6 * np.cos(angle), 1e6 * np.sin(angle), np.full(n, 300.1 / factor)])

    def f(self, x):
        return 1e-12 * x[1], -1e12 * x[0], 0.0 * x[2]


def test_states_in_odd_units_and_states_that_stand_still():
    result, printed = trained(Still(), duration=20.0, inverse_steps=400, width=24)
    artifact = result.artifact
    assert "track" not in printed
    assert artifact.motion.factors.factors.shape[0] == 1
    runs = unseen_trajectories(Still(), 0.05, n=20, duration=20.0, seed=0)
    x_hat = KKLObserver(artifact).estimate(runs.x[..., :1] + 5e-8 * np.random.default_rng(0).normal(size=(401, 20, 1)))
    np.testing.assert_allclose((x_hat - runs.x)[200:] / [1e-6, 1e6, 300.0], 0.0, atol=0.2)


@pytest.mark.slow
def test_an_observer_finds_a_constant_bias(tmp_path):
    system = get_system("van_der_pol")
    artifact = train(system, preset(system, changes={"bias": 1.0}), tmp_path).artifact
    assert artifact.nx == 3
    assert dict(artifact.parameters) == system.parameters
    artifact.save(tmp_path / "biased.safetensors")
    env = gym.make("KKLVanDerPol-v0", measurement_noise=0.1, sensor={"bias": 0.7})
    env = KKLObservation(env, observer=tmp_path / "biased.safetensors")
    x_hat, info = env.reset(seed=0)
    assert env.observation_space.shape == x_hat.shape == (3,)
    errors = []
    for k in range(2000):
        x_hat, *_, info = env.step(np.array([np.sin(k / 50)]))
        errors.append(x_hat - [*info["x"], 0.7])
    assert np.sqrt(np.mean(np.square(errors[1000:]), 0)).max() < 0.04
