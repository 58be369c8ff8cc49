"""Known starts z_0 = T(x_0), and the mismatch between z and T(x_hat)."""

import math

import numpy as np
import pytest
from linear_system import C, F, exact_observer, sylvester
from scipy.linalg import expm

from observers import KKLObserver

KINDS = [{"inputs": 0, "age": 0}, {"pair": True}]
CLOSE = {"rtol": 1e-5, "atol": 1e-5}  # rounding of the float32 networks


def oscillations(steps, dt, n=6, seed=0):
    """States (steps, n, 2) of the oscillator, in closed form, and its outputs."""
    flow, x = expm(F * dt), [np.random.default_rng(seed).uniform(-1, 1, (n, 2))]
    for _ in range(steps - 1):
        x.append(x[-1] @ flow.T)
    return np.array(x), np.array(x) @ C.T


def observer_with_T(make_artifact, system="van_der_pol", **options):
    return KKLObserver(make_artifact(system, forward=True, **options), 0.3)


def test_a_known_start_has_no_transient_on_a_linear_system():
    observer = KKLObserver(exact_observer(dt=0.01))
    x, y = oscillations(300, 0.01)
    known = [observer.reset(y[0], x[0])] + [observer.step(yk) for yk in y[1:]]
    assert np.abs(known - x).max() < 5e-4  # error of the first-order hold and of float32
    assert np.array_equal(observer.estimate(y, x0=x[0]), known)
    unknown = np.abs(observer.estimate(y) - x).max((1, 2))
    assert unknown[0] > 0.3
    assert unknown[100] > 0.05


def test_the_transient_of_a_known_start_is_of_second_order_in_dt():
    def error(dt):
        artifact = exact_observer(dt)
        M, observer = sylvester(artifact.filter.A, artifact.filter.B), KKLObserver(artifact)
        x, y = oscillations(round(4.0 / dt) + 1, dt)
        observer.reset(y[0], x[0])
        worst = 0.0
        for xk, yk in zip(x[1:], y[1:], strict=True):
            observer.advance(yk)
            worst = max(worst, np.abs(observer.z - xk @ M.T).max())
        return worst

    assert math.log2(error(0.2) / error(0.1)) == pytest.approx(2.0, abs=0.1)


def test_mismatch_is_the_part_of_the_transient_outside_the_image_of_T():
    dt, steps = 0.01, 150
    artifact = exact_observer(dt)
    A, M, observer = artifact.filter.A, sylvester(artifact.filter.A, artifact.filter.B), KKLObserver(artifact)
    x, y = oscillations(steps, dt)
    away = artifact.filter.start(y[0]) - x[0] @ M.T
    beside = M @ np.linalg.pinv(M) - np.eye(3)
    observer.reset(y[0])
    for k in range(steps):
        if k > 0:
            observer.advance(y[k])
        expected = np.linalg.norm(away @ expm(A * k * dt).T @ beside.T / artifact.forward.z_scale, axis=-1) / 3**0.5
        assert observer.mismatch == pytest.approx(expected, abs=1e-5)
        if k == 0:
            assert (expected > 5e-3).all()
    observer.reset(y[0], x[0])
    assert (observer.mismatch < 1e-6).all()
    observer.advance(y[0] + 5.0)  # a jump of the sensor
    assert (observer.mismatch > 1e-3).all()


@pytest.mark.parametrize("options", KINDS, ids=str)
def test_z_is_T_of_the_start_and_the_map_gets_the_largest_age(options, make_artifact):
    observer = observer_with_T(make_artifact, **options)
    artifact = observer.artifact
    inverse, T = artifact.inverse, artifact.forward
    x0 = np.array([0.7, -1.1])
    x_hat = observer.reset([0.4], x0)
    z0 = np.concatenate([T(x0), np.zeros(artifact.filter.size - T.mlp.outputs)])
    assert np.array_equal(observer.z, z0)
    modes = inverse.gain(0.3) * (inverse.whiten @ (z0 - inverse.z_offset))
    features = [*inverse.noise_features(0.3, 0.0), *([inverse.age_feature(2.0)] if options.get("age", True) else [])]
    expected = inverse.x_offset + inverse.x_scale * inverse.mlp(np.array([*modes, *features]))
    assert np.allclose(x_hat, expected, **CLOSE)
    observer.step([0.5])
    z1 = artifact.filter.advance(z0, np.array([0.4]), np.zeros(artifact.nu), np.array([0.5]))
    assert np.array_equal(observer.z, z1)


def test_rows_restart_with_known_and_unknown_starts(make_artifact):
    """Each row equals a single observer, independently of the ages of other rows."""
    rng = np.random.default_rng(0)
    y, x0 = rng.normal(size=(6, 4, 1)), rng.normal(size=(4, 2))
    together = observer_with_T(make_artifact)
    assert together.estimate(np.zeros((3, 0, 1)), x0=np.zeros((0, 2))).shape == (3, 0, 2)
    alone = [observer_with_T(make_artifact) for _ in range(4)]
    together.reset(y[0], x0)
    for row in range(4):
        alone[row].reset(y[0, row], x0[row])
    for k in range(1, 6):
        together.advance(y[k])
        for row in range(4):
            alone[row].advance(y[k, row])
        if k == 2:
            together.restart(y[k, 1:3], np.array([False, True, True, False]))
            for row in (1, 2):
                alone[row].reset(y[k, row])
        if k == 4:
            together.restart(y[k, 2:], np.array([False, False, True, True]), x0[:2])
            for row in (2, 3):
                alone[row].reset(y[k, row], x0[row - 2])
        assert np.allclose(together.z, [one.z for one in alone], rtol=1e-6)
        assert np.allclose(together.decode(), [one.decode() for one in alone], **CLOSE)
        assert np.allclose(together.mismatch, [one.mismatch for one in alone], **CLOSE)
