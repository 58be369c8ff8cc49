"""The covariance of the estimate's error: closed form, batches, files, and no cost unless it is asked for."""

import dataclasses
import pickle

import numpy as np
import pytest
from error_bars import AGES, LEVELS, with_error_bars

from observers import MLP, Artifact, ArtifactError, KKLObserver, Spread
from observers.spread import LARGEST, Covariance

CLOSE = {"rtol": 1e-4, "atol": 1e-6}  # the networks work in float32
OPTIONS = {"process": True, "free_inverse": True}


def by_hand(inverse, z, age, level, process_noise):
    """factor * D L L^T D, term by term."""
    told = [*inverse.noise_features(level, process_noise), *([inverse.age_feature(age)] * ("age" in inverse.features))]
    inputs = np.concatenate([inverse.gain(level) * (inverse.whiten @ (z - inverse.z_offset)), told])
    spread, nx = inverse.spread, len(inverse.x_scale)
    out = spread.mlp(inputs.astype(np.float32)).astype(float)
    L = np.eye(nx)
    L[np.tril_indices(nx, -1)] = out[nx:]
    D = np.diag(np.exp(out[:nx]) * inverse.x_scale)
    tables, share = np.log(spread.factors), process_noise / inverse.process_noise_max
    if tables.ndim == 3:
        tables = (1 - share) * tables[0] + share * tables[1]
    by_age = [np.interp(level / inverse.measurement_noise_max, LEVELS, column) for column in tables.T]
    P = np.exp(np.interp(age, AGES, by_age)) * D @ L @ L.T @ D
    cut = np.diag(np.minimum(1.0, LARGEST * inverse.x_scale / np.sqrt(np.diag(P))))
    return cut @ P @ cut


def one_layer(artifact):
    spread, rng = artifact.inverse.spread, np.random.default_rng(0)
    mlp = MLP([rng.normal(size=(6, spread.mlp.inputs))], [rng.normal(size=6)], "silu")
    inverse = dataclasses.replace(artifact.inverse, spread=dataclasses.replace(spread, mlp=mlp))
    return dataclasses.replace(artifact, inverse=inverse)


@pytest.mark.parametrize(
    ("options", "activation"),
    [(OPTIONS, "tanh"), ({"inputs": False, "system": "lorenz"}, "silu"), ({"system": "lorenz"}, "one layer")],
)
def test_single_and_batch_are_the_closed_form(make_artifact, options, activation):
    """Of networks that share the first layer's product with T_inv, where a sample is single, and of others."""
    deep, rng = activation != "one layer", np.random.default_rng(1)
    artifact = with_error_bars(make_artifact(**options), activation=activation if deep else "silu")
    artifact = artifact if deep else one_layer(artifact)
    level, process_noise = 0.2, 0.05 if "process" in options else 0.0
    y, u = rng.normal(size=(9, 6, 1)), rng.normal(size=(8, 6, artifact.nu))
    u[:, :3] = 0.0  # three rows of free motion beside three of driven motion
    batch = KKLObserver(artifact, level, process_noise=process_noise)
    singles = [KKLObserver(artifact, level, process_noise=process_noise) for _ in range(6)]
    for k in range(9):
        x_hat = batch.step(y[k], u[k - 1]) if k else batch.reset(y[k])
        for i, single in enumerate(singles):
            x_one = single.step(y[k, i], u[k - 1, i]) if k else single.reset(y[k, i])
            np.testing.assert_allclose(x_one, x_hat[i], **CLOSE)
            z, driven = single.z, u[:k, i].any()
            free = artifact.free_inverse is not None and not driven
            inverse = artifact.free_inverse if free else artifact.inverse
            expected = by_hand(inverse, z[: inverse.whiten.shape[1]], k * artifact.filter.dt, level, process_noise)
            np.testing.assert_allclose(single.covariance, expected, **CLOSE)
            np.testing.assert_allclose(batch.covariance[i], expected, **CLOSE)
            np.testing.assert_allclose(single.std, np.sqrt(np.diag(expected)), **CLOSE)
        rows = np.arange(6) % 2 == 0
        np.testing.assert_allclose(batch.decode_covariance(rows), batch.covariance[rows], **CLOSE)
        np.testing.assert_array_equal(batch.decode(), x_hat)
    along = batch.estimate_covariance(y, u if artifact.nu else None)
    assert along.shape == (9, 6, artifact.nx, artifact.nx)
    np.testing.assert_allclose(along[-1], batch.covariance, **CLOSE)


@pytest.mark.parametrize("nx", [1, 2, 6])
def test_any_number_of_states(nx):
    rng, count = np.random.default_rng(nx), nx * (nx + 1) // 2
    mlp = MLP([rng.normal(size=(count, 5))], [rng.normal(size=count)], "tanh")
    spread, scale = Spread(mlp, LEVELS, AGES, np.ones((3, 3))), np.geomspace(1e-3, 1e3, nx)
    covariance, inputs = Covariance(spread, (0.5, 0.0), scale), rng.normal(size=(7, 5)).astype(np.float32)
    found = covariance(inputs, 0.05)
    singles = np.array([covariance(row, 0.05) for row in inputs])
    np.testing.assert_allclose(singles, found, rtol=1e-4)
    np.testing.assert_array_equal(singles, singles.mT)
    assert (np.linalg.eigvalsh(found / np.outer(scale, scale)) > 0).all()
    assert (found.diagonal(0, -2, -1) <= np.square(LARGEST * scale) * (1 + 1e-12)).all()
    far = 1e4 * np.sign(inputs)  # from training
    assert all(np.isfinite(covariance(x, np.inf)).all() for x in (far, far[0]))
    assert all(np.isnan(covariance(np.nan * x, np.inf)).any() for x in (far, far[0]))  # what is lost does not look sure


