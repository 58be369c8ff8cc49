"""Certificates on a linear system, where everything is known in closed form, and on the shipped maps."""

import dataclasses
import json
import re
from itertools import pairwise
from pathlib import Path

import linear_system
import numpy as np
import pytest
from linear_system import C, F, Oscillator, sylvester
from random_artifacts import random_artifact
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov, solve_sylvester

import examples.research.certificates.certificate
import observers
from examples.research.certificates.certificate import parts
from examples.research.certificates.gains import controllability, envelope, h2, h_infinity, theorem_gain
from examples.research.certificates.generalisation import (
    forward_samples,
    generalisation_term,
    inverse_samples,
    pseudo_dimension_bound,
)
from examples.research.certificates.lipschitz import (
    lipschitz_lower,
    lipschitz_upper,
    norm_product,
    output_lipschitz,
)
from examples.research.certificates.segments import segment_lipschitz, slopes
from examples.research.certificates.settled import record_settled
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from observers import MLP, Artifact, ForwardMap, InverseMap, LinearFilter
from observers.names import resolve
from training import certify
from training.cli import main
from training.filter_noise import stationary_covariance
from training.maps.smooth import Smooth, decoder, encoder, residual

A, B = np.diag([-1.0, -2.5, -4.0]), np.ones((3, 1))
M = sylvester(A, B)
M_inv = np.linalg.pinv(M)


def linear_observer(spoiled=1.0, A=A):
    """The exact observer of the oscillator; ``spoiled`` scales its T_inv."""
    zeros, ones = np.zeros, np.ones
    return Artifact(
        filter=LinearFilter(A, B, 0.01),
        inverse=InverseMap(
            MLP([(spoiled * M_inv).astype(np.float32)], [zeros(2, np.float32)], "tanh"),
            ("z_y",), zeros(3), np.eye(3), zeros(3), zeros(2), ones(2),
        ),
        forward=ForwardMap(
            MLP([M.astype(np.float32)], [zeros(3, np.float32)], "tanh"), zeros(2), ones(2), zeros(3), ones(3)
        ),
        system="oscillator",
        parameters={},
        training={"physics_weight": 0.5, "trajectories": 100, "samples": 200},
    )  # fmt: skip


@pytest.fixture(scope="module")
def exact():
    told = []
    found = certify(
        linear_observer(), Oscillator(), measurement_noise=0.5, process_noise=0.0, trajectories=50, report=told.append
    )
    assert told[0] == 1
    assert told == sorted(told)
    assert told[-1] == parts(linear_observer())
    return found


def test_exact_maps_have_no_risk(exact):
    # what is left is the hold's error between samples, of order dt^2, and float32
    assert exact.error < 1e-9
    assert exact.forward.forward_risk < 1e-9
    assert exact.forward.pde_risk < 1e-12
    assert exact.forward.reconstruction_risk < 1e-12
    assert list(exact.forward.residual.values()) == sorted(exact.forward.residual.values())


def test_the_residual_is_that_of_the_equation():
    wrong = dataclasses.replace(linear_observer(), forward=ForwardMap(
        MLP([(M + 0.1).astype(np.float32)], [np.full(3, 0.2, np.float32)], "tanh"),
        np.array([0.3, 0.0]), np.array([2.0, 1.0]), np.zeros(3), np.array([1.0, 1.0, 3.0]),
    ))  # fmt: skip
    x = np.random.default_rng(0).uniform(-1, 1, (10, 2))
    T = np.diag([1, 1, 3.0]) @ (M + 0.1) @ np.diag([0.5, 1.0])
    offset = np.diag([1, 1, 3.0]) @ (0.2 - (M + 0.1) @ [0.15, 0.0])
    expected = x @ (T @ F - A @ T - B @ C).T - A @ offset
    assert np.allclose(residual(wrong, Oscillator(), x), expected, atol=1e-6)


