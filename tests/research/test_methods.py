"""Each learned method of the benchmark, where the truth is known."""

import importlib
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from linear_system import Oscillator, sylvester
from scipy.signal import bessel

from examples.research.benchmark.protocol import run
from examples.research.methods import ABLATION, METHODS, Budget, Task, get_method
from examples.research.methods.ablation import PENALTY, PapersSPINN
from examples.research.methods.autoencoder import _Problem as _AEProblem
from examples.research.methods.dmf import FORGET, Switching
from examples.research.methods.gru import Recurrent, _Network
from examples.research.methods.gru import _Problem as _GRUProblem
from examples.research.methods.recurrent import rollout
from kkl_gym.simulate import simulate
from kkl_gym.systems import VanDerPol
from observers import Artifact, LinearFilter
from training.maps.smooth import decoder

SMALL = Budget(
    "small", trajectories=100, duration=25.0, samples=60, cpu_seconds=math.inf, width=32, depth=2, dt=0.05, steps=600
)


def trained_on_oscillator(name, tmp_path, configuration=0, **changes):
    method, system = get_method(name), Oscillator()
    budget = Budget(**{**vars(SMALL), **changes})
    trained = method.train(Task(system, budget, tmp_path), method.configurations(system)[configuration])
    return method, system, trained, budget.dt


def oscillations(dt, seconds=30.0, n=8, seed=0):
    system = Oscillator()
    x0 = np.random.default_rng(seed).uniform(*system.box(), (n, 2))
    return simulate(system, x0, round(seconds / dt), dt)


@pytest.mark.parametrize(
    ("name", "steps", "tolerance"),
    [
        ("spinn", 1000, 0.1),
        ("ae", 800, 0.05),
        pytest.param("spinn", 8000, 0.01, marks=pytest.mark.slow),
        pytest.param("ae", 8000, 0.01, marks=pytest.mark.slow),
    ],
)
def test_forward_map_of_a_linear_system_is_the_sylvester_solution(name, steps, tolerance, tmp_path):
    _, system, artifact, _ = trained_on_oscillator(name, tmp_path, steps=steps)
    M = sylvester(artifact.filter.A, artifact.filter.B)
    x = np.random.default_rng(1).uniform(*system.box(), (1000, 2))
    z = x @ M.T
    assert np.sqrt(((artifact.forward(x) - z) ** 2).mean() / (z**2).mean()) < tolerance
    back = decoder(artifact, 0.0)(z)  # long after the start, without noise
    assert np.sqrt(((back - x) ** 2).mean() / (x**2).mean()) < max(3 * tolerance, 0.05)  # T's error, magnified


def test_ae_is_trained_in_full_for_the_cutoff_that_did_best(tmp_path):
    method, system, artifact, _ = trained_on_oscillator("ae", tmp_path / "a", steps=3)
    settled = method.settled(method.configurations(system)[0], artifact)
    assert settled["cutoff"] == artifact.training["cutoff"]
    task = Task(system, replace(SMALL, steps=3), tmp_path / "b")
    again = method.train(task, {**settled, "cutoff": 1.25})
    assert again.training["cutoff"] == 1.25
    assert not list((tmp_path / "b").glob("every-cutoff*"))


