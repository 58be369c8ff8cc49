"""Certificates on a linear system, where everything is known in closed form, and on the shipped maps."""

import json
import re
from itertools import pairwise
from pathlib import Path

import linear_system
import numpy as np
import pytest
from commands import research
from linear_system import Oscillator, sylvester
from scipy.linalg import solve_discrete_lyapunov

import observers
from examples.research.certificates import certify
from examples.research.certificates.gains import envelope, h_infinity, theorem_gain
from examples.research.certificates.generalisation import generalisation_term, pseudo_dimension_bound
from examples.research.certificates.lipschitz import lipschitz_lower, lipschitz_upper, norm_product
from examples.research.certificates.segments import segment_lipschitz
from examples.research.certificates.settled import record_settled
from examples.research.certificates.smooth import Smooth, decoder, encoder
from kkl_gym import SYSTEMS, get_system
from kkl_gym.simulate import simulate
from observers import MLP, Artifact, ForwardMap, InverseMap, LinearFilter
from observers.names import resolve
from training.maps.coordinates import stationary_covariance
from training.trajectories.motions import filter_states

A, B = np.diag([-1.0, -2.5, -4.0]), np.ones((3, 1))
M = sylvester(A, B)
M_inv = np.linalg.pinv(M)
COUPLED = np.array([[-1.0, 6.0, 0.0], [0.0, -2.5, 6.0], [0.0, 0.0, -4.0]])  # far from normal
DOCS = Path(__file__).parents[2] / "docs"


def linear_observer(spoiled=1.0, A=A, offset=0.0):
    """The exact observer of the oscillator; ``spoiled`` scales its T_inv, ``offset`` is an error of its T."""
    zeros, ones = np.zeros, np.ones
    return Artifact(
        filter=LinearFilter(A, B, 0.01),
        inverse=InverseMap(
            MLP([(spoiled * M_inv).astype(np.float32)], [zeros(2, np.float32)], "tanh"),
            ("z_y",), zeros(3), np.eye(3), zeros(3), zeros(2), ones(2),
        ),
        forward=ForwardMap(
            MLP([M.astype(np.float32)], [np.full(3, offset, np.float32)], "tanh"), zeros(2), ones(2), zeros(3), ones(3)
        ),
        system="oscillator",
        parameters={},
        training={"physics_weight": 0.5, "trajectories": 100, "samples": 200},
    )  # fmt: skip


@pytest.fixture(scope="module")
def exact():
    return certify(linear_observer(), Oscillator(), measurement_noise=0.5, process_noise=0.0, trajectories=50)


def test_risks_and_sensitivities_of_the_exact_observer(exact):
    assert exact.error < 1e-9  # of the hold between samples, of order dt^2, and of float32
    assert max(exact.forward.forward_risk, exact.forward.pde_risk, exact.forward.reconstruction_risk) < 1e-9
    assert exact.lipschitz_lower == pytest.approx(np.linalg.norm(M_inv, 2), rel=1e-6)
    assert exact.lipschitz_upper == pytest.approx(np.linalg.norm(M_inv, 2), rel=1e-6)
    assert exact.output_lipschitz == pytest.approx(1.0)
    assert exact.gain_theorem == pytest.approx(np.sqrt(3.0))  # cond(V) = 1, |B| = sqrt(3), 1
    # The noise in x_hat: the Lyapunov equation of the filter, written for [z, last y].
    linear = LinearFilter(A, B, 0.01)
    phi = np.block([[linear.transition, linear.early_y], [np.zeros((1, 3)), np.zeros((1, 1))]])
    drive = np.vstack([linear.late_y, [[1.0]]])
    P = solve_discrete_lyapunov(phi, drive @ drive.T)[:3, :3]
    assert exact.gain_h2 == pytest.approx(np.sqrt(np.trace(P)), rel=1e-9)
    predicted = 0.5 * np.sqrt(np.trace(M_inv @ P @ M_inv.T))
    assert exact.predicted_noise_error == pytest.approx(predicted, rel=1e-5)
    assert exact.measured_noise_error == pytest.approx(predicted, rel=0.03)


@pytest.mark.parametrize("poles", [A, COUPLED, np.array([[-0.5, 4.0, 0.0], [-4.0, -0.5, 0.0], [0.0, 0.0, -2.0]])])
def test_transients_stay_in_the_envelope(poles):
    linear, system = LinearFilter(poles, B, 0.01), Oscillator()
    T = sylvester(poles, B)
    rng = np.random.default_rng(0)
    x = simulate(system, rng.uniform(-1, 1, (40, 2)), 1000, 0.01)
    ages = np.arange(len(x))
    for disturbance in (0.0, 0.3):
        v = disturbance * rng.choice([-1.0, 1.0], (len(x), 40, 1))
        z = filter_states(linear, system.output(x) + v, np.zeros((1000, 40, 0)), ages)
        wrong = np.linalg.norm(z - x @ T.T, axis=-1)
        bound = envelope(linear, 0.01 * ages, start=wrong[0].max(), disturbance=disturbance)
        assert (wrong.max(1) <= bound + 2e-5).all()  # the hold's error of order dt^2