def test_sensitivities_of_a_linear_observer(exact):
    assert exact.lipschitz_lower == pytest.approx(np.linalg.norm(M_inv, 2), rel=1e-6)
    assert exact.lipschitz_upper == pytest.approx(np.linalg.norm(M_inv, 2), rel=1e-6)
    assert exact.output_lipschitz == pytest.approx(1.0)
    assert exact.gain_theorem == pytest.approx(np.sqrt(3.0))  # cond(V) = 1, |B| = sqrt(3), 1
    # the noise in x_hat: the Lyapunov equation of the filter, written for [z, last y]
    linear = LinearFilter(A, B, 0.01)
    phi = np.block([[linear.transition, linear.early_y], [np.zeros((1, 3)), np.zeros((1, 1))]])
    drive = np.vstack([linear.late_y, [[1.0]]])
    P = solve_discrete_lyapunov(phi, drive @ drive.T)[:3, :3]
    assert exact.gain_h2 == pytest.approx(np.sqrt(np.trace(P)), rel=1e-9)
    predicted = 0.5 * np.sqrt(np.trace(M_inv @ P @ M_inv.T))
    assert exact.predicted_noise_error == pytest.approx(predicted, rel=1e-5)
    assert exact.measured_noise_error == pytest.approx(predicted, rel=0.03)


def test_h2_tends_to_the_continuous_one():
    # white noise on samples dt apart is continuous white noise of intensity dt
    P = solve_continuous_lyapunov(A, -B @ B.T)
    for dt, tolerance in ((0.01, 0.02), (0.001, 0.002)):
        assert h2(LinearFilter(A, B, dt)) == pytest.approx(np.sqrt(dt * np.trace(P)), rel=tolerance)


COUPLED = np.array([[-1.0, 6.0, 0.0], [0.0, -2.5, 6.0], [0.0, 0.0, -4.0]])  # far from normal


@pytest.mark.parametrize("poles", [A, COUPLED, np.array([[-0.5, 4.0, 0.0], [-4.0, -0.5, 0.0], [0.0, 0.0, -2.0]])])
def test_transients_stay_in_the_envelope(poles):
    linear, system = LinearFilter(poles, B, 0.01), Oscillator()
    T = sylvester(poles, B)
    rng = np.random.default_rng(0)
    x = simulate(system, rng.uniform(-1, 1, (40, 2)), 1000, 0.01)
    ages = np.arange(len(x))
    for disturbance in (0.0, 0.3):
        v = disturbance * rng.choice([-1.0, 1.0], (len(x), 40, 1))
        z = linear.run(system.output(x) + v, np.zeros((1000, 40, 0)), ages)
        wrong = np.linalg.norm(z - x @ T.T, axis=-1)
        bound = envelope(linear, 0.01 * ages, start=wrong[0].max(), disturbance=disturbance)
        assert (wrong.max(1) <= bound + 2e-5).all()  # the hold's error of order dt^2


def test_the_envelope_of_one_mode_is_reached():
    linear = LinearFilter(np.array([[-2.0]]), np.array([[3.0]]), 0.01)
    ages = np.array([0.0, 0.5, 2.0])
    expected = 0.7 * np.exp(-2 * ages) + 3 * 0.2 / 2 * (1 - np.exp(-2 * ages))
    assert envelope(linear, ages, start=0.7, disturbance=0.2) == pytest.approx(expected)
    # the worst disturbance, a constant of the start's sign, leads there
    z = linear.run(np.full((201, 1, 1), 0.2), np.zeros((200, 1, 0)), np.arange(201))
    ran = np.exp(-2 * 0.01 * np.arange(201)) * (0.7 - 0.3) + z[:, 0, 0]  # from 0.7 in place of where a run starts
    assert ran[[0, 50, 200]] == pytest.approx(expected, rel=1e-9)


def test_what_is_left_of_the_start(exact):
    forward = exact.forward
    corner = np.linalg.norm((LinearFilter(A, B, 0.01).equilibrium @ C - M) @ [1.0, 1.0])
    other = np.linalg.norm((LinearFilter(A, B, 0.01).equilibrium @ C - M) @ [1.0, -1.0])
    assert forward.start_error == pytest.approx(max(corner, other), rel=0.02)  # the largest of states drawn in X
    assert forward.envelope[2.0] == pytest.approx(np.exp(-2.0) * forward.start_error)
    left = exact.lipschitz_upper * forward.start_error * np.exp(-forward.forgets_start)
    assert left == pytest.approx(np.sqrt(exact.error))