def late_error(x, x_hat):
    """Over the second half, relative to the size of the motion."""
    late = slice(len(x) // 2, None)
    return np.sqrt(((x_hat - x)[late] ** 2).mean() / (x[late] ** 2).mean())


def decay_rate(difference, dt, first, last):
    """Of |difference| between two times in seconds, by a line through its logarithm, in 1/s."""
    k = np.arange(round(first / dt), round(last / dt))
    return -np.polyfit(k * dt, np.log(np.linalg.norm(difference[k], axis=-1).mean(-1)), 1)[0]


def test_node_converges_at_the_rate_of_its_slowest_eigenvalue(tmp_path):
    method, system, artifact, dt = trained_on_oscillator("node", tmp_path, configuration=1)
    x = oscillations(dt)
    y = system.output(x)
    x_hat = run(method.observer(artifact, system, dt, 0.0), y)
    assert late_error(x, x_hat) < 0.1
    misled = y.copy()
    misled[0] += 0.1  # only the start differs from here on
    slowest = -artifact.filter.A.diagonal().max()
    assert slowest != pytest.approx(1.0, abs=1e-4)  # it was learned, 1 is where it began
    rate = decay_rate(run(method.observer(artifact, system, dt, 0.0), misled) - x_hat, dt, 4.0, 12.0)
    assert rate == pytest.approx(slowest, rel=0.1)


@pytest.mark.slow
def test_dmf_converges_at_the_rate_of_its_slowest_eigenvalue(tmp_path):
    method, system, arrays, dt = trained_on_oscillator("dmf", tmp_path, configuration=1, steps=400)
    for stage in ("transient", "asymptotic"):
        assert np.abs(np.linalg.eigvals(arrays[f"{stage}.A"])).max() < 1
    x = oscillations(dt)
    y = system.output(x)
    x_hat = run(method.observer(arrays, system, dt, 0.0), y)
    assert late_error(x, x_hat) < 0.1
    one_stage = {**arrays, **{k.replace("transient", "asymptotic"): v for k, v in arrays.items() if "transient" in k}}
    misled = y.copy()
    misled[0] += 0.1
    rate = decay_rate(run(Switching(one_stage, system), misled) - run(Switching(one_stage, system), y), dt, 4.0, 12.0)
    slowest = -np.log(np.abs(np.linalg.eigvals(arrays["transient.A"])).max()) / dt
    assert rate == pytest.approx(slowest, rel=0.1)


def test_dmf_switches_to_the_smaller_filtered_innovation(tmp_path):
    method, system, arrays, dt = trained_on_oscillator("dmf", tmp_path, steps=5)
    broken = {**arrays, "transient.x_offset": np.array([5.0, 5.0])}  # its innovation is about 5 from now on
    y = system.output(oscillations(dt, 1.0))
    observer = method.observer(broken, system, dt, 0.0)
    first = run(observer, y)
    assert np.abs(first[0] - 5).max() < 3  # the transient observer begins
    asymptotic = broken | {k.replace("asymptotic", "transient"): v for k, v in broken.items() if "asymptotic" in k}
    np.testing.assert_allclose(first[1:], run(Switching(asymptotic, system), y)[1:])
    assert 0 < FORGET < 1


@pytest.mark.parametrize("ny", [1, 2])
def test_rollout_is_the_filter_sample_by_sample(ny):
    rng = np.random.default_rng(0)
    A = -np.diag(rng.uniform(0.5, 5.0, 4)) + np.triu(rng.normal(size=(4, 4)), 1)
    linear = LinearFilter(A, rng.normal(size=(4, ny)), 0.05)
    y = rng.normal(size=(301, 3, ny))
    ages = np.array([0, 1, 2, 7, 8, 150, 300])
    expected = linear.run(y, np.zeros((300, 3, 0)), ages)
    parts = (torch.as_tensor(part) for part in (linear.transition, linear.early_y, linear.late_y))
    found = rollout(*parts, z0=torch.as_tensor(expected[0]), y=torch.as_tensor(y.swapaxes(0, 1)), ages=ages)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-10, atol=1e-12)


def test_node_filter_is_the_one_it_was_trained_with(tmp_path):
    from examples.research.methods import node

    seen = {}
    original = node.rollout

    def spy(transition, early, late, **named):
        seen.update(transition=transition.detach().numpy(), early=early.detach().numpy(), late=late.detach().numpy())
        return original(transition, early, late, **named)

    node.rollout = spy
    try:
        _, _, artifact, _ = trained_on_oscillator("node", tmp_path, steps=1)
    finally:
        node.rollout = original
    linear = artifact.filter  # one step of Adam moves the rates by a relative 5e-3 / 1 at most
    np.testing.assert_allclose(seen["transition"], linear.transition, rtol=1e-2)
    np.testing.assert_allclose(seen["early"], linear.early_y, rtol=1e-2)
    np.testing.assert_allclose(seen["late"], linear.late_y, rtol=1e-2)


@pytest.mark.slow
def test_gru_learns_and_steps_as_it_was_trained(tmp_path):
    method, system, arrays, dt = trained_on_oscillator("gru", tmp_path, steps=200)
    x = oscillations(dt)
    y = system.output(x)
    x_hat = run(method.observer(arrays, system, dt, 0.0), y)
    assert late_error(x, x_hat) < 0.3
    network = _Network(1, 2, 64)
    scaling = {"y_offset", "y_scale", "x_offset", "x_scale"}
    network.load_state_dict({k: torch.as_tensor(v) for k, v in arrays.items() if k not in scaling})
    scaled = torch.as_tensor((y - arrays["y_offset"]) / arrays["y_scale"], dtype=torch.float32)
    with torch.no_grad():
        whole = arrays["x_offset"] + arrays["x_scale"] * network.readout(network.gru(scaled)[0]).numpy()
    np.testing.assert_allclose(run(Recurrent(arrays), y), whole, atol=1e-4)


