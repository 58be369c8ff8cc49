"""Shipped maps on unseen trajectories."""

import json
from dataclasses import asdict

import numpy as np
import pytest

import observers
from kkl_gym import SYSTEMS, get_system
from observers.artifact import resolve
from training.config import current_names
from training.evaluation.errors import errors, unseen_trajectories
from training.evaluation.metrics import component_smape
from training.presets import preset

# Medians over 100 unseen runs of 50 s, in percent, that the default maps promise. The paper's SMAPE over all steps from
# X: without noise, at sigma_v = 0.5, and (first 5 s left out) driven by random steps and sines; and component-wise,
# after 20 %, from 1.5X \ X without noise.
PROMISED = {
    "reverse_duffing": (0.5, 3.9, 0.6, 0.6),
    "van_der_pol": (0.4, 1.6, 0.3, 0.3),
    "rossler": (0.8, 1.8, 0.6, 1.0),
    "lorenz": (0.5, 0.9, 0.3, 0.6),
}
NAMES = sorted(SYSTEMS)


@pytest.mark.parametrize("name", NAMES)
def test_default_maps_are_as_accurate_as_promised(name):
    system, artifact = get_system(name), observers.Artifact.read(resolve(name))
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
def test_default_maps_are_what_the_preset_makes(name):
    made = current_names(observers.load(name).artifact.training)
    config = json.loads(json.dumps(asdict(preset(get_system(name), "input-aware", "fast"))))
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


@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol"])
def test_maps_fitted_in_closed_loop(name):
    system, runs = get_system(name), unseen_trajectories(get_system(name), 0.01, n=100, duration=50.0, seed=0)
    fitted = observers.Artifact.read(resolve(f"{name}-closed-loop"))
    assert fitted.training["closed_loop"] == 2000
    assert np.median(errors(fitted, system, runs, measurement_noise=0.0, seed=0).full) <= 1.5
    assert np.median(errors(fitted, system, runs, measurement_noise=0.5, seed=0).full) <= 5.0