def test_controllability():
    assert controllability(LinearFilter(A, B, 0.01)) > 0.1
    unseen = np.array([[1.0], [0.0], [1.0]])
    assert controllability(LinearFilter(A, unseen, 0.01)) < 1e-12
    twice = LinearFilter(np.diag([-1.0, -1.0 - 1e-6]), np.ones((2, 1)), 0.01)  # nearly one mode
    assert controllability(twice) == pytest.approx(1e-6 / np.sqrt(2), rel=1e-3)


@pytest.mark.parametrize("poles", [A, *(
    np.array([[-damping, 5.0, 0.0], [-5.0, -damping, 0.0], [0.0, 0.0, -3.0]]) for damping in (0.2, 1e-3))
])  # fmt: skip
def test_h_infinity_by_bisection(poles):
    """A gain bounds the norm if no frequency reaches it: the symplectic pencil has no eigenvalue on the circle."""
    linear = LinearFilter(poles, B, 0.01)
    phi, E, L = linear.transition, linear.early_y, linear.late_y
    # z_k = s_k + L y_k with s_k+1 = Phi s_k + (Phi L + E) y_k
    drive, n = phi @ L + E, 3

    def reached(gain):
        R = gain**2 * np.eye(1) - L.T @ L
        if np.linalg.eigvalsh(R)[0] <= 0:
            return True
        G = drive @ np.linalg.solve(R, drive.T)
        closed = phi + drive @ np.linalg.solve(R, L.T)
        Q = np.eye(n) + L @ np.linalg.solve(R, L.T)
        left = np.block([[np.eye(n), -G], [np.zeros((n, n)), closed.T]])
        right = np.block([[closed, np.zeros((n, n))], [-Q, np.eye(n)]])
        return bool((np.abs(np.abs(np.linalg.eigvals(np.linalg.solve(left, right))) - 1.0) < 1e-7).any())

    low, high = 0.0, 1e5
    for _ in range(70):
        middle = (low + high) / 2
        low, high = (middle, high) if reached(middle) else (low, middle)
    # an eigenvalue within 1e-7 of the circle counts as on it, which matters where the damping is small
    assert h_infinity(linear) == pytest.approx(high, rel=1e-5 if poles[0, 0] < -0.1 else 1e-3)
    assert h_infinity(linear) <= theorem_gain(linear)


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_lipschitz_constants_bracket_the_truth(activation):
    rng = np.random.default_rng(0)
    for trial in range(5):
        sizes = (4, 20, 15, 3)
        weights = tuple(rng.normal(size=(b, a)) for a, b in pairwise(sizes))
        network = Smooth(MLP(weights, [rng.normal(size=b) for b in sizes[1:]], activation))
        x = 3 * rng.normal(size=(2000, 4))
        lower, at = lipschitz_lower(network, x)
        upper = lipschitz_upper(network, 100)
        assert (x == at).all(1).any()
        pairs = np.linalg.norm(network(x[:1000]) - network(x[1000:]), axis=1)
        assert (pairs <= upper * np.linalg.norm(x[:1000] - x[1000:], axis=1)).all()
        assert lower <= upper < norm_product(network), trial


def test_lipschitz_constants_that_are_known():
    assert lipschitz_upper(Smooth(MLP([np.diag([3.0, 2.0])], [np.zeros(2)], "tanh"))) == pytest.approx(3.0)
    # one neuron, at its steepest in zero: |w2| |w1|; and layers of orthonormal rows, at their steepest together
    neuron = Smooth(MLP([np.array([[3.0, 4.0]]), np.array([[2.0]])], [np.zeros(1), np.zeros(1)], "tanh"))
    assert lipschitz_upper(neuron) == pytest.approx(10.0, rel=1e-3)
    assert lipschitz_lower(neuron, np.zeros((1, 2)))[0] == pytest.approx(10.0)
    turns = [np.linalg.qr(np.random.default_rng(i).normal(size=(6, 6)))[0] for i in range(3)]
    rotation = Smooth(MLP([turns[0], np.eye(6), turns[2]], [np.zeros(6)] * 3, "tanh"))
    assert lipschitz_upper(rotation) == pytest.approx(1.0, rel=1e-3)
    assert lipschitz_upper(Smooth(MLP([np.zeros((2, 3)), np.zeros((1, 2))], [np.zeros(2), np.ones(1)], "silu"))) == 0.0


