"""Observers that are taught to track, where the truth is known: on a linear system, and on one whose flow is exact."""

import dataclasses

import numpy as np
import pytest
import torch
from linear_system import Oscillator
from rich.console import Console
from tracking import DT, exact_motion, plain_observer

from kkl_gym import get_system
from observers import MLP, Artifact, KKLObserver, Limits, load
from training.commands.tracking import Tracking
from training.evaluation.coverage import coverage
from training.evaluation.errors import errors, unseen_trajectories
from training.maps import flow, regions
from training.progress import progress_bars
from training.teaching import tracking
from training.teaching.tracking import learn_tracking
from training.trajectories.controllers import linear_quadratic
from training.trajectories.noise import draw_process_noise


class Noiseless(Oscillator):
    """Process noise, which T_inv of the exact observer follows slowly, is not what is tested here."""

    name = "oscillator"
    process_noise = 0.0


@pytest.fixture(scope="module", autouse=True)
def small():
    """Few simulations: a linear flow needs no more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow, "PAIRS", 8_000)
        patch.setattr(flow, "RUNS", 40)
        for module in (tracking, regions):
            patch.setattr(module, "LEVELS", (0.0, 0.1, 0.3))
        yield


@pytest.fixture(scope="module")
def learned():
    return learn_tracking(plain_observer(), Noiseless(), steps=20, trajectories=200)


def test_a_linear_flow_is_found_exactly(learned):
    x, (Phi, _) = np.random.default_rng(0).uniform(-1, 1, (200, 2)), exact_motion()
    np.testing.assert_allclose(learned.flow(x, np.zeros((200, 0))), x @ Phi.T, atol=1e-6)
    assert (learned.flow.error < 1e-6).all()
    assert learned.flow.window == pytest.approx(0.5 * Noiseless().pace)
    before, after = plain_observer().inverse, learned.inverse
    np.testing.assert_array_equal(before.mlp.weights[0], after.mlp.weights[0])
    np.testing.assert_array_equal(before.spread.factors, after.spread.factors)


@pytest.mark.parametrize("worse", [False, True])
def test_what_learned_many_samples_is_taken_unless_it_is_less_sure_of_one(worse, monkeypatch):
    asked = []

    def learn_ahead(flow, courses, *, steps, **_):
        asked.append((courses.x.shape[0], steps))
        return dataclasses.replace(flow, gain=flow.gain + 1e-9, polynomial=flow.polynomial * (1.2 if worse else 1.0))

    monkeypatch.setattr(tracking, "learn_ahead", learn_ahead)
    found = learn_tracking(plain_observer(), Noiseless(), steps=80, trajectories=50).flow
    assert asked == [(101, 10)]
    monkeypatch.setattr(tracking, "learn_ahead", lambda flow, *_, **__: flow)
    without = learn_tracking(plain_observer(), Noiseless(), steps=80, trajectories=50).flow
    assert (found.gain == without.gain).all() == worse
    if worse:  # the same training again
        np.testing.assert_array_equal(found.mlp.weights[0], without.mlp.weights[0])
        np.testing.assert_array_equal(found.factors.factors, without.factors.factors)


class Slow(Noiseless):
    scale = (2.0, 0.5)
    pace = 4.0


def test_process_noise_is_that_of_simulations_at_the_systems_pace():
    found = learn_tracking(plain_observer(), Slow(), steps=2, trajectories=50).flow
    w = draw_process_noise(Slow(), 1.0, n=100, steps=200, rng=np.random.default_rng(0))
    np.testing.assert_allclose(found.process_noise * found.x_scale, DT * w.std((0, 1)), rtol=0.03)
    assert found.least_process_noise == pytest.approx(0.002 / 4.0)


def test_the_monitors_limits_are_those_of_the_observer_that_tracks(monkeypatch):
    limits = Limits(np.zeros(1), np.ones((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), 0.5, 1.0, 0.01, 20.0)
    seen = []

    def calibrate(artifact, system, **options):
        seen.append(artifact)
        return artifact

    monkeypatch.setattr(tracking, "calibrate", calibrate)
    sure = dataclasses.replace(plain_observer(), limits=limits)
    found = learn_tracking(sure, Noiseless(), steps=2, trajectories=50)
    assert [each.flow for each in seen] == [found.flow]
    assert np.ptp(found.flow.factors.factors) > 0  # after its covariances


def test_errors_fall_and_regions_hold_them(learned):
    system, level = Noiseless(), 0.3
    runs = unseen_trajectories(system, DT, n=400, duration=12.0, seed=7)
    plain, tracked = (
        errors(each, system, runs, measurement_noise=level, seed=7) for each in (plain_observer(), learned)
    )
    assert np.median(tracked.late) < 0.7 * np.median(plain.late)
    (late,) = coverage(learned, system, runs, measurement_noise=level, seed=7, spans=(slice(100, None),))
    assert late.joint[1] == pytest.approx(0.9, abs=0.04)


def test_a_sensor_without_noise_is_taken_to_have_a_little():
    sure = dataclasses.replace(plain_observer(), measurement_noise=0.0)
    found = learn_tracking(sure, Noiseless(), steps=200, trajectories=50)
    assert found.flow.least_measurement_noise == pytest.approx(1e-4 * found.flow.x_scale[:1], rel=0.1)
    (Phi, _), x = exact_motion(), [np.array([0.7, -0.4])]
    for _ in range(300):
        x.append(Phi @ x[-1])
    observer = KKLObserver(found, 0.0, process_noise=0.0)
    observer.reset(x[0][:1])
    for state in x[1:]:
        x_hat = observer.step(state[:1])
        assert (np.linalg.eigvalsh(observer.covariance) > 0).all()
    np.testing.assert_allclose(x_hat, x[-1], atol=1e-3)
    sure_of_it = observer.std
    for _ in range(100):
        observer.step(None)
    assert (observer.std > 2 * sure_of_it).all()  # what is missing tells nothing


@pytest.mark.parametrize(("bent", "thin", "widths"), [(False, True, [4, 2]), (True, False, [24, 24, 2])])
def test_a_motion_that_is_a_polynomial_is_found_exactly(bent, thin, widths):
    """In units of which none is 1. Where a polynomial leaves much, it is linear, and the network a wide one."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2000, 2)) * (3.0, 0.2) + (1.0, -0.5)
    u = rng.uniform(-4, 4, (2000, 1))
    change = np.column_stack([0.1 * x[:, 1] - 0.01 * x[:, 0] ** 3, 0.02 * u[:, 0] + 0.05 * x[:, 0] * x[:, 1]])
    change += bent * 0.01 * np.sin(9 * x)
    increments = flow.Increments(x, u, change, x.mean(0), x.std(0))
    with progress_bars(None) as progress:
        found = flow.fit_flow(
            increments,
            np.array([4.0]),
            degrees=(3,),
            steps=1,
            seed=0,
            small=thin,
            progress=progress,
            low=np.full(2, -20.0),
            high=np.full(2, 20.0),
            process_noise=np.zeros(2),
            least_process_noise=1.0,
            least_measurement_noise=np.ones(1),
            window=1.0,
        )
    assert found.degree == (1 if bent else 3)
    assert [len(weights) for weights in found.mlp.weights] == widths
    if not bent:
        assert np.abs(found(x, u) - x - change).max() < 1e-12
        # 1, x1, x1^2, x1^3 and x2 of the first state; 1, x1, x2, x1 x2 and u of the second.
        assert (found.polynomial != 0).sum(1).tolist() == [5, 5]


