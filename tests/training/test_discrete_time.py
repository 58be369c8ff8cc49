"""Systems in discrete time, from their environment to a trained observer."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from discrete_systems import DT, Henon, Sampled
from linear_system import Oscillator
from small_runs import toy

import kkl_gym
from kkl_gym.simulate import simulate
from observers.estimator import Running
from training import errors, preset, train, unseen_trajectories
from training.kalman import ExtendedKalmanFilter
from training.presets import controller
from training.spectrum import smooth_spectrum


def test_a_step_in_closed_form_is_the_integration():
    rng = np.random.default_rng(0)
    x0, u, w = rng.uniform(-1, 1, (5, 2)), rng.uniform(-0.5, 0.5, (100, 5, 1)), np.zeros((100, 5, 2))
    np.testing.assert_allclose(simulate(Sampled(), x0, 100, DT, u, w), simulate(Oscillator(), x0, 100, DT, u, w))
    single = kkl_gym.KKLEnv(Sampled(), process_noise=0.0, measurement_noise=0.0)
    integrated = kkl_gym.KKLEnv(Oscillator(), dt=DT, process_noise=0.0, measurement_noise=0.0)
    for env in (single, integrated):
        env.reset(options={"x0": [0.3, -0.2]})
    for action in rng.uniform(-1, 1, (20, 1)).astype(np.float32):
        found, expected = (env.step(action)[0] for env in (single, integrated))
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_the_kalman_filter_follows_a_map_as_it_follows_its_integration():
    y, u = np.random.default_rng(0).normal(size=(60, 2, 1)), np.random.default_rng(1).uniform(-0.5, 0.5, (60, 2, 1))
    found = []
    for system in (Sampled(), Oscillator()):
        one = ExtendedKalmanFilter(system, DT, Q=np.diag([0.01, 0.02]), R=np.array([[0.3]]))
        found.append(Running(one).along(y, u[1:]))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-7, atol=1e-9)


def test_the_regulator_of_a_map_holds_it():
    @dataclass(frozen=True)
    class Growing(Sampled):
        name: ClassVar[str] = "growing"

        def step(self, x, u):
            return [1.004 * xi for xi in super().step(x, u)]

    system = Growing()
    act = controller(system, DT)
    x = simulate(system, np.full((1, 2), 0.1), 1000, DT, lambda _, x: act(x) * system.u_max)
    assert np.abs(x[-1]).max() < 1e-3
    assert np.abs(simulate(system, x[0], 1000, DT)[-1]).max() > 1.0


def test_an_observer_of_a_map_is_trained_and_follows_it(tmp_path):
    system = Henon()
    duration = {"duration": 100.0, "samples": 60}
    config = toy(system, trajectories=200, inverse_steps=600, width=32, process_noise_share=0.0, **duration)
    runs = unseen_trajectories(system, 1.0, n=20, duration=100.0, seed=0, driven=True)
    artifact = train(system, config, tmp_path).artifact
    alone = replace(artifact, motion=None)
    assert np.median(errors(alone, system, runs, measurement_noise=0.0, seed=0).late) < 3.0
    assert np.median(errors(artifact, system, runs, measurement_noise=0.01, seed=0).late) < 1.0
    assert artifact.motion.equations.substeps == 0
    x, u = runs.x[:-1], runs.u
    np.testing.assert_allclose(artifact.motion.step(x, u, 1.0), runs.x[1:], atol=1e-12)
    artifact.save(tmp_path / "henon.safetensors")
    still = kkl_gym.KKLEnv(system, process_noise=0.0, measurement_noise=0.0)
    env = kkl_gym.KKLObservation(still, str(tmp_path / "henon.safetensors"))
    env.reset(seed=0)
    steps = [env.step(np.zeros(1, np.float32)) for _ in range(50)]
    assert np.median([np.abs(x_hat - info["x"]).max() for x_hat, *_, info in steps]) < 0.1


def test_the_equation_of_continuous_time_is_refused(tmp_path):
    with pytest.raises(ValueError, match="henon is in discrete time"):
        preset(Henon(), "spinn", "fast")
    with pytest.raises(ValueError, match="henon is in discrete time"):
        train(Henon(), toy(Henon(), "spinn"), tmp_path)
    with pytest.raises(ValueError, match="input-aware"):
        smooth_spectrum(Henon(), 1.0)
