"""Numbers read from observations and actions, against Gymnasium's own flattening."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from kkl_gym.signals import Inputs, Outputs

SPACES = [
    spaces.Box(-2.0, 3.0, (4,)),
    spaces.Box(-1.0, 1.0, (2, 3), np.float64),
    spaces.Box(0, 255, (5,), np.uint8),
    spaces.Discrete(4, start=-1),
    spaces.MultiDiscrete([2, 3], start=[1, -5]),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary((2, 2)),
    spaces.Dict(b=spaces.Discrete(2), a=spaces.Box(-1, 1, (2,)), c=spaces.Tuple([spaces.MultiBinary(2)])),
    spaces.Tuple([spaces.Discrete(3), spaces.Dict(x=spaces.Box(-np.inf, np.inf, ()))]),
]


def outputs(space, measured=None, angles=()):
    return Outputs(space, measured, angles, source="X-v0")


def inputs(space):
    return Inputs(space, source="X-v0")


def stacked(space, values):
    return gym.vector.utils.concatenate(
        space, values, gym.vector.utils.create_empty_array(space, len(values), fn=np.zeros)
    )


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_values_are_read_as_gymnasium_flattens_them_and_bounded_actions_are_scaled(space):
    space.seed(0)
    values = [space.sample() for _ in range(6)]
    expected = np.array([spaces.flatten(space, value) for value in values], float)
    flat = spaces.flatten_space(space)
    read, entry = outputs(space), flat.shape[0] - 1
    assert np.array_equal([read(value) for value in values], expected)
    assert np.array_equal(read(stacked(space, values), (6,)), expected)
    assert np.array_equal([read.low, read.high], [flat.low, flat.high])
    assert np.array_equal(outputs(space, [entry])(values[0]), expected[0, [entry]])
    act = inputs(space)
    if isinstance(space, spaces.Box):
        expected = 2 * (expected - flat.low) / (flat.high.astype(float) - flat.low) - 1
        assert (act.low == -1).all()
    assert np.allclose([act(value) for value in values], expected)
    assert np.allclose(act(stacked(space, values), (6,)), expected)


def test_actions_are_clipped_to_two_sided_bounds_only():
    bounds = np.array([[-2.0, 0.0, 1.0], [2.0, np.inf, 1.0]], np.float32)
    read = inputs(spaces.Box(*bounds))
    assert read([9.0, 7.0, 1.0]).tolist() == [1.0, 7.0, 0.0]
    assert [read.low.tolist(), read.high.tolist()] == [[-1.0, 0.0, -1.0], [1.0, np.inf, 1.0]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bounds_at_the_largest_float_count_as_unbounded(dtype):
    largest = np.finfo(dtype).max
    assert inputs(spaces.Box(-largest, largest, (2,), dtype))(np.array([3.0, -0.5])).tolist() == [3.0, -0.5]


def test_measured_entries_and_angles():
    space = spaces.Box(-6.0, 6.0, (4,))
    values = np.array([0.1, 2.0, -3.0, 9.0])
    assert outputs(space, [2, 0])(values).tolist() == [-3.0, 0.1]
    read = outputs(space, (3, 1, 2), np.array([1, 3]))
    expected = [np.cos(9.0), np.sin(9.0), np.cos(2.0), np.sin(2.0), -3.0]
    assert np.allclose(read(values), expected)
    assert np.allclose(read(np.array([values] * 2), (2,)), [expected] * 2)
    assert values.tolist() == [0.1, 2.0, -3.0, 9.0]
    assert read.low.tolist() == [-1.0] * 4 + [-6.0]
    parts = spaces.Dict(
        camera=spaces.Box(0, 255, (8, 8, 3), np.uint8), place=spaces.Box(-1, 1, (2,)), way=spaces.Box(-4, 4, (1,))
    )
    read = outputs(parts, ["way", "place"], ["way"])
    assert np.allclose(read({"place": values[:2], "way": values[1:2]}), [0.1, 2.0, np.cos(2.0), np.sin(2.0)])
    assert read.pairs == [(2, 3)]


def test_pairs_are_cosines_and_sines_that_are_measured():
    space = spaces.Box(-6.0, 6.0, (5,))
    read = outputs(space, [4, 3, 0, 1], [(0, 4), [1, 3]])
    assert read(np.arange(5.0)).tolist() == [4.0, 3.0, 0.0, 1.0]
    assert read.pairs == [(2, 0), (3, 1)]
    assert read.angles == ((0, 4), (1, 3))
    read = outputs(space, None, [1, (4, 2)])
    assert np.allclose(read(np.arange(5.0)), [0, np.cos(1), np.sin(1), 2, 3, 4])
    assert read.pairs == [(1, 2), (5, 3)]
    assert outputs(space, None, np.array([[0, 1], [2, 3]])).pairs == [(0, 1), (2, 3)]
    joints = spaces.Dict(cos=spaces.Box(-1, 1, (2,)), other=spaces.Box(-1, 1, (1,)), sin=spaces.Box(-1, 1, (2,)))
    assert outputs(joints, None, [("cos", "sin")]).pairs == [(0, 3), (1, 4)]


THREE = spaces.Box(-1, 1, (3,))
IMAGE = spaces.Box(0, 255, (8, 8, 3), np.uint8)
UNEVEN = spaces.Dict(a=spaces.Box(-1, 1, (1,)), b=spaces.Box(-1, 1, (2,)))
MIXED = spaces.Dict(camera=IMAGE, place=spaces.Box(-1, 1, (2,)), word=spaces.Text(5))


@pytest.mark.parametrize(("space", "measured", "angles", "match"), [
    (THREE, [3], (), r"measured names entry 3, but .* entries 0 to 2"),
    (THREE, [0, 0], (), r"each entry once, got \[0, 0\]"),
    (THREE, ["x"], (), "no keys: name indices"),
    (THREE, [0, 1], [(0, 2)], r"angles must be among the measured entries, \(0, 1\), got"),
    (UNEVEN, None, [("a", "b")], "with 1 and 2"),
    (MIXED, [1], (), "X-v0, 'camera', is an image"),
    (MIXED, ["word"], (), "holds Text"),
    (MIXED, ["speed"], (), "has keys 'camera', 'place', 'word'"),
    (spaces.Sequence(spaces.Discrete(2)), None, (), "only Box, Discrete"),
])  # fmt: skip
def test_errors_for_unmeasurable_entries_name_the_fix(space, measured, angles, match):
    with pytest.raises(ValueError, match=match):
        outputs(space, measured, angles)


@pytest.mark.parametrize(("space", "wrong"), [
    (spaces.Box(-1, 1, (2,)), [0.0, np.nan]), (spaces.Box(-1, 1, (2,)), [0.0]), (spaces.Discrete(3, start=1), 0),
    (spaces.MultiDiscrete([2, 2]), [0, 2]), (spaces.Dict(a=spaces.Discrete(2)), {}),
], ids=str)  # fmt: skip
def test_wrong_actions_are_refused(space, wrong):
    with pytest.raises(ValueError, match="the action of X-v0 must"):
        inputs(space)(wrong)
    if not isinstance(wrong, tuple | dict):
        with pytest.raises(ValueError, match="the action of X-v0 must"):
            inputs(space)(np.array([wrong, wrong]), (2,))