def test_the_steepest_place_of_silu():
    neuron = Smooth(MLP([np.array([[3.0]]), np.array([[2.0]])], [np.zeros(1), np.zeros(1)], "silu"))
    lower, _ = lipschitz_lower(neuron, np.array([[2.39935728052 / 3.0]]))
    assert lower == pytest.approx(6.0 * 1.0998393201, rel=1e-9)
    assert lower <= lipschitz_upper(neuron) <= norm_product(neuron) < 1.000001 * lower


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_slopes_on_intervals(activation):
    rng = np.random.default_rng(0)
    low = rng.uniform(-5, 5, 300)
    high = low + rng.exponential(1.0, 300)
    least, greatest = slopes(low, high, activation)
    v = np.linspace(low, high, 401)
    step = 1e-6
    one = Smooth(MLP([np.ones((1, 1)), np.ones((1, 1))], [np.zeros(1), np.zeros(1)], activation))
    slope = (one(v.reshape(-1, 1) + step) - one(v.reshape(-1, 1) - step)).reshape(v.shape) / (2 * step)
    assert (least <= slope.min(0) + 1e-8).all()
    assert (greatest >= slope.max(0) - 1e-8).all()
    assert np.abs(least - slope.min(0)).max() < 1e-3
    assert np.abs(greatest - slope.max(0)).max() < 1e-3


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_lipschitz_constants_on_segments(activation):
    rng = np.random.default_rng(0)
    sizes = (4, 20, 15, 3)
    weights = tuple(rng.normal(size=(b, a)) for a, b in pairwise(sizes))
    network = Smooth(MLP(weights, [rng.normal(size=b) for b in sizes[1:]], activation))
    start = rng.normal(size=(30, 4))
    end = start + rng.normal(size=(30, 4)) * np.geomspace(1e-3, 1.0, 30)[:, None]
    upper = segment_lipschitz(network, start, end)
    on = start + np.linspace(0, 1, 201)[:, None, None] * (end - start)
    norms = np.linalg.norm(network.jacobian(on.reshape(-1, 4)), ord=2, axis=(1, 2)).reshape(201, 30)
    assert (norms.max(0) <= upper).all()
    assert (upper < 2.0 * norms.max(0)).all()
    assert np.median(upper) < 0.5 * lipschitz_upper(network, 100)  # which is what it is for
    assert segment_lipschitz(network, start, start) == pytest.approx(norms[0], rel=1e-6)


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_jacobians_by_differences(activation):
    rng = np.random.default_rng(1)
    network = Smooth(MLP([rng.normal(size=(7, 3)), rng.normal(size=(5, 7)), rng.normal(size=(2, 5))],
                         [rng.normal(size=7), rng.normal(size=5), rng.normal(size=2)], activation))  # fmt: skip
    x, eps = rng.normal(size=(4, 3)), 1e-6
    for j in range(3):
        step = eps * np.eye(3)[j]
        assert np.allclose(network.jacobian(x)[..., j], (network(x + step) - network(x - step)) / (2 * eps), atol=1e-7)


@pytest.mark.parametrize("name", ["van_der_pol-static", "rossler-spinn", None])
def test_the_smooth_maps_are_the_observers(name, saved):
    observer = observers.load(name or saved(process=True), 0.3, process_noise=0.03)
    y = np.random.default_rng(2).normal(size=(1, 1))
    observer.reset(y)
    for _ in range(6000):  # beyond the greatest age that the map tells apart
        x_hat = observer.step(y)
    assert np.allclose(decoder(observer.artifact, 0.3, 0.03)(observer.z), x_hat, atol=1e-4)
    if observer.artifact.forward is not None:
        x = np.random.default_rng(3).normal(size=(5, 3))
        assert np.allclose(encoder(observer.artifact.forward)(x), observer.artifact.forward(x), atol=1e-5)


