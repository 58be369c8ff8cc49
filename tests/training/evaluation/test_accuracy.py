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

# Medians over 100 unseen runs of 50 s, in percent, that the maps promise. T_inv alone: the paper's SMAPE over all steps
# from X, without noise and at 0.5; component-wise after 20 %, from 1.5X \ X without noise; driven by random steps and
# sines, after 5 s.
PROMISED = {
    "reverse_duffing": (0.5, 3.9, 0.6, 0.6),
    "van_der_pol": (0.4, 1.6, 0.3, 0.3),
    "rossler": (0.8, 1.8, 1.0, 0.6),
    "lorenz": (0.5, 0.9, 0.6, 0.3),
}
# The first three of SPINN. The notebooks released with the paper print 1.96, 0.35, 4.77 and 8.64 for the last.
PROMISED_OF_SPINN = {
    "reverse_duffing": (0.8, 7.0, 0.3),
    "van_der_pol": (0.35, 5.0, 0.2),
    "rossler": (0.7, 4.0, 2.0),
    "lorenz": (0.6, 2.5, 0.5),
}
# The default maps, which track, at 0.5: 0.65, 1, 1.05 and 1.3 times the tuned EKF of the benchmark.
PROMISED_OF_TRACKING = {"reverse_duffing": 2.83, "van_der_pol": 1.27, "rossler": 1.29, "lorenz": 0.65}


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_maps_are_as_accurate_as_promised(name):
    system, options = get_system(name), {"n": 100, "duration": 50.0, "seed": 0}
    free = unseen_trajectories(system, 0.01, **options)
    beyond = unseen_trajectories(system, 0.01, **options, domain="1.5X")
    driven = unseen_trajectories(system, 0.01, **options, driven=True)
    assert free.escaped == 0
    assert driven.escaped <= 5

    def median(kind, runs, level, **how):
        artifact = observers.load(name + kind).artifact
        found = errors(artifact, system, runs, measurement_noise=level, seed=0, **how)
        return np.median(found.late if how else found.full)

    for kind, (exact, noisy, outside, *_) in (("-static", PROMISED[name]), ("-spinn", PROMISED_OF_SPINN[name])):
        assert median(kind, free, 0.0) <= exact
        assert median(kind, free, 0.5) <= noisy
        observer, y = observers.load(name + kind, 0.0, process_noise=0.0), system.output(beyond.x)
        x_hat = observer.estimate(y, beyond.u if observer.artifact.nu else None)
        assert np.median(component_smape(beyond.x, x_hat, skip=1000)) <= outside
    assert median("-static", driven, 0.0, skip=5.0) <= PROMISED[name][-1]
    assert median("", free, 0.5) <= PROMISED_OF_TRACKING[name]
    artifact, late = observers.load(f"{name}-spinn").artifact, np.arange(1000, 5001, 10)
    z = artifact.filter.run(y, np.zeros((5000, y.shape[1], 0)), late)
    assert np.square(artifact.forward(beyond.x[late]) - z).sum() <= 1e-4 * np.square(z).sum()


def test_a_map_that_tracks_has_the_t_inv_of_the_one_that_does_not():
    tracking, plain = (observers.Artifact.read(resolve(name)).inverse.mlp for name in ("lorenz", "lorenz-static"))
    for mine, other in zip(tracking.weights, plain.weights, strict=True):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize("name", observers.shipped())
def test_shipped_maps_are_what_the_preset_makes(name):
    artifact = observers.load(name).artifact
    kind = name.removeprefix(artifact.system)
    pipeline, changes = "spinn" if kind == "-spinn" else "input-aware", {"-small": SMALL_SETTINGS}
    settings = preset(get_system(artifact.system), pipeline, "fast", changes=changes.get(kind))
    made, config = artifact.training, json.loads(json.dumps(asdict(settings)))
    assert {key: made[key] for key in config} == config
    assert made["optimiser"] == "soap"


def test_coasting_runs_as_a_model_of_the_system():
    system, observer = get_system("van_der_pol"), observers.load("van_der_pol", 0.0, process_noise=0.0)
    runs = unseen_trajectories(system, 0.01, n=20, duration=15.0, seed=0)
    y = system.output(runs.x)
    x_hat = observer.reset(y[0])
    for k in range(1, 1501):
        x_hat = observer.step(y[k] if k <= 1400 else None)
    relative = np.linalg.norm(x_hat - runs.x[-1], axis=-1) / np.linalg.norm(runs.x[-1], axis=-1)
    assert np.median(relative) < 0.02
