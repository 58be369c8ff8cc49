import numpy as np
import pytest
from gymnasium import spaces

from kkl_gym.named import InputReader, Reader, acting, observed, resolved

PLAIN = spaces.Box(-2.0, 3.0, (2, 2))
KEYED = spaces.Dict(
    {
        "arm": spaces.Box(-1.0, 1.0, (2,)),
        "camera": spaces.Box(0, 255, (4, 4, 3), np.uint8),
        "gap": spaces.Box(0.0, 9.0, (1,)),
    }
)


def names(*given, space=PLAIN):
    return resolved(given, space, role="measured", source="Env-v0")


def test_entries_of_a_box_are_numbered():
    assert observed(PLAIN) == ("obs[0]", "obs[1]", "obs[2]", "obs[3]")
    assert names(0, "obs[3]", "cos(2)", "info[speed]") == ("obs[0]", "obs[3]", "cos(obs[2])", "info[speed]")


def test_keys_of_a_dict_stand_for_all_of_their_entries():
    assert names("arm", "gap[0]", "sin(arm[1])", space=KEYED) == ("arm[0]", "arm[1]", "gap", "sin(arm[1])")
    assert names("1", space=KEYED) == ("arm[1]",)


@pytest.mark.parametrize("wrong", ["4", "obs[9]", "-1", "speed", "cos(7)", "tan(0)", "info[]"])
def test_an_entry_that_is_not_there_is_named(wrong):
    with pytest.raises(ValueError, match=r"measured contains .*Env-v0 holds obs\[0\], obs\[1\].*an index stands for"):
        names(wrong)


def test_reads_one_and_many_alike():
    rng = np.random.default_rng(0)
    reader = Reader(PLAIN, names("3", "cos(0)", "info[speed][1]", "0"), source="Env-v0")
    values, speeds = rng.uniform(-2, 3, (5, 2, 2)), rng.normal(size=(5, 3))
    expected = np.stack([values[:, 1, 1], np.cos(values[:, 0, 0]), speeds[:, 1], values[:, 0, 0]], -1)
    np.testing.assert_array_equal(reader(values, {"speed": speeds}, (5,)), expected)
    for value, speed, row in zip(values, speeds, expected):
        np.testing.assert_array_equal(reader(value, {"speed": speed}), row)
    assert reader.low.tolist() == [-2.0, -1.0, -np.inf, -2.0]
    assert reader.high.tolist() == [3.0, 1.0, np.inf, 3.0]
    assert reader.keys == ("speed",)


def test_flags_in_info_are_numbers():
    reader = Reader(PLAIN, ["info[closed]"], source="Env-v0")
    assert [reader(np.zeros((2, 2)), {"closed": flag}).tolist() for flag in (True, np.False_)] == [[1.0], [0.0]]


def test_of_a_dict_entries_that_are_not_read_are_not_looked_at():
    reader = Reader(KEYED, names("gap", "arm[1]", space=KEYED), source="Env-v0")
    values = {"arm": np.array([np.nan, 0.2]), "camera": None, "gap": np.array([4.0])}
    assert reader(values, {}).tolist() == [4.0, 0.2]
    with pytest.raises(ValueError, match=r"nan in entry 1 of 'arm':"):
        reader({**values, "arm": np.array([0.1, np.nan])}, {})
    space = spaces.Dict({"arm": PLAIN, "arm[x]": spaces.Box(-1.0, 1.0, (2,))})
    reader = Reader(space, names("arm[x][1]", "arm[2]", space=space), source="Env-v0")
    assert reader({"arm": np.arange(4.0).reshape(2, 2), "arm[x]": np.array([0.1, 0.2])}, {}).tolist() == [0.2, 2.0]


@pytest.mark.parametrize(("name", "info", "match"), [
    ("info[speed]", {"other": 1.0}, "has no 'speed'; there is other"),
    ("info[speed]", {"speed": [1.0, 2.0]}, r"holds 2 numbers: name one, as in info\[speed\]\[0\]"),
    ("info[speed][2]", {"speed": [1.0, 2.0]}, "holds 2 numbers there"),
    ("info[speed]", {"speed": "fast"}, "real numbers"),
])  # fmt: skip
def test_missing_entries_of_info_are_named(name, info, match):
    with pytest.raises(ValueError, match=match):
        Reader(PLAIN, [name], source="Env-v0")(np.zeros((2, 2)), info)


def test_inputs_are_scaled_or_one_hot():
    box = spaces.Box(np.float32([-2.0, 0.0]), np.float32([2.0, 4.0]))
    assert acting(box) == ("action[0]", "action[1]")
    assert InputReader(box, ["action[1]"], source="Env-v0")(np.array([1.0, 3.0])).tolist() == [0.5]
    one_of = InputReader(spaces.Discrete(3), acting(spaces.Discrete(3)), source="Env-v0")
    np.testing.assert_array_equal(one_of(np.array([2, 0]), (2,)), [[0, 0, 1], [1, 0, 0]])
    with pytest.raises(ValueError, match=r"inputs contains 'action\[3\]'"):
        InputReader(spaces.Discrete(3), ["action[3]"], source="Env-v0")