def test_a_wrong_filter_violates_the_bound_without_noise(exact):
    """The bound is that of the maps for A; the observer then runs with another one."""
    spoiled = certify(linear_observer(1.05), Oscillator(), measurement_noise=0.0, process_noise=0.0, trajectories=50)
    assert 0 < spoiled.error <= spoiled.forward.bound
    wrong = certify(
        linear_observer(1.05, A=1.3 * A), Oscillator(), measurement_noise=0.0, process_noise=0.0, trajectories=50
    )
    assert wrong.error > 5 * spoiled.forward.bound
    assert wrong.forward.forward_risk > 1e-3  # which a certificate of that observer says


def test_bounds_of_the_paper_are_put_together_as_printed():
    found = certify(
        linear_observer(1.1), Oscillator(), measurement_noise=0.2, process_noise=0.1, psi=0.7, trajectories=20
    )
    forward = found.forward
    assert found.noise_bound == pytest.approx(0.6)
    assert found.process_noise_bound == pytest.approx(0.1 * np.sqrt(2))
    assert forward.physics_risk == pytest.approx(forward.forward_risk + 0.5 * forward.pde_risk)
    l2 = found.lipschitz_upper**2
    assert forward.bound == pytest.approx(4 * forward.reconstruction_risk + 4 * l2 * forward.physics_risk)
    noise = 2 * l2 * found.gain_theorem**2 * (found.output_lipschitz * 0.7 + 0.6) ** 2
    assert found.noise_term == pytest.approx(noise)
    assert forward.noisy_bound == pytest.approx(forward.bound + noise)
    assert found.noisy_error < forward.noisy_bound
    assert forward.forward_share == pytest.approx(1.0 - 4 * forward.reconstruction_risk / forward.bound)


def test_the_sharp_bounds_hold_and_are_sharper():
    """T_inv is linear, so that its constant on a segment is that everywhere; T is wrong by an offset."""
    offset = ForwardMap(
        MLP([M.astype(np.float32)], [np.full(3, 0.05, np.float32)], "tanh"),
        np.zeros(2), np.ones(2), np.zeros(3), np.ones(3),
    )  # fmt: skip
    shifted = dataclasses.replace(linear_observer(1.1), forward=offset)
    found = certify(shifted, Oscillator(), measurement_noise=0.2, process_noise=0.1, psi=0.7, trajectories=20)
    forward, steepest = found.forward, 1.1 * np.linalg.norm(M_inv, 2)
    assert forward.forward_risk == pytest.approx(3 * 0.05**2, rel=1e-2)
    assert forward.lipschitz_between == pytest.approx(steepest, rel=1e-6)
    assert forward.steep_risk == pytest.approx(steepest**2 * forward.forward_risk, rel=1e-3)
    assert forward.propagated_risk == pytest.approx(((1.1 * M_inv @ np.full(3, 0.05)) ** 2).sum(), rel=1e-2)
    rms = np.sqrt(forward.reconstruction_risk) + np.sqrt(forward.steep_risk)
    assert forward.sharp_bound == pytest.approx(rms**2)
    assert found.error < forward.sharp_bound < forward.bound
    noise = found.lipschitz_upper * found.gain_theorem * (0.7 + 0.6)
    assert forward.sharp_noisy_bound == pytest.approx((0.7 + rms + noise) ** 2)
    assert found.noisy_error < forward.sharp_noisy_bound


@pytest.mark.parametrize("name", [
    "reverse_duffing-spinn", "van_der_pol-static",
    *(pytest.param(name, marks=pytest.mark.slow) for name in (
        "reverse_duffing-static", "van_der_pol-spinn", "rossler-static", "rossler-spinn",
        "lorenz-static", "lorenz-spinn")),
])  # fmt: skip
def test_shipped_maps(name):
    system = get_system(name.rpartition("-")[0])
    found = certify(Artifact.read(resolve(name)), system, measurement_noise=0.5, trajectories=60)
    assert 0.8 < found.predicted_noise_error / found.measured_noise_error < 1.25
    assert found.lipschitz_lower <= found.lipschitz_upper
    assert found.gain_h2 < found.gain_h_infinity <= found.gain_theorem
    assert (found.forward is not None) == name.endswith("-spinn")
    if found.forward is not None:
        assert found.error <= found.forward.bound
        assert found.noisy_error <= found.forward.noisy_bound
        assert found.error <= found.forward.sharp_bound <= found.forward.bound
        assert found.noisy_error <= found.forward.sharp_noisy_bound
        assert found.forward.propagated_risk < 1.5 * found.forward.steep_risk  # the second of fewer states
    text = json.dumps(found.as_json(), allow_nan=False)
    assert json.loads(text)["inverse_term"] is None  # infinite