@pytest.mark.parametrize("damping", [1.0, 0.2, 1e-3])
def test_h_infinity_by_bisection(damping):
    """A gain bounds the norm if no frequency reaches it: the symplectic pencil has no eigenvalue on the circle."""
    linear = LinearFilter(np.array([[-damping, 5.0, 0.0], [-5.0, -damping, 0.0], [0.0, 0.0, -3.0]]), B, 0.01)
    phi, E, L = linear.transition, linear.early_y, linear.late_y
    drive, n = phi @ L + E, 3  # z_k = s_k + L y_k with s_k+1 = Phi s_k + (Phi L + E) y_k

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
    # An eigenvalue within 1e-7 of the circle counts as on it, which matters where the damping is small.
    assert h_infinity(linear) == pytest.approx(high, rel=1e-5 if damping > 0.1 else 1e-3)
    assert h_infinity(linear) <= theorem_gain(linear)


def test_lipschitz_constants_that_are_known():
    assert lipschitz_upper(Smooth(MLP([np.diag([3.0, 2.0])], [np.zeros(2)], "tanh"))) == pytest.approx(3.0)
    # One neuron, at its steepest in zero: |w2| |w1|; and layers of orthonormal rows, at their steepest together.
    neuron = Smooth(MLP([np.array([[3.0, 4.0]]), np.array([[2.0]])], [np.zeros(1), np.zeros(1)], "tanh"))
    assert lipschitz_upper(neuron) == pytest.approx(10.0, rel=1e-3)
    assert lipschitz_lower(neuron, np.zeros((1, 2)))[0] == pytest.approx(10.0)
    turns = [np.linalg.qr(np.random.default_rng(i).normal(size=(6, 6)))[0] for i in range(3)]
    rotation = Smooth(MLP([turns[0], np.eye(6), turns[2]], [np.zeros(6)] * 3, "tanh"))
    assert lipschitz_upper(rotation) == pytest.approx(1.0, rel=1e-3)
    silu = Smooth(MLP([np.array([[3.0]]), np.array([[2.0]])], [np.zeros(1), np.zeros(1)], "silu"))
    lower, _ = lipschitz_lower(silu, np.array([[2.39935728052 / 3.0]]))  # the steepest place of silu
    assert lower == pytest.approx(6.0 * 1.0998393201, rel=1e-9)
    assert lower <= lipschitz_upper(silu) <= norm_product(silu) < 1.000001 * lower


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_lipschitz_constants_everywhere_and_on_segments(activation):
    rng, sizes = np.random.default_rng(0), (4, 20, 15, 3)
    weights = tuple(rng.normal(size=(b, a)) for a, b in pairwise(sizes))
    network = Smooth(MLP(weights, [rng.normal(size=b) for b in sizes[1:]], activation))
    start = rng.normal(size=(30, 4))
    end = start + rng.normal(size=(30, 4)) * np.geomspace(1e-3, 1.0, 30)[:, None]
    upper = segment_lipschitz(network, start, end)
    everywhere = lipschitz_upper(network, 100)
    steepest, at = lipschitz_lower(network, 3 * start)
    assert (at == 3 * start).all(1).any()
    assert steepest <= everywhere < norm_product(network)
    pairs = np.linalg.norm(network(start) - network(end), axis=1)
    assert (pairs <= upper * np.linalg.norm(start - end, axis=1)).all()
    on = start + np.linspace(0, 1, 201)[:, None, None] * (end - start)
    norms = np.linalg.norm(network.jacobian(on.reshape(-1, 4)), ord=2, axis=(1, 2)).reshape(201, 30)
    assert (norms.max(0) <= upper).all()
    assert (upper < 2.0 * norms.max(0)).all()
    assert np.median(upper) < 0.5 * everywhere  # less than the constant everywhere
    assert segment_lipschitz(network, start, start) == pytest.approx(norms[0], rel=1e-6)


def test_the_bound_holds_for_the_right_filter_and_fails_for_a_wrong_one():
    how = {"measurement_noise": 0.0, "process_noise": 0.0, "trajectories": 50}
    spoiled = certify(linear_observer(1.05), Oscillator(), **how)
    assert 0 < spoiled.error <= spoiled.forward.bound
    wrong = certify(linear_observer(1.05, A=1.3 * A), Oscillator(), **how)
    assert wrong.error > 5 * spoiled.forward.bound
    assert wrong.forward.forward_risk > 1e-3  # by which its certificate shows it


