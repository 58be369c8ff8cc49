"""The covariance of the estimate's error: closed form, batches, files, and no cost unless it is asked for."""

import dataclasses
import pickle

import numpy as np
import pytest
from error_bars import AGES, LEVELS, with_error_bars

from observers import MLP, Artifact, ArtifactError, KKLObserver, Spread
from observers.decoder import Both
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


@pytest.mark.parametrize("system", ["van_der_pol", "lorenz"])
@pytest.mark.parametrize("options", [OPTIONS, {"inputs": False, "age": True}])
def test_single_and_batch_are_the_closed_form(make_artifact, system, options):
    artifact, rng = with_error_bars(make_artifact(system, **options)), np.random.default_rng(1)
    level, process_noise = 0.2, 0.05 if "process" in options else 0.0
    y, u = rng.normal(size=(9, 6, 1)), rng.normal(size=(8, 6, artifact.nu))
    u[:, :3] = 0.0  # three rows of free motion beside three of driven motion
    batch = KKLObserver(artifact, level, process_noise=process_noise)
    singles = [KKLObserver(artifact, level, process_noise=process_noise) for _ in range(6)]
    for k in range(9):
        x_hat = batch.step(y[k], u[k - 1]) if k else batch.reset(y[k])
        for i, single in enumerate(singles):
            if k:
                single.step(y[k, i], u[k - 1, i])
            else:
                single.reset(y[k, i])
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


@pytest.mark.parametrize("nx", [1, 2, 3, 4, 6])
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


@pytest.mark.parametrize("nx", [1, 2, 3, 4])
def test_far_from_training_it_stays_finite(nx):
    count = nx * (nx + 1) // 2
    mlp = MLP([np.full((count, 1), 1e4)], [np.zeros(count)], "tanh")
    covariance = Covariance(Spread(mlp, LEVELS, AGES, np.ones((3, 3))), (9.0, 9.0), np.ones(nx))
    for inputs in (np.ones(1, np.float32), np.ones((2, 1), np.float32)):
        assert np.isfinite(covariance(inputs, np.inf)).all()
        assert np.isnan(covariance(np.nan * inputs, np.inf)).all()  # what is lost does not look sure


def test_files_keep_it(make_artifact, tmp_path):
    artifact, path = with_error_bars(make_artifact("van_der_pol", **OPTIONS)), tmp_path / "map.safetensors"
    artifact.save(path)
    before, after = KKLObserver(artifact), KKLObserver(Artifact.read(path))
    y, u = np.random.default_rng(0).normal(size=(2, 5, 1))
    for observer in (before, after):
        observer.reset(y)
        observer.step(y, u)
    np.testing.assert_array_equal(before.covariance, after.covariance)
    np.testing.assert_array_equal(before.decode(), after.decode())


@pytest.mark.parametrize("name", ["levels", "ages", "factors"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0])
def test_tables_that_make_no_sense(make_artifact, name, wrong):
    spread = with_error_bars(make_artifact("van_der_pol")).inverse.spread
    values = getattr(spread, name).copy()
    values.flat[-1] = wrong
    with pytest.raises(ValueError, match="must"):
        dataclasses.replace(spread, **{name: values})


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


def test_it_is_of_the_estimate_as_things_stand(make_artifact):
    artifact, rng = with_error_bars(make_artifact("van_der_pol", **OPTIONS)), np.random.default_rng(3)
    observer = KKLObserver(artifact, 0.1)
    observer.reset(rng.normal(size=(4, 1)))

    def fresh():
        return observer.decode_covariance(np.ones(4, dtype=bool))

    for change in (
        lambda: observer.step(rng.normal(size=(4, 1)), rng.normal(size=(4, 1))),
        lambda: observer.step(None),
        lambda: observer.advance(rng.normal(size=(4, 1)), rows=np.arange(4) < 2),
        lambda: observer.restart(rng.normal(size=(2, 1)), np.arange(4) < 2),
        lambda: setattr(observer, "measurement_noise", 0.7),
        lambda: setattr(observer, "process_noise", 0.01),
        lambda: observer.replace(with_error_bars(artifact, seed=5)),
        lambda: observer.reset(rng.normal(size=(4, 1))),
    ):
        observer.decode()
        before = observer.covariance
        change()
        assert not np.allclose(before, observer.covariance, rtol=1e-3)
        np.testing.assert_allclose(observer.covariance, fresh(), rtol=1e-6)


def test_beside_estimated_parameters(make_artifact):
    artifact = with_error_bars(make_artifact("van_der_pol", estimated=True))
    observer = KKLObserver(artifact, 0.1)
    observer.reset([0.2])
    assert observer.covariance.shape == (2, 2)
    assert observer.parameters_hat.shape == (1,)