class Damped(Oscillator):
    """Settles at the origin, from where only process noise moves it."""

    name = "oscillator"

    def f(self, x):
        return x[1], -4.0 * x[0] - 4.0 * x[1]


def test_psi_covers_what_noise_does_where_motions_settle():
    M = solve_sylvester(-A, np.array([[0.0, 1.0], [-4.0, -4.0]]), B @ C)
    base = linear_observer()
    inverse = MLP([np.linalg.pinv(M).astype(np.float32)], [np.zeros(2, np.float32)], "tanh")
    forward = MLP([M.astype(np.float32)], [np.zeros(3, np.float32)], "tanh")
    artifact = dataclasses.replace(
        base,
        inverse=dataclasses.replace(base.inverse, mlp=inverse),
        forward=dataclasses.replace(base.forward, mlp=forward),
    )
    found = certify(artifact, Damped(), measurement_noise=0.0, process_noise=0.05, trajectories=10)
    assert found.error < 1e-8
    assert 1e-6 < found.noisy_error < found.forward.noisy_bound
    recorded = record_settled(artifact, Damped(), measurement_noise=0.0, process_noise=0.05, trajectories=10, seed=0)
    assert np.linalg.norm(recorded.noisy_x - recorded.x, axis=1).max() <= found.psi


def test_errors_by_state_in_mixed_units():
    """Of 20 K and 1e-3 mol/l: 0.03 K off, and 2 % in the concentration."""
    system, artifact = linear_system.Reactor(), linear_system.reactor_observer(offset=0.03, gain=1.02)
    found = certify(artifact, system, measurement_noise=0.0, process_noise=0.0, trajectories=20)
    size = record_settled(
        artifact, system, measurement_noise=0.0, process_noise=0.0, trajectories=20, seed=0
    ).halves()[0].x.std(0)  # fmt: skip
    assert found.nrmse == pytest.approx((100 * 0.03 / size[0], 2.0), rel=0.02)
    assert found.nrmse == found.noisy_nrmse
    assert np.sqrt(found.error) == pytest.approx(0.03, rel=0.01)  # of which the concentration is no part


def test_recordings_and_ages_follow_the_systems_pace():
    """The reactor's sampling interval is five times that of the systems that ship."""
    artifact = linear_system.reactor_observer()
    recorded = record_settled(
        artifact, linear_system.Reactor(), measurement_noise=0.0, process_noise=0.0, trajectories=2, seed=0
    )
    assert len(recorded.x) == 2 * (1 + 150 / 0.05 / 10)
    exact = dataclasses.replace(linear_system.exact_observer(), parameters={})

    class Slow(Oscillator):
        name = "oscillator"
        dt = 0.05

    found = certify(exact, Slow(), measurement_noise=0.0, process_noise=0.0, trajectories=2)
    assert list(found.forward.envelope) == pytest.approx([0.0, 5.0, 10.0, 25.0, 50.0])
    assert found.forward.envelope[5.0] == pytest.approx(found.forward.envelope[0.0] * np.exp(-5.0))


def test_the_level_is_the_systems_own_as_far_as_the_map_knows_it(monkeypatch):
    told = []

    def stop(artifact, system, *, measurement_noise, **_):
        told.append(measurement_noise)
        raise LookupError

    monkeypatch.setattr(examples.research.certificates.certificate, "record_settled", stop)
    artifact = random_artifact("van_der_pol")
    for largest in (1.0, 0.2):
        inverse = dataclasses.replace(artifact.inverse, measurement_noise_max=largest)
        with pytest.raises(LookupError):
            certify(dataclasses.replace(artifact, inverse=inverse), get_system("van_der_pol"))
    assert told == [0.5, 0.2]


