"""Levels of measurement noise, one for all outputs or one per output."""

import dataclasses
import math

import numpy as np
import pytest
from linear_system import exact_observer
from monitor_limits import limits

from observers import ArtifactError, Expression, KKLObserver, Monitor, load


def test_each_output_has_an_input_of_the_network_and_its_part_in_the_shrinkage(make_artifact):
    artifact = make_artifact(outputs=2, process=True)
    inverse, levels = artifact.inverse, (0.3, 1.2)
    gain = 1 / (1 + sum((sigma * each) ** 2 for sigma, each in zip(levels, inverse.noise_gain, strict=True)))
    np.testing.assert_allclose(inverse.gain(levels), gain)
    features = [*(math.log1p(sigma / 0.1) for sigma in levels), math.log1p(0.1 / 0.01)]
    np.testing.assert_allclose(inverse.noise_features(levels, 0.1), features)
    np.testing.assert_array_equal(inverse.gain(0.3), inverse.gain((0.3, 0.3)))
    assert inverse.noise_features(0.3, 0.1) == inverse.noise_features((0.3, 0.3), 0.1)
    z = artifact.filter.start(np.ones(2))
    modes = gain * (inverse.whiten @ (z - inverse.z_offset))
    expected = inverse.x_offset + inverse.x_scale * inverse.mlp(np.array([*modes, *features, 0.0]))
    found = KKLObserver(artifact, levels, process_noise=0.1).reset(np.ones(2))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_levels_beyond_the_range_of_an_output(make_artifact):
    artifact = make_artifact(outputs=2)
    for wrong, inside in (((0.5, 2.5), r"\(0\.5, 2\.0\)"), (1.5, r"\(1\.0, 1\.5\)")):
        with pytest.raises(ValueError, match=rf"range, 0 to \(1, 2\); pass measurement_noise={inside}, the"):
            KKLObserver(artifact, wrong)
    assert KKLObserver(artifact, (1.0, 2.0)).measurement_noise == (1.0, 2.0)
    for wrong in ((0.1,), [], (0.1, -0.2), (0.1, "0.2")):
        with pytest.raises(ValueError, match=r"measurement_noise(\[1\])? must be"):
            KKLObserver(artifact, wrong)


def test_maps_of_several_outputs_that_take_one_level(make_artifact):
    now = make_artifact(outputs=2, noise=False)
    inverse = dataclasses.replace(
        now.inverse, noise_gain=now.inverse.noise_gain[0], measurement_noise_unit=0.1, measurement_noise_max=1.0
    )
    artifact = dataclasses.replace(now, inverse=inverse)
    assert KKLObserver(artifact, 0.3).measurement_noise == KKLObserver(artifact, (0.3, 0.3)).measurement_noise == 0.3
    with pytest.raises(ValueError, match=r"takes one level of measurement noise for all outputs, got \(0\.1, 0\.3\)"):
        KKLObserver(artifact, (0.1, 0.3))
    papers = exact_observer(C=np.eye(2))  # a map without noise features
    assert KKLObserver(papers, (0.1, 7.0)).measurement_noise == (0.1, 7.0)


def test_levels_per_output_must_fit_the_outputs(make_artifact):
    artifact = make_artifact(outputs=2, free_inverse=True)
    inverse = artifact.inverse
    for name in ("measurement_noise_unit", "measurement_noise_max"):
        for wrong in ((1.0, 2.0, 3.0), (1.0, -1.0), (1.0, "1"), (0.0, 1.0)):
            with pytest.raises(ArtifactError, match=name):
                dataclasses.replace(inverse, **{name: wrong})
    with pytest.raises(ArtifactError, match="one row for each of 2 outputs, got 3"):
        dataclasses.replace(artifact, inverse=make_artifact(outputs=3).inverse)
    with pytest.raises(ArtifactError, match="differ in measurement noise"):
        dataclasses.replace(artifact, free_inverse=make_artifact(free_inverse=True).free_inverse)