def test_default_estimates_the_oscillator(tmp_path):
    method, system, artifact, dt = trained_on_oscillator("default", tmp_path, steps=600)
    assert artifact.nu == 1
    x = oscillations(dt)
    x_hat = run(method.observer(artifact, system, dt, 0.0), system.output(x))
    assert late_error(x, x_hat) < 0.2


@pytest.mark.parametrize("ny", [1, 2])
def test_the_autoencoder_has_the_poles_of_a_bessel_filter(ny, tmp_path):
    class Measured(Oscillator):
        name = "measured"

        def h(self, x):
            return x[:ny]

    problem = _AEProblem(Task(Measured(), SMALL, tmp_path), 0.5, 8.0)
    expected = np.sort_complex(bessel(3, 1.0, analog=True, output="zpk", norm="phase")[1])
    for output in range(ny):
        block = slice(3 * output, 3 * output + 3)
        np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(problem.D[block, block])), expected, atol=1e-9)
    assert problem.D.shape == (3 * ny, 3 * ny)
    np.testing.assert_array_equal(problem.F, np.kron(np.eye(ny), np.ones((3, 1))))


def test_gain_tuning_takes_the_least_of_the_authors_criterion(tmp_path):
    problem = _AEProblem(Task(Oscillator(), SMALL, tmp_path), 0.5, 8.0)
    for network in (
        problem.encoder,
        problem.decoder,
    ):  # maps that ignore the cutoff: only the transient gain depends on it
        network.linear_layers()[0].weight.data[:, -1] = 0.0
    assert problem.best_cutoff() == pytest.approx(0.5)


def test_autoencoder_learns_at_states_that_the_system_draws(tmp_path):
    class Ring(Oscillator):
        name = "ring"

        def draw_starts(self, rng, n, factor=1.0):
            angle = rng.uniform(-np.pi, np.pi, n)
            return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    problem = _AEProblem(Task(Ring(), SMALL, tmp_path), 0.5, 8.0)
    x = problem.draw(100, torch.Generator().manual_seed(0)).numpy()
    np.testing.assert_allclose(np.hypot(x[:, 0], x[:, 1]), 1.0, atol=1e-5)


@pytest.mark.parametrize(("name", "expected"), [("node", 0.0), ("node-noise", 0.1), ("dmf", 0.0), ("dmf-noise", 0.1)])
def test_noise_variants_see_noise_in_training(name, expected, tmp_path, monkeypatch):
    module = importlib.import_module(f"examples.research.methods.{name[:4].rstrip('-')}")
    seen = []

    class Spy(module.Batches):
        def __call__(self, generator):
            y, ages, x = super().__call__(generator)
            seen.append(y.numpy())
            return y, ages, x

    monkeypatch.setattr(module, "Batches", Spy)
    trained_on_oscillator(name, tmp_path, steps=1)
    roughness = np.diff(seen[0], axis=1).std()  # of the clean output at dt = 0.05 about 0.03
    assert roughness == pytest.approx(math.hypot(0.03, expected * math.sqrt(2)), abs=0.02)


def test_gru_sees_every_noise_level_in_training(tmp_path):
    task = Task(Oscillator(), SMALL, tmp_path)
    data = task.data
    torch.manual_seed(0)
    problem, generator, fed = _GRUProblem(task, hidden=8, chunk=50), torch.Generator().manual_seed(0), []
    problem.network.gru.register_forward_pre_hook(lambda _, inputs: fed.append(inputs[0]))
    problem.loss(generator)
    level = problem.level[:, 0].numpy()
    assert 0.3 < (level == 0).mean() < 0.7
    assert 0.8 < level.max() <= 1.0  # of the system's own
    clean = (data.y[:50, problem.rows.numpy()] - problem.scaling["y_offset"]) / problem.scaling["y_scale"]
    noise = (fed[0].numpy() - clean).std(0)[:, 0] * problem.scaling["y_scale"]
    np.testing.assert_allclose(noise, level * Oscillator().measurement_noise, atol=0.03)
    assert noise[level == 0].max() < 1e-5
    for _ in range(11):  # the hidden state goes on through a trajectory and begins anew with the next
        problem.loss(generator)
    assert int(problem.position) == 50


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("name = label = 'mine'", "must define observer, train"),
        ("label = 'mine'\n    train = observer = None", "class variables name and label"),
        ("name = 'mine'\n    train = observer = None", "class variables name and label"),
        ("name = label = 'ekf'\n    train = observer = None", "takes the name 'ekf' of another"),
    ],
)
def test_methods_that_lack_something(body, message, tmp_path):
    (tmp_path / "mine.py").write_text(
        f"from examples.research.methods import Method\n\n\nclass Mine(Method):\n    {body}\n"
    )
    with pytest.raises(ValueError, match=message):
        get_method(f"{tmp_path / 'mine.py'}:Mine")


