"""Shipped maps on unseen trajectories."""

import json
from dataclasses import asdict

import numpy as np
import pytest

import observers
from kkl_gym import SYSTEMS, get_system
from observers.names import resolve
from training.evaluation.errors import errors, unseen_trajectories
from training.evaluation.metrics import component_smape
from training.presets import SMALL_SETTINGS, preset

# Medians over 100 unseen runs of 50 s, in percent, that the default maps promise. The paper's SMAPE over all steps from
# X: without noise, at sigma_v = 0.5, and (first 5 s left out) driven by random steps and sines; and component-wise,
# after 20 %, from 1.5X \ X without noise.
PROMISED = {
    "reverse_duffing": (0.5, 3.9, 0.6, 0.6),
    "van_der_pol": (0.4, 1.6, 0.3, 0.3),
    "rossler": (0.8, 1.8, 0.6, 1.0),
    "lorenz": (0.5, 0.9, 0.3, 0.6),
}
# The same of SPINN's: all steps from X without noise and at 0.5 (told), and component-wise. The notebooks that were
# released with the paper print 1.96, 0.35, 4.77 and 8.64 for the last.
PROMISED_OF_SPINN = {
    "reverse_duffing": (0.8, 7.0, 0.3),
    "van_der_pol": (0.35, 5.0, 0.2),
    "rossler": (0.7, 4.0, 2.0),
    "lorenz": (0.6, 2.5, 0.5),
}
# The default maps, which track: all steps from X at 0.5, 0.65, 1, 1.05 and 1.3 times the tuned EKF of the benchmark.
PROMISED_OF_TRACKING = {"reverse_duffing": 2.83, "van_der_pol": 1.27, "rossler": 1.29, "lorenz": 0.65}
NAMES = sorted(SYSTEMS)


@pytest.mark.parametrize("name", NAMES)
def test_t_inv_alone_is_as_accurate_as_promised(name):
    system, artifact = get_system(name), observers.Artifact.read(resolve(f"{name}-static"))
    noise_free_share, noisy, driven, beyond = PROMISED[name]
    runs = unseen_trajectories(system, 0.01, n=100, duration=50.0, seed=0)
    assert runs.escaped == 0
    assert np.median(errors(artifact, system, runs, measurement_noise=0.0, seed=0).full) <= noise_free_share
    assert np.median(errors(artifact, system, runs, measurement_noise=0.5, seed=0).full) <= noisy
    runs = unseen_trajectories(system, 0.01, n=100, duration=50.0, seed=0, domain="1.5X")
    x_hat = observers.KKLObserver(artifact, 0.0, process_noise=0.0).estimate(system.output(runs.x), runs.u)
    assert np.median(component_smape(runs.x, x_hat, skip=1000)) <= beyond
    runs = unseen_trajectories(system, 0.01, n=100, duration=50.0, seed=0, driven=True)
    assert runs.escaped <= 5
    assert np.median(errors(artifact, system, runs, measurement_noise=0.0, seed=0, skip=5.0).late) <= driven


@pytest.mark.parametrize("name", NAMES)
def test_spinn_maps_are_as_accurate_as_promised(name):
    system, artifact = get_system(name), observers.Artifact.read(resolve(f"{name}-spinn"))
    noise_free, noisy, beyond = PROMISED_OF_SPINN[name]
    runs = unseen_trajectories(system, 0.01, n=60, duration=50.0, seed=1)
    assert np.median(errors(artifact, system, runs, measurement_noise=0.0, seed=1).full) <= noise_free
    assert np.median(errors(artifact, system, runs, measurement_noise=0.5, seed=1).full) <= noisy
    runs = unseen_trajectories(system, 0.01, n=60, duration=50.0, seed=1, domain="1.5X")
    y, late = system.output(runs.x), np.arange(1000, 5001, 10)
    x_hat = observers.KKLObserver(artifact, 0.0).estimate(y)
    assert np.median(component_smape(runs.x, x_hat, skip=1000)) <= beyond
    z = artifact.filter.run(y, np.zeros((5000, y.shape[1], 0)), late)
    error = artifact.forward(runs.x[late]) - z
    assert np.square(error).sum() <= 1e-4 * np.square(z).sum()


@pytest.mark.parametrize("name", NAMES)
def test_default_maps_are_as_accurate_as_promised(name):
    system, artifact = get_system(name), observers.Artifact.read(resolve(name))
    runs = unseen_trajectories(system, 0.01, n=100, duration=50.0, seed=1)
    assert np.median(errors(artifact, system, runs, measurement_noise=0.5, seed=1).full) <= PROMISED_OF_TRACKING[name]
    plain = observers.Artifact.read(resolve(f"{name}-static"))
    for mine, other in zip(artifact.inverse.mlp.weights, plain.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(mine, other)  # the same T_inv


@pytest.mark.parametrize("name", observers.shipped())
def test_shipped_maps_are_what_the_preset_makes(name):
    artifact = observers.load(name).artifact
    kind = name.removeprefix(artifact.system)
    pipeline = "spinn" if kind == "-spinn" else "input-aware"
    changes = {"-small": SMALL_SETTINGS}
    settings = preset(get_system(artifact.system), pipeline, "fast", changes=changes.get(kind))
    made, config = artifact.training, json.loads(json.dumps(asdict(settings)))
    assert {key: made[key] for key in config} == config
    assert made["optimiser"] == "soap"


@pytest.mark.parametrize(("name", "seconds", "error"), [("van_der_pol", 1.0, 0.02), ("lorenz", 0.3, 0.02)])
def test_coasting_runs_as_a_model_of_the_system(name, seconds, error):
    system, observer = get_system(name), observers.load(name, 0.0, process_noise=0.0)
    runs = unseen_trajectories(system, 0.01, n=20, duration=15.0, seed=0)
    y = system.output(runs.x)
    lost = round(seconds / 0.01)
    x_hat = observer.reset(y[0])
    for k in range(1, 1501 - lost):
        x_hat = observer.step(y[k])
    for _ in range(lost):
        x_hat = observer.step(None)
    relative = np.linalg.norm(x_hat - runs.x[-1], axis=-1) / np.linalg.norm(runs.x[-1], axis=-1)
    assert np.median(relative) < error