def test_the_default_level_is_the_usual_one_within_the_maps_range(make_artifact, tmp_path):
    path = tmp_path / "a.safetensors"
    for options, usual, assumed in (
        ({}, 0.5, 0.5),
        ({}, 7.0, 1.0),  # beyond the map's range
        ({"noise": False}, 7.0, 7.0),
        ({"outputs": 2}, (0.1, 3.0), (0.1, 2.0)),
        ({"outputs": 2}, [0.3, 0.3], 0.3),
    ):
        artifact = dataclasses.replace(make_artifact(**options), measurement_noise=usual)
        artifact.save(path)
        for observer in (KKLObserver(artifact), load(path), load(path, None)):
            assert observer.measurement_noise == assumed
        assert load(path, 0.25).measurement_noise == 0.25
    narrow = dataclasses.replace(make_artifact().inverse, measurement_noise_max=0.1)
    assert dataclasses.replace(make_artifact(), inverse=narrow).measurement_noise == 0.1
    for wrong in (-0.1, "0.5", (0.1, 0.2), True):
        with pytest.raises(ValueError, match="measurement_noise"):
            dataclasses.replace(make_artifact(), measurement_noise=wrong)


def limits_of_two(**changes):
    values = {
        "levels": np.array([[0.0, 0.0], [0.1, 10.0], [1.0, 100.0]]),
        "mean": np.array([[0.1, 1.0], [0.2, 2.0], [0.5, 50.0]]),
        "low": np.array([[0.0, 0.0], [0.005, 50.0], [0.5, 5000.0]]),
        "high": np.array([[0.1, 10.0], [0.2, 200.0], [2.0, 20000.0]]),
    }
    return limits(**(values | changes))


def test_limits_of_outputs_with_levels_of_their_own():
    found = limits_of_two()
    for row, levels in enumerate(found.levels):
        for part, at in zip((found.mean, found.low, found.high), found.at(tuple(levels)), strict=True):
            np.testing.assert_allclose(at, part[row])
    mean, low, high = found.at((0.1, 100.0))  # noise of output 2 raises the residual of output 1
    np.testing.assert_allclose(mean, found.mean[2])
    np.testing.assert_allclose(high, found.high[2])
    np.testing.assert_allclose(low, [found.low[1, 0], found.low[2, 1]])
    for wrong in ((1.1, 0.0), (0.0, 101.0), 2.0):
        with pytest.raises(ValueError, match=r"no limits beyond noise \[1\.0, 100\.0\]"):
            found.at(wrong)
    monitor = Monitor(dataclasses.replace(found, warm_up=0.0), (0.1, 10.0), 0.01)
    rows = monitor.update(monitor.start(1), np.zeros((1, 2)), np.ones((1, 2), bool))  # linear in noise^2
    assert monitor.score(rows) == pytest.approx(0.005 / (0.01 * np.exp(-0.1)))
    old = limits_of_two(levels=np.array([0.0, 1.0, 100.0]))  # one level for all outputs
    np.testing.assert_allclose(old.at(1.0)[0], found.mean[1])
    np.testing.assert_allclose(old.at((1.0, 100.0))[0], found.mean[2])


def test_impossible_levels_of_limits():
    for wrong in ([[0], [0], [0]], [[0, 0], [0, 0]], [[0, 0.1], [0.1, 1], [1, 2]], [[0, 0], [0.1, 10], [0.2, 10]], 0.0):
        with pytest.raises(ValueError, match="levels must"):
            limits_of_two(levels=np.array(wrong, dtype=float))


def test_residuals_are_zero_where_the_output_is_undefined(make_artifact):
    artifact = dataclasses.replace(make_artifact(), h=Expression([["log", ["x", 0]]]))
    x_hat, y = np.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]), np.full((3, 1), 0.5)
    assert artifact.residual(y, x_hat).ravel().tolist() == [0.0, 0.0, 0.5]
    assert artifact.knows_output
    with pytest.raises(ArtifactError, match="holds no output"):
        make_artifact().output(x_hat)
    assert not make_artifact().knows_output
    with pytest.raises(ArtifactError, match="must have 1 components and at most 2 states"):
        dataclasses.replace(make_artifact(), h=Expression([["x", 2]]))