@pytest.fixture
def together(monkeypatch):
    """One entry for each estimate that was made with its covariance."""
    made, call = [], Both.__call__
    monkeypatch.setattr(Both, "__call__", lambda self, *a: made.append(1) or call(self, *a))
    return made


def test_estimate_and_covariance_in_one_go_are_what_they_are_one_after_the_other(make_artifact, together):
    plain, rng = make_artifact("van_der_pol", forward=True, **OPTIONS), np.random.default_rng(3)
    artifact = with_error_bars(plain, activation="silu")  # as its maps have it
    one, other = (KKLObserver(artifact, 0.1, compiled=False) for _ in range(2))
    y, u = rng.normal(size=(2, 11, 1))
    for change in (
        lambda observer: observer.reset(y[:1, 0]),
        lambda observer: observer.step(y[1]),  # free motion
        lambda observer: observer.step(y[2], u[2]),
        lambda observer: observer.step(None, u[3]),
        lambda observer: observer.advance(y[4], u[4], np.array(True)),
        lambda observer: observer.restart(y[5:6], np.array(True)),
        lambda observer: observer.step(y[6], u[6]),
        lambda observer: setattr(observer, "measurement_noise", 0.7),
        lambda observer: setattr(observer, "process_noise", 0.01),
        lambda observer: observer.step(y[7], u[7]),
        lambda observer: observer.replace(with_error_bars(plain, seed=5, activation="silu")),
        lambda observer: observer.step(y[8], u[8]),
        lambda observer: observer.reset(y[9], np.array([0.3, 0.2])),
        lambda observer: vars(observer).update(vars(pickle.loads(pickle.dumps(observer)))),
        lambda observer: observer.step(y[10], u[10]),
    ):
        change(one)
        before = len(together)
        change(other)
        fresh = other._states.covariances(*other._moment(None))
        np.testing.assert_allclose(one.covariance, fresh, rtol=1e-5)
        np.testing.assert_allclose(other.decode(), x_hat := one.decode(), rtol=1e-5)
        np.testing.assert_allclose(one.covariance, fresh, rtol=1e-5)
        assert len(together) == before + 1
        np.testing.assert_allclose(one.step(y[0], u[0]), other.step(y[0], u[0]), rtol=1e-5)
        assert len(together) == before + 2
        assert not np.array_equal(one.decode(), x_hat)


def test_one_covariance_is_made_in_vain_where_nobody_asks_any_more(make_artifact, together):
    observer = KKLObserver(with_error_bars(make_artifact("lorenz"), activation="silu"), compiled=False)
    observer.reset([0.1])
    _ = observer.covariance
    for _ in range(3):
        observer.step([0.2])
    assert len(together) == 1


def test_what_is_handed_out_belongs_to_the_caller(make_artifact, together):
    observer = KKLObserver(with_error_bars(make_artifact("lorenz"), activation="silu"), compiled=False)
    observer.reset([0.1])
    for _ in range(3):
        given = observer.covariance
        expected = given.copy()
        given[:] = np.nan
        np.testing.assert_array_equal(observer.covariance, expected)
        observer.step([0.2])
    assert together


def test_it_is_made_again_where_the_observer_goes(make_artifact, together):
    observer = KKLObserver(with_error_bars(make_artifact("van_der_pol", **OPTIONS), activation="silu"), compiled=False)
    observer.reset([0.1])
    _ = observer.covariance
    observer.step([0.2])
    travelled = pickle.loads(pickle.dumps(observer))
    np.testing.assert_array_equal(travelled.covariance, observer.covariance)
    np.testing.assert_array_equal(travelled.step([0.3]), observer.step([0.3]))
    np.testing.assert_array_equal(travelled.covariance, observer.covariance)
    assert len(together) == 3
    assert b"Both" not in pickle.dumps(observer)


@pytest.mark.parametrize("layers", [1, 2])
def test_networks_that_share_nothing(make_artifact, layers, together):
    """Of one layer, and of another activation."""
    artifact = with_error_bars(make_artifact("lorenz"), activation="tanh" if layers == 2 else "silu")
    spread = artifact.inverse.spread
    if layers == 1:
        rng = np.random.default_rng(0)
        mlp = MLP([rng.normal(size=(6, spread.mlp.inputs))], [rng.normal(size=6)], "silu")
        inverse = dataclasses.replace(artifact.inverse, spread=dataclasses.replace(spread, mlp=mlp))
        artifact = dataclasses.replace(artifact, inverse=inverse)
    observer = KKLObserver(artifact, compiled=False)
    observer.reset([0.1])
    for _ in range(3):
        z, age = observer._moment(None)
        expected = by_hand(artifact.inverse, z, age, observer.measurement_noise, 0.0)
        np.testing.assert_allclose(observer.covariance, expected, **CLOSE)
        observer.step([0.2])
    assert not together