def test_training_data_is_the_same_for_everyone_and_matches_the_states(tmp_path):
    system = Oscillator()
    data = Task(system, SMALL, tmp_path).data
    assert data is Task(Oscillator(), replace(SMALL, cpu_seconds=1.0), tmp_path).data
    assert data.x.shape == (len(data.ages), 100, 2)
    assert data.y.shape == (501, 100, 1)
    np.testing.assert_allclose(data.y[data.ages], system.output(data.x), atol=1e-6)


def test_each_step_from_the_papers_spinn_to_the_presets_gives_back_what_it_says(tmp_path):
    task = Task(VanDerPol(), SMALL, tmp_path)
    steps = [cls() for cls in ABLATION.values() if issubclass(cls, PapersSPINN)]
    before = steps[0].changes(task)
    names = {"SPINN by SOAP": {"optimiser", "learning_rate", "batch"}, "smooth T": {"eigenvalues", "pairs"}}
    names |= {"along motions": {"collocation", "box_factor"}, "relative errors": {"scaling"}}
    names |= {"output layer solved": {"solved_output_layer"}, "transients and noise": {"transients"}}
    for method in steps[1:-2]:
        after = method.changes(task)
        assert {**before, **after} == before
        assert set(before) - set(after) == names.pop(method.label.removeprefix("... "))
        before = after
    assert not names
    assert before == {"adaptive": False}  # otherwise the preset
    assert steps[-2].changes(task) == {"adaptive": True}
    assert steps[-1].changes(task) == {"adaptive": True, "lipschitz_penalty": PENALTY}


@pytest.mark.parametrize("name", sorted(METHODS | ABLATION))
def test_saved_and_loaded_is_the_same_observer(name, tmp_path):
    # The oscillator has no parameters that a Kalman filter could be wrong about.
    method, system = get_method(name), VanDerPol() if name == "ekf-wrong" else Oscillator()
    budget = Budget(
        "tiny", trajectories=10, duration=25.0, samples=20, cpu_seconds=math.inf, width=8, depth=1, dt=0.02, steps=2
    )
    trained = method.train(Task(system, budget, tmp_path / "train"), method.configurations(system)[-1])
    assert 1 <= len(method.configurations(system)) <= 3
    path = tmp_path / "trained.safetensors"
    method.save(trained, path)
    y = system.output(oscillations(0.02, 1.0, n=3))
    before, after = (run(method.observer(one, system, 0.02, 0.1), y) for one in (trained, method.load(path)))
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9)
    assert before.shape == (51, 3, 2)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"damaged|incomplete"):
        method.load(path)


def test_a_file_of_another_method_is_refused(tmp_path):
    get_method("ekf").save({"diffusion": np.ones(1)}, tmp_path / "one.safetensors")
    with pytest.raises(ValueError, match="'ekf', not 'gru'"):
        get_method("gru").load(tmp_path / "one.safetensors")


def test_damaged_files_and_what_is_no_array_of_floats(tmp_path):
    method, path = get_method("ekf"), tmp_path / "new" / "one.safetensors"
    with pytest.raises(TypeError, match=r"'steps' is of type int64.* float32 and float64: convert it"):
        method.save({"steps": np.arange(3)}, path)
    method.save({"process_noise": np.ones(1)}, path)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"one\.safetensors is damaged .*; remove it to train anew"):
        method.load(path)
    with pytest.raises(ValueError, match="there is no file"):
        method.load(tmp_path / "none")


def test_methods_that_make_artifacts_make_files_for_everyone(tmp_path):
    method, _, trained, _ = trained_on_oscillator("node", tmp_path / "train", steps=2)
    method.save(trained, tmp_path / "node.safetensors")
    assert Artifact.read(tmp_path / "node.safetensors").training["method"] == "node"


def test_unknown_method():
    with pytest.raises(ValueError, match="unknown method 'kalman'"):
        get_method("kalman")
    with pytest.raises(ValueError, match=r"not a subclass of training\.methods\.Method"):
        get_method("examples.research.methods.gru:Recurrent")