def test_bounds_of_the_paper_are_put_together_as_printed_and_the_sharp_ones_are_sharper():
    """T_inv is linear, so that its constant on a segment is that everywhere; T is wrong by an offset."""
    artifact = linear_observer(1.1, offset=0.05)
    found = certify(artifact, Oscillator(), measurement_noise=0.2, process_noise=0.1, psi=0.7, trajectories=20)
    forward, steepest, l2 = found.forward, 1.1 * np.linalg.norm(M_inv, 2), found.lipschitz_upper**2
    assert found.noise_bound == pytest.approx(0.6)
    assert found.process_noise_bound == pytest.approx(0.1 * np.sqrt(2))
    assert forward.forward_risk == pytest.approx(3 * 0.05**2, rel=1e-2)
    assert forward.physics_risk == pytest.approx(forward.forward_risk + 0.5 * forward.pde_risk)
    assert forward.bound == pytest.approx(4 * forward.reconstruction_risk + 4 * l2 * forward.physics_risk)
    noise = found.lipschitz_upper * found.gain_theorem * (found.output_lipschitz * 0.7 + 0.6)
    assert found.noise_term == pytest.approx(2 * noise**2)
    assert forward.noisy_bound == pytest.approx(forward.bound + 2 * noise**2)
    assert forward.forward_share == pytest.approx(1.0 - 4 * forward.reconstruction_risk / forward.bound)
    assert forward.lipschitz_between == pytest.approx(steepest, rel=1e-6)
    assert forward.steep_risk == pytest.approx(steepest**2 * forward.forward_risk, rel=1e-3)
    assert forward.propagated_risk == pytest.approx(((1.1 * M_inv @ np.full(3, 0.05)) ** 2).sum(), rel=1e-2)
    rms = np.sqrt(forward.reconstruction_risk) + np.sqrt(forward.steep_risk)
    assert forward.sharp_bound == pytest.approx(rms**2)
    assert forward.sharp_noisy_bound == pytest.approx((0.7 + rms + noise) ** 2)
    assert found.error < forward.sharp_bound < forward.bound
    assert found.noisy_error < forward.sharp_noisy_bound < forward.noisy_bound


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
    assert json.loads(json.dumps(found.as_json()))["measurement_noise"] == [0.1, 0.3]


def test_errors_by_state_in_mixed_units_and_at_the_systems_pace():
    """Of 20 K and 1e-3 mol/l: 0.03 K off, and 2 % in the concentration."""
    system, artifact = linear_system.Reactor(), linear_system.reactor_observer(offset=0.03, gain=1.02)
    how = {"measurement_noise": 0.0, "process_noise": 0.0, "trajectories": 20}
    recorded = record_settled(artifact, system, **how, seed=0)
    assert len(recorded.x) == 20 * (1 + 150 / 0.05 / 10)  # its dt is five times that of the systems that ship
    first, second = recorded.halves()
    assert (first.trajectories, second.trajectories) == (10, 10)
    found = certify(artifact, system, **how, recorded=recorded)
    assert found.nrmse == pytest.approx((100 * 0.03 / first.x.std(0)[0], 2.0), rel=0.02)
    assert np.sqrt(found.error) == pytest.approx(0.03, rel=0.01)  # of which the concentration is no part


def test_generalisation_terms():
    mlp = MLP([np.zeros((3, 2), np.float32), np.zeros((1, 3), np.float32)], [np.zeros(3), np.zeros(1)], "tanh")
    d, q, t = 13, 3, 2 * 13 + 15 + 3 + 1
    expected = (d * (q + 1)) ** 2 + 11 * d * (q + 1) * (t + np.log2(9 * d * (q + 1)))
    assert pseudo_dimension_bound(mlp) == pytest.approx(expected)
    assert generalisation_term(2.0, pseudo_dimension=100, samples=99, delta=0.05) == np.inf
    by_hand = 2 * np.sqrt(200 * np.log(np.e * 100) / 1e4) + 2 * np.sqrt(np.log(20) / 2e4)
    assert generalisation_term(2.0, pseudo_dimension=100, samples=10_000, delta=0.05) == pytest.approx(by_hand)