def test_files_keep_it(make_artifact, tmp_path):
    artifact, path = with_error_bars(make_artifact("van_der_pol", **OPTIONS)), tmp_path / "map.safetensors"
    artifact.save(path)
    y, u = np.random.default_rng(0).normal(size=(2, 5, 1))
    covariances = []
    for observer in (KKLObserver(artifact), KKLObserver(Artifact.read(path))):
        observer.reset(y)
        observer.step(y, u)
        covariances.append(observer.covariance)
    np.testing.assert_array_equal(*covariances)


def test_parts_that_do_not_fit(make_artifact):
    plain = make_artifact("van_der_pol", free_inverse=True)
    artifact = with_error_bars(plain)
    with pytest.raises(ArtifactError, match="one has error bars"):
        dataclasses.replace(artifact, free_inverse=plain.free_inverse)
    with pytest.raises(ArtifactError, match="3 states do not fit 2"):
        with_error_bars(plain, outputs=6)
    with pytest.raises(ValueError, match="4 outputs makes no covariance"):
        with_error_bars(plain, outputs=4)
    spread = artifact.inverse.spread
    for changes in ({"factors": np.ones((2, 3, 3))}, {"mlp": artifact.free_inverse.spread.mlp}):
        with pytest.raises(ArtifactError, match="do not fit"):
            dataclasses.replace(artifact.inverse, spread=dataclasses.replace(spread, **changes))
    with pytest.raises(ValueError, match="do not fit 3 levels and 3 ages"):
        dataclasses.replace(spread, factors=np.ones((3, 2)))
    for name in ("levels", "ages", "factors"):
        for wrong in (np.nan, -1.0):
            values = getattr(spread, name).copy()
            values.flat[-1] = wrong
            with pytest.raises(ValueError, match="must"):
                dataclasses.replace(spread, **{name: values})


def test_without_it_or_before_a_sample(make_artifact):
    plain = KKLObserver(make_artifact("van_der_pol"))
    plain.reset([0.1])
    for ask in (lambda: plain.covariance, lambda: plain.std, lambda: plain.estimate_covariance(np.zeros((3, 1)))):
        with pytest.raises(ArtifactError, match="no error bars; kkl-gym errorbars"):
            ask()
    with pytest.raises(RuntimeError, match="reset"):
        _ = KKLObserver(with_error_bars(make_artifact("van_der_pol"))).covariance


def test_it_is_not_evaluated_unless_it_is_asked_for(make_artifact, monkeypatch):
    asked, call = [], Covariance.__call__
    monkeypatch.setattr(Covariance, "__call__", lambda self, *a: asked.append(1) or call(self, *a))
    observer = KKLObserver(with_error_bars(make_artifact("van_der_pol", forward=True)), 0.1)
    observer.reset([0.3])
    observer.step([0.2], [0.1])
    observer.estimate(np.zeros((4, 1)))
    _ = observer.mismatch
    assert not asked
    _ = observer.covariance
    assert len(asked) == 1


@pytest.mark.parametrize("batch", [(), (4,)])
def test_it_is_of_the_estimate_as_things_stand(make_artifact, batch):
    """Whatever has happened, also where it is made in one go with the estimate, since the last was asked for."""
    plain, rng = make_artifact("van_der_pol", forward=True, **OPTIONS), np.random.default_rng(3)
    artifact = with_error_bars(plain, activation="silu")  # as its maps have it
    observer, before = KKLObserver(artifact, 0.1, compiled=False), 0.0
    rows = np.arange(4) < 2 if batch else np.array(True)
    for change in (
        lambda y: observer.reset(y),
        lambda y: observer.step(y),  # free motion
        lambda y: observer.step(y, y),
        lambda y: observer.step(None, y),
        lambda y: observer.advance(y, y, rows),
        lambda y: observer.restart(np.atleast_2d(y)[: rows.sum()], rows),
        lambda y: observer.step(y, y),
        lambda y: setattr(observer, "measurement_noise", 0.7),
        lambda y: setattr(observer, "process_noise", 0.01),
        lambda y: observer.replace(with_error_bars(plain, seed=5, activation="silu")),
        lambda y: observer.reset(y, np.full((*batch, 2), 0.3)),
        lambda y: observer.step(y, y),
    ):
        change(rng.normal(size=(*batch, 1)))
        fresh = observer.decode_covariance(np.ones(batch, dtype=bool)).reshape(*batch, 2, 2)
        given = observer.covariance
        np.testing.assert_allclose(given, fresh, rtol=1e-5)
        assert not np.allclose(before, fresh, rtol=1e-3)
        given[:] = np.nan  # the caller's own
        np.testing.assert_allclose(observer.covariance, fresh, rtol=1e-5)
        before = fresh
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(observer)).covariance, observer.covariance)
