"""The exported step as a PyTorch module, against KKLObserver."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from exported_steps import (
    MAPS,
    apart,
    doubles,
    exported_of,
    in_doubles,
    mapped,
    motion,
    operated,
    stepped,
    t_inv,
    tracked,
)
from random_tracking import signals, tracking

import kkl_gym
import observers
from observers import KKLObserver
from training import TorchObserver

DTYPES = {"float": torch.float32, "double": torch.float64}


def module_of(exported):
    levels = exported.measurement_noise, exported.process_noise
    dtype = DTYPES[exported.precision]
    return TorchObserver(exported.artifact, levels[0], process_noise=levels[1], dtype=dtype)


def along(module, y, u, **levels):
    """Estimates along a batch of records."""
    levels = {name: torch.tensor(values, dtype=torch.float64) for name, values in levels.items()}
    with torch.no_grad():
        state, x_hat = module.start(y.shape[1]), []
        for k in range(len(y)):
            state, found = module(state, torch.tensor(y[k]), torch.tensor(u[k - 1]), **levels)
            x_hat.append(found.numpy())
    return np.array(x_hat)


def check(exported, *record):
    y, u, expected = (each if each.ndim > 2 else each[:, None] for each in record)
    x_hat = along(module_of(exported), y, u)
    assert apart(exported, x_hat, expected) < {"float": 1e-5, "double": 1e-9}[exported.precision]


@pytest.mark.parametrize(
    ("kind", "index", "precision"),
    [*((mapped, i, "double") for i in range(len(MAPS))), *((tracked, i, "double") for i in (1, 4, 5, 7)),
     (mapped, 1, "float"), (tracked, 5, "float")],
)  # fmt: skip
def test_every_kind_of_map(kind, index, precision):
    exported, *record = kind(index)
    check(replace(exported, precision=precision), *record)


def test_equations_of_all_operations():
    check(*operated(["atan2", ["u", 0], ["x", 1]]))


@pytest.mark.parametrize("name", [*kkl_gym.SYSTEMS, "lorenz-spinn"])
def test_shipped_maps_with_gaps_restarts_and_covariances(name):
    artifact = observers.load(name).artifact
    y, u = (each.reshape(3, 200, -1).swapaxes(0, 1) for each in motion(artifact, 600, runs=3))
    rng, again = np.random.default_rng(0), np.array([False, True, False])
    y = (y + rng.normal(scale=0.2, size=y.shape)).astype(np.float32).astype(float)
    y[1:, 2][rng.uniform(size=199) < 0.3] = np.nan
    y[60:90, 0] = np.nan
    module, observer = TorchObserver(artifact, 0.2), KKLObserver(artifact, 0.2)
    state = module.start(3)
    for k in range(200):
        expected = observer.step(y[k], u[k - 1]) if k else observer.reset(y[0])
        if k == 120:
            state = state * ~torch.tensor(again)[:, None]
            observer.restart(y[k, again], again)
            expected = observer.decode()
        with torch.no_grad():
            state, x_hat = module(state, torch.tensor(y[k]), torch.tensor(u[k - 1]))
        assert np.abs((x_hat.numpy() - expected) / artifact.inverse.x_scale).max() < 1e-5
        unit = np.abs(observer.covariance).max((1, 2), keepdims=True)
        np.testing.assert_allclose(module.covariance(state).numpy() / unit, observer.covariance / unit, atol=1e-4)
    np.testing.assert_array_equal(module.estimate(state), x_hat)


@pytest.mark.parametrize("knows_output", [True, False])
def test_gaps_of_maps_that_do_not_track(knows_output, tmp_path):
    exported, y, u, _ = mapped(1)
    if knows_output:
        C = np.array([[1.0, 0.5], [0.0, 2.0]])
        exported = exported_of(replace(exported.artifact, C=C), tmp_path, precision="double")
    y, u = y[:120].copy(), u[:120]
    y[50:60, 0] = y[70:90, 1, 1] = np.nan
    check(exported, y, u, in_doubles(exported, y, u))


@pytest.mark.parametrize("tracks", [False, True])
def test_rows_have_levels_of_their_own(tracks):
    exported, y, u, _ = tracked(5) if tracks else mapped(1)
    y, u = (np.stack([each[:100]] * 2, 1) for each in ((y, u) if tracks else (y[:, 1], u[:, 1])))
    levels = [((0.2, 0.7), 0.1), ((0.9, 7.0), 0.6)]  # T_inv's largest levels are 2 and 0.2; the Kalman filter has none
    given = {"measurement_noise": [a for a, _ in levels], "process_noise": [[b] for _, b in levels]}
    x_hat = along(module_of(exported), y, u, **given)
    for row, (measurement, process) in enumerate(levels):
        cut = tuple(min(level, 2.0) for level in measurement)
        alone = replace(exported, measurement_noise=cut, process_noise=process)
        np.testing.assert_allclose(x_hat[:, row], in_doubles(alone, y[:, row], u[:, row]), atol=1e-9)


def test_t_inv_re_initialises_a_row_with_an_invalid_covariance():
    exported, y, u, _ = tracked(0)
    y, u, module = y[10:71, None], u[10:71, None], module_of(exported)
    state, x_hat = module.start(1), []
    variance = 1 + exported.artifact.ny + exported.artifact.filter.size + exported.artifact.nx
    with torch.no_grad():
        for k in range(len(y)):
            if k == 50:
                state[0, variance] = -1.0
            state, found = module(state, torch.tensor(y[k]), torch.tensor(u[k - 1]))
            x_hat.append(found[0].numpy())
    with doubles():
        *_, observer = stepped(exported, y[:51, 0], u[:51, 0])
        np.testing.assert_allclose(x_hat[50], t_inv(observer), atol=1e-9)
    assert np.isfinite(x_hat).all()


@pytest.mark.parametrize("kind", [{"by": "flow"}, {"outputs": 2, "nonlinear": True}])
def test_gradients_are_those_of_finite_differences(kind):
    """Gradients through filter, T_inv, tracker, gaps and covariance, also with respect to T_inv's weights."""
    artifact, name = tracking(surer=1.0, **kind), "driven.network.layers.0.weight"
    module = TorchObserver(artifact, dtype=torch.float64)
    y, u = (torch.tensor(each) for each in signals(artifact, 5, (2,)))
    y[3, 0] = torch.nan
    weights = dict(module.named_parameters())[name].data
    given = [each.clone().requires_grad_() for each in (y, u + 0.1, weights)]

    def estimates(y, u, weights):
        state, x_hat = module.start(2), []
        for k in range(5):
            state, found = torch.func.functional_call(module, {name: weights}, (state, y[k], u[k - 1]))
            x_hat.append(found)
        return torch.stack(x_hat), module.covariance(state)

    assert torch.autograd.gradcheck(estimates, given, atol=1e-5, fast_mode=True)
    torch.stack([each.sum() for each in estimates(*given)]).sum().backward()
    assert all(each.grad.isfinite().all() and each.grad.abs().max() > 1e-3 for each in given)


def test_an_observer_in_float32_tracks():
    """In float32, for devices without double precision; T_inv is then inaccurate."""
    artifact = observers.load("van_der_pol").artifact
    y, u = (each[:, None] for each in motion(artifact, 300))
    exact, rough = along(TorchObserver(artifact), y, u), along(TorchObserver(artifact).float(), y, u)
    assert rough.dtype == np.float32
    assert np.abs((rough - exact) / artifact.inverse.x_scale)[100:].max() < 1e-2


def test_bad_arguments():
    artifact = observers.load("lorenz").artifact
    with pytest.raises(ValueError, match=r"dtype must be torch.float32 or torch.float64, got torch.float16"):
        TorchObserver(artifact, dtype=torch.float16)
    with pytest.raises(ValueError, match="beyond the map's range"):
        TorchObserver(artifact, 100.0)