def test_bad_requests():
    with pytest.raises(observers.ArtifactError, match="system"):
        certify(linear_observer(), get_system("van_der_pol"))
    for name, value in (("measurement_noise", -1.0), ("process_noise", -0.1), ("psi", np.inf), ("trajectories", 1)):
        with pytest.raises(ValueError, match=f"{name}.* must"):
            certify(linear_observer(), Oscillator(), **{name: value})

    class Leaving(Oscillator):
        bounds = ((-1.01, 1.01), (-1.01, 1.01))

    with pytest.raises(ValueError, match="stayed within"):
        certify(linear_observer(), Leaving(), measurement_noise=0.1, process_noise=5.0, trajectories=10)


def test_the_command_certifies_an_own_map_beside_a_shipped_one_that_tracks(tmp_path, capsys):
    linear_observer(1.02).save(tmp_path / "mine.safetensors")
    own = (str(tmp_path / "mine.safetensors"), "--system", f"{linear_system.__file__}:Oscillator")
    research("certify", *own, "--trajectories", "10", "--measurement-noise", "0.1", "--out", str(tmp_path / "own"))
    assert json.loads((tmp_path / "own" / "mine.json").read_text())["observer"] == "mine"
    assert (tmp_path / "own" / "mine.png").stat().st_size > 10_000
    page = (tmp_path / "own" / "table.md").read_text()
    assert page.startswith("Measurement noise 0.1, cut at 0.3 for the bounds; ")
    assert f"| Lipschitz constant of T_inv, at least | {1.02 * np.linalg.norm(M_inv, 2):.3g} |" in page
    assert re.search(r"\| rms error by state in % of its standard deviation, no noise \| 2 / 2 \|", page)
    assert "bound of the rms error" in capsys.readouterr().out
    out = tmp_path / "shipped"
    research("certify", "lorenz", "--trajectories", "2", "--out", str(out))
    assert "lorenz tracks; this is the certificate of its T_inv alone" in capsys.readouterr().out
    page = (out / "table.md").read_text()
    assert "| lorenz, T_inv alone |" in page
    assert "sharp bound" not in page  # which needs T
    with pytest.raises(SystemExit, match="nothing is left to certify of lorenz"):
        research("certify", "lorenz", "--measurement-noise", "9", "--out", str(out))
    assert "left out: measurement noise 9 is beyond the map's range" in capsys.readouterr().out


@pytest.mark.research
@pytest.mark.parametrize("name", [f"{system}-{kind}" for system in SYSTEMS for kind in ("large", "spinn")])
def test_shipped_maps(name):
    system = get_system(name.rpartition("-")[0])
    found = certify(Artifact.read(resolve(name)), system, measurement_noise=0.5, trajectories=60)
    assert 0.8 < found.predicted_noise_error / found.measured_noise_error < 1.25
    assert found.lipschitz_lower <= found.lipschitz_upper
    assert found.gain_h2 < found.gain_h_infinity <= found.gain_theorem
    assert (found.forward is not None) == name.endswith("-spinn")
    if found.forward is not None:
        assert found.error <= found.forward.sharp_bound <= found.forward.bound
        assert found.noisy_error <= found.forward.sharp_noisy_bound
        assert found.noisy_error <= found.forward.noisy_bound
        assert found.forward.propagated_risk < 1.5 * found.forward.steep_risk  # the second of fewer states
    assert json.loads(json.dumps(found.as_json(), allow_nan=False))["inverse_term"] is None  # infinite


@pytest.mark.parametrize("activation", ["tanh", "silu"])
def test_jacobians_by_differences(activation):
    rng = np.random.default_rng(1)
    network = Smooth(MLP([rng.normal(size=(7, 3)), rng.normal(size=(5, 7)), rng.normal(size=(2, 5))],
                         [rng.normal(size=7), rng.normal(size=5), rng.normal(size=2)], activation))  # fmt: skip
    x, eps = rng.normal(size=(4, 3)), 1e-6
    for j in range(3):
        step = eps * np.eye(3)[j]
        assert np.allclose(network.jacobian(x)[..., j], (network(x + step) - network(x - step)) / (2 * eps), atol=1e-7)


@pytest.mark.parametrize("name", ["van_der_pol-large", "rossler-spinn"])
def test_the_smooth_maps_are_the_observers(name):
    tracks = False if name.endswith("-large") else None
    observer = observers.load(name, 0.3, process_noise=0.03, tracking=tracks)
    y = np.random.default_rng(2).normal(size=(1, 1))
    observer.reset(y)
    for _ in range(6000):  # beyond the greatest age that the map tells apart
        x_hat = observer.step(y)
    assert np.allclose(decoder(observer.artifact, 0.3, 0.03)(observer.z), x_hat, atol=1e-4)
    if observer.artifact.forward is not None:
        x = np.random.default_rng(3).normal(size=(5, 3))
        assert np.allclose(encoder(observer.artifact.forward)(x), observer.artifact.forward(x), atol=1e-5)