def test_where_a_degree_leaves_much_the_next_one_is_tried_and_its_terms_that_do_not_matter_are_left_out():
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(5000, 2)), rng.uniform(-1, 1, (5000, 1))
    x -= x.mean(0)
    change = np.column_stack([0.1 * x[:, 1], 0.02 * u[:, 0] - 0.01 * x[:, 0] ** 6])
    increments = flow.Increments(x, u, change, x.mean(0), x.std(0))
    problem = flow.FlowProblem(increments, np.ones(1), degrees=(5, 6, 7), small=False, device=torch.device("cpu"))
    assert problem.polynomial.shape == (2, 84)  # of degree 6
    assert (problem.polynomial != 0).sum(1).tolist() == [1, 2]  # x2; u and the power of x1


def test_inputs_are_learned():
    artifact = load("van_der_pol").artifact
    system = get_system("van_der_pol")
    short = dataclasses.replace(artifact, limits=None, training={**artifact.training, "duration": 4.0})
    found = learn_tracking(short, system, steps=10, trajectories=50)
    assert found.flow.nu == 1
    assert found.flow.degree == 7  # and not asked far beyond what it was fitted to
    assert (found.flow.high >= system.box(2.0)[1]).all()
    assert (found.flow.high < [12, 30]).all()
    assert (found.flow.low <= system.box(2.0)[0]).all()
    assert (found.flow.low > [-12, -30]).all()
    x = np.array([[1.5, 0.3]])
    still, pushed = (found.flow(x, np.array([[u]]))[0, 1] for u in (0.0, 5.0))
    assert pushed - still == pytest.approx(5.0 * 0.01, rel=0.2)


