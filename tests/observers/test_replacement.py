"""Replacement of maps while the filter runs."""

import dataclasses

import numpy as np
import pytest
from monitor_limits import limits

from observers import ArtifactError, KKLObserver, LinearFilter


@pytest.fixture
def artifact(make_artifact):
    return make_artifact()


def other_maps(artifact):
    return dataclasses.replace(
        artifact, inverse=dataclasses.replace(artifact.inverse, x_offset=artifact.inverse.x_offset + 1.0)
    )


def test_the_filter_goes_on(artifact):
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(9, 3, 1)), rng.normal(size=(8, 3, 1))
    observer, expected = KKLObserver(artifact, 0.3), KKLObserver(other_maps(artifact), 0.3)
    observer.reset(y[0])
    expected.reset(y[0])
    for k in range(8):
        if k == 4:
            before = observer.decode()
            observer.replace(other_maps(artifact))
            np.testing.assert_allclose(observer.decode(), before + 1.0, rtol=1e-5)
        later = 0.0 if k < 4 else 1.0
        shown, with_other_maps = observer.step(y[k + 1], u[k]), expected.step(y[k + 1], u[k])
        np.testing.assert_allclose(with_other_maps, shown + 1.0 - later, rtol=1e-5)
    assert observer.measurement_noise == 0.3


def changed_filter(artifact, **changes):
    linear = artifact.filter
    return dataclasses.replace(
        artifact, filter=LinearFilter(**{"A": linear.A, "B": linear.B, "dt": linear.dt, "nu": linear.nu, **changes})
    )


def test_a_refused_replacement_leaves_the_observer_unchanged(artifact):
    observer, linear = KKLObserver(artifact, 0.9), artifact.filter
    quiet = dataclasses.replace(artifact.inverse, measurement_noise_max=0.5)
    for other, message in (
        (changed_filter(artifact, dt=0.02), "the filters differ in dt"),
        (changed_filter(artifact, A=2 * linear.A), "the filters differ in A"),
        (changed_filter(artifact, B=2 * linear.B), "the filters differ in B"),
        (dataclasses.replace(artifact, system="lorenz"), "has system 'van_der_pol', the replacement 'lorenz'"),
        (dataclasses.replace(artifact, parameters={"mu": 7.0}), "has parameters"),
        ("van_der_pol", r"must be an observers\.Artifact, got 'van_der_pol'"),
    ):
        with pytest.raises(ArtifactError, match=message):
            observer.replace(other)
    with pytest.raises(ValueError, match="beyond the map's range"):
        observer.replace(dataclasses.replace(artifact, inverse=quiet))
    assert observer.artifact is artifact
    assert observer.measurement_noise == 0.9


def test_monitors_restart(artifact):
    watched = dataclasses.replace(artifact, C=np.array([[1.0, 0.0]]), limits=limits())
    observer = KKLObserver(watched, monitor=True)
    observer.reset(np.full((2, 1), 3.0))
    for _ in range(20):
        observer.step(np.full((2, 1), 3.0))
    assert (observer.score > 0).all()
    observer.replace(dataclasses.replace(watched, training={}))
    assert not observer.score.any()
    with pytest.raises(ValueError, match="holds no limits"):
        observer.replace(dataclasses.replace(watched, limits=None))