def test_motions_come_in_two_halves_of_whole_motions():
    recorded = record_settled(
        linear_observer(), Oscillator(), measurement_noise=0.3, process_noise=0.1, trajectories=5, seed=0
    )
    first, second = recorded.halves()
    assert (first.trajectories, second.trajectories) == (2, 3)
    assert len(first.x) + len(second.x) == len(recorded.x)
    each = recorded.x.reshape(5, -1, 2)
    radius = np.linalg.norm(each, axis=-1)
    assert np.ptp(radius, axis=1).max() < 1e-6  # without noise each stays on its circle
    assert (first.x == each[:2].reshape(-1, 2)).all()
    assert (second.noisy_z == recorded.noisy_z[len(first.x) :]).all()


def test_noise_of_each_output():
    artifact, level = linear_system.exact_observer(0.01, np.eye(2), "two-outputs"), (0.1, 0.3)
    found = certify(artifact, linear_system.TwoOutputs(), process_noise=0.0, trajectories=50)
    assert found.measurement_noise == level  # the system's own
    assert found.noise_bound == pytest.approx((0.3, 0.9))
    each = stationary_covariance(artifact.filter)
    (L,) = artifact.inverse.mlp.weights
    predicted = np.sqrt(np.trace(L @ (0.1**2 * each[0] + 0.3**2 * each[1]) @ L.T))
    assert found.predicted_noise_error == pytest.approx(predicted, rel=1e-5)
    assert found.measured_noise_error == pytest.approx(predicted, rel=0.03)
    noise = 2 * (found.lipschitz_upper * found.gain_theorem) ** 2 * (0.3**2 + 0.9**2)
    assert found.noise_term == pytest.approx(noise)
    assert json.loads(json.dumps(found.as_json()))["measurement_noise"] == [0.1, 0.3]


def test_each_bound_has_the_map_that_its_observer_uses():
    """A map that is told the noise is another one at each level."""
    artifact = random_artifact("van_der_pol", inputs=False, age=False, forward=True)
    artifact = dataclasses.replace(artifact, training={"physics_weight": 0.1})
    found = certify(artifact, get_system("van_der_pol"), measurement_noise=0.7, process_noise=0.0, trajectories=4)
    noise_free_share = lipschitz_upper(decoder(artifact, 0.0))
    risk = found.forward.reconstruction_risk
    assert found.forward.bound == pytest.approx(4 * risk + 4 * noise_free_share**2 * found.forward.physics_risk)
    assert found.lipschitz_upper == pytest.approx(lipschitz_upper(decoder(artifact, 0.7)))
    assert abs(noise_free_share / found.lipschitz_upper - 1) > 0.01


def test_generalisation_terms():
    mlp = MLP([np.zeros((3, 2), np.float32), np.zeros((1, 3), np.float32)], [np.zeros(3), np.zeros(1)], "tanh")
    d, q, t = 13, 3, 2 * 13 + 15 + 3 + 1
    expected = (d * (q + 1)) ** 2 + 11 * d * (q + 1) * (t + np.log2(9 * d * (q + 1)))
    assert pseudo_dimension_bound(mlp) == pytest.approx(expected)
    assert generalisation_term(2.0, pseudo_dimension=100, samples=99, delta=0.05) == np.inf
    counted = {"trajectories": 10, "samples": 20, "forward_samples": 700, "inverse_samples": 900}
    recorded = {"trajectories": 10, "samples": 20}
    assert (forward_samples(counted), inverse_samples(counted)) == (700, 900)
    assert (forward_samples(recorded), inverse_samples(recorded), forward_samples({})) == (200, 200, 0)
    by_hand = 2 * np.sqrt(200 * np.log(np.e * 100) / 1e4) + 2 * np.sqrt(np.log(20) / 2e4)
    assert generalisation_term(2.0, pseudo_dimension=100, samples=10_000, delta=0.05) == pytest.approx(by_hand)