def test_under_a_policy_there_is_no_free_motion_to_calibrate_on():
    artifact, system = load("van_der_pol").artifact, get_system("van_der_pol")
    short = dataclasses.replace(artifact, limits=None, training={**artifact.training, "duration": 2.0})
    found = learn_tracking(short, system, steps=3, trajectories=50, policy=linear_quadratic(system)).flow
    np.testing.assert_array_equal(found.free_factors.factors, found.factors.factors)
    assert np.ptp(found.factors.factors[0, 0]) > 0


def test_what_cannot_track_is_refused(make_artifact):
    with pytest.raises(ValueError, match="no error bars"):
        learn_tracking(dataclasses.replace(plain_observer(), inverse=_bare()), Noiseless())
    with pytest.raises(ValueError, match="50 trajectories"):
        learn_tracking(plain_observer(), Noiseless(), trajectories=3)
    ranged = dataclasses.replace(plain_observer(), parameters={"k": 1.0}, parameter_ranges={"k": (0.9, 1.1)})
    object.__setattr__(ranged, "check", lambda *_, **__: None)  # a system with such a parameter
    with pytest.raises(ValueError, match="of one plant"):
        learn_tracking(ranged, Noiseless())
    with pytest.raises(ValueError, match="made for the system"):
        learn_tracking(plain_observer(), get_system("lorenz"))


def _bare():
    return dataclasses.replace(plain_observer().inverse, spread=None)


def test_errors_that_grow_with_how_far_the_state_moves_are_found(learned):
    """On increments that a flow misses by 0.3 times the square of their length, and by less."""
    rng, n = np.random.default_rng(0), 20_000
    silent = MLP([np.zeros((4, 4)), np.zeros((2, 4))], [np.zeros(4), np.zeros(2)], "tanh")
    by_inputs = np.hstack([np.zeros((2, 3)), np.eye(2)])
    moves = dataclasses.replace(learned.flow, u_scale=np.ones(2), mlp=silent, polynomial=by_inputs, gain=np.zeros(2))
    steps = np.exp(rng.uniform(-9, 0, (n, 1))) * rng.normal(size=(n, 2))
    for share, expected in ((0.3, 0.3), (0.03, None)):
        missed = share * (steps**2).sum(-1, keepdims=True) * rng.normal(size=(n, 2))
        change, x = (steps + missed) * moves.x_scale, np.tile(moves.x_offset, (n, 1))
        found = flow.usual_bend(moves, flow.Increments(x, steps, change, moves.x_offset, moves.x_scale))
        assert found is None if expected is None else found == pytest.approx(expected, rel=0.25)


def test_the_command_writes_it(tmp_path, monkeypatch):
    console, source = Console(width=200, record=True), tmp_path / "map.safetensors"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "training.commands.teaching.read_observers", lambda *_: [("map", plain_observer(), Noiseless())]
    )
    plain_observer().save(source)
    found = Tracking(str(source), steps=2, trajectories=50).run(console)
    written = Artifact.read(tmp_path / "runs/tracking/map.safetensors")
    np.testing.assert_array_equal(written.flow.factors.factors, found.flow.factors.factors)
    y = np.random.default_rng(0).normal(size=(20, 2, 1))
    assert not np.allclose(KKLObserver(written, 0.2).estimate(y), KKLObserver(plain_observer(), 0.2).estimate(y))
    assert f"kkl-gym evaluate {source} runs/tracking/map.safetensors says what it gains" in console.export_text()
    with pytest.raises(ValueError, match=r"must end in \.safetensors"):
        Tracking(str(source), out=tmp_path / "map").run(console)
    with pytest.raises(ValueError, match="is the map that is taught, which would be lost"):
        Tracking(str(source), out=source).run(console)
