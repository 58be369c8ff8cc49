import numpy as np
import pytest

import observers
from kkl_gym import SYSTEMS, get_system
from kkl_gym.simulate import simulate
from observers.names import resolve

NAMES = sorted(SYSTEMS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("suffix", ["", "-spinn"])
def test_metadata_of_shipped_maps(name, suffix):
    artifact = observers.load(name + suffix).artifact
    system = get_system(name)
    artifact.check(name, system.parameters, dt=0.01, ny=system.ny, nu=system.nu)
    assert artifact.nx == system.nx
    assert artifact.nu == (0 if suffix else system.nu)
    assert (artifact.forward is not None) == bool(suffix)
    assert (artifact.free_inverse is not None) == (not suffix)
    assert resolve(name + suffix).stat().st_size < 1_000_000


@pytest.mark.parametrize("name", ["lorenz", "reverse_duffing"])
def test_spinn_maps_recover_settled_states_from_their_own_forward_map(name):
    artifact, system = observers.Artifact.read(resolve(f"{name}-spinn")), get_system(name)
    x0 = np.random.default_rng(0).uniform(*system.box(), (300, artifact.nx))
    x = simulate(system, x0, 1500, 0.01)[-1]
    x_hat = observers.KKLObserver(artifact, 0.0).reset(system.output(x), x0=x)
    assert np.median(np.linalg.norm(x_hat - x, axis=1) / np.linalg.norm(x, axis=1)) < 0.002


@pytest.mark.parametrize("name", [name for name in observers.shipped() if name.startswith("rossler")])
def test_every_map_can_be_monitored(name):
    observer = observers.load(name, measurement_noise=0.5, monitor=True)
    assert observer.artifact.limits.false_alarms == 0.01
    y = 0.5 * np.random.default_rng(0).standard_normal((600, 1, 1)) + 300.0  # far outside the range
    observer.reset(y[0])
    for k in range(1, 600):
        observer.step(y[k])
    assert (observer.score > 1).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_worst_start_of_many_beyond_x_is_found_and_kept(name):
    system = get_system(name)
    rng = np.random.default_rng(2024)
    x = simulate(system, rng.uniform(*system.box(2.0), (64, system.nx)), 2000, 0.01)
    x = x[:, np.isfinite(x[-1]).all(-1)]
    y = system.output(x) + 0.1 * rng.standard_normal((*x.shape[:2], system.ny))
    x_hat = observers.load(name, 0.1, process_noise=0.0).estimate(y)
    late = slice(1000, None)
    smape = np.abs(x_hat - x)[late].sum(-1) / (np.abs(x_hat) + np.abs(x))[late].sum(-1)
    assert smape.mean(0).max() < 0.03


@pytest.mark.parametrize("name", ["van_der_pol", "lorenz"])
def test_estimates_recover_from_a_few_outliers(name):
    """Outliers inflate the covariance far beyond the motions to which the flow was fitted."""
    observer = observers.load(name)
    system = get_system(observer.artifact.system)
    x = simulate(system, system.draw_starts(np.random.default_rng(3), 40), 2000, 0.01)
    outputs = system.output(x)
    for false in (5, 20, -200):
        y = outputs.copy()
        y[500:505] = false * outputs.std() / 2
        apart = (observer.estimate(y) - x)[-200:] / system.scale
        assert np.sum(np.sqrt((apart**2).mean((0, 2))) > 0.5) <= 1, "13 s later"  # one run may be in a fast turn


def test_error_bars_hold_if_samples_are_missing_from_the_start():
    """Also for one sample in ten, after which the error at 3 s is small relative to the states' scale."""
    n, level, system, rng = 100, 0.5, get_system("van_der_pol"), np.random.default_rng(3)
    x = simulate(system, rng.uniform(*system.box(), (n, system.nx)), 300, 0.01)
    y = system.output(x) + level * rng.standard_normal((301, n, 1))
    for first, every in ((30, 1), (10, 10)):
        observer = observers.load("van_der_pol", measurement_noise=level, process_noise=0.0)
        observer.reset(y[0])
        for k in range(1, 301):
            seen = k >= first and k % every == 0
            x_hat = observer.step(y[k] if seen else None)
            if k in (29, 80, 100, 300):
                error = x[k] - x_hat
                squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(observer.covariance), error)
                assert np.mean(squared < 4.605) > 0.6  # not 0.9: factors were fitted to runs without gaps
    assert np.sqrt(np.mean((error / system.scale) ** 2)) < 0.1