def test_bad_requests():
    with pytest.raises(observers.ArtifactError, match="system"):
        certify(linear_observer(), get_system("van_der_pol"))
    for wrong in ({"measurement_noise": -1.0}, {"measurement_noise": np.nan}, {"process_noise": -0.1}, {"psi": np.inf},
                  {"trajectories": 1}, {"trajectories": 2.5}, {"delta": 0.0}, {"delta": 1.0},
                  {"seed": -1}):  # fmt: skip
        with pytest.raises(ValueError, match=r"must|need"):
            certify(linear_observer(), Oscillator(), **wrong)
    with pytest.raises(ValueError, match="beyond"):
        certify(Artifact.read(resolve("van_der_pol-static")), get_system("van_der_pol"), measurement_noise=2.0)
    with pytest.raises(ValueError, match="no forward map"):
        residual(Artifact.read(resolve("van_der_pol-static")), get_system("van_der_pol"), np.zeros((1, 2)))


def test_motions_that_leave_are_an_error():
    class Leaving(Oscillator):
        name = "oscillator"
        bounds = ((-1.01, 1.01), (-1.01, 1.01))

    with pytest.raises(ValueError, match="stayed within"):
        certify(linear_observer(), Leaving(), measurement_noise=0.1, process_noise=5.0, trajectories=10)


def test_output_of_a_nonlinear_h():
    class Squared(Oscillator):
        name = "oscillator"

        def h(self, x):
            return (x[0] ** 2,)

    x = np.array([[0.5, 0.0], [-0.75, 9.0]])
    assert output_lipschitz(Squared(), x) == 1.5
    assert Squared().output(np.array([[0.5, 0.0]])) == pytest.approx(0.25)


def test_command(tmp_path, capsys):
    linear_observer(1.02).save(tmp_path / "mine.safetensors")
    script = linear_system.__file__
    main(["certify", str(tmp_path / "mine.safetensors"), "--system", f"{script}:Oscillator", "--trajectories", "10",
          "--measurement-noise", "0.1", "--out", str(tmp_path / "out")])  # fmt: skip
    assert json.loads((tmp_path / "out" / "mine.json").read_text())["observer"] == "mine"
    assert (tmp_path / "out" / "mine.png").stat().st_size > 10_000
    steepest = f"| Lipschitz constant of T_inv, at least | {1.02 * np.linalg.norm(M_inv, 2):.3g} |"
    assert steepest in (tmp_path / "out" / "table.md").read_text()
    printed = capsys.readouterr().out
    assert "bound of the rms error" in printed
    page = (tmp_path / "out" / "table.md").read_text()
    assert page.startswith("Measurement noise 0.1, cut at 0.3 for the bounds; ")
    assert re.search(r"\| rms error by state in % of its standard deviation, no noise \| 2 / 2 \|", page)
    with pytest.raises(SystemExit, match="unknown observer"):
        main(["certify", "nobody"])
    main(["certify", str(tmp_path / "mine.safetensors"), "--system", f"{script}:Oscillator", "--trajectories", "2",
          "--measurement-noise", "0", "--process-noise", "0", "--out", str(tmp_path / "quiet")])  # fmt: skip
    assert (tmp_path / "quiet" / "mine.png").exists()
    with pytest.raises(SystemExit, match="name an observer"):
        main(["certify"])


def test_a_map_that_does_not_know_the_level_is_left_out(tmp_path, saved, capsys):
    linear_observer().save(tmp_path / "mine.safetensors")  # which takes any
    system = f"{linear_system.__file__}:Oscillator"
    told = saved(system=system)
    options = ["--system", system, "--trajectories", "2", "--measurement-noise", "2", "--out", str(tmp_path / "out")]
    main(["certify", told, str(tmp_path / "mine.safetensors"), *options])
    name = Path(told).stem
    assert f"{name}, left out: measurement noise 2 is beyond the map's range, 0 to 1" in capsys.readouterr().out
    assert [path.name for path in sorted((tmp_path / "out").glob("*.json"))] == ["mine.json"]
    with pytest.raises(SystemExit, match=f"nothing is left to certify of {name}"):
        main(["certify", told, *options])
