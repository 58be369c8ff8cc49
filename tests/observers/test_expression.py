"""Outputs as expressions: their values, and errors for invalid expressions."""

import json
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from observers import Expression

UNARY = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "tanh": np.tanh,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
}
BINARY = {
    "+": lambda a, b: a + b,
    "*": lambda a, b: a * b,
    "**": lambda a, b: np.power(np.float64(a), b),
    "%": np.mod,
    "atan2": np.arctan2,
    "minimum": np.minimum,
    "maximum": np.maximum,
}
COMPARED = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}


def one(name, of, a):
    return [name, a[0]], lambda x: of(a[1](x))


def two(name, of, a, b):
    return [name, a[0], b[0]], lambda x: of(a[1](x), b[1](x))


def chosen(name, a, b):
    return ["where", [name, a[0], b[0]], a[0], b[0]], lambda x: np.where(
        COMPARED[name](a[1](x), b[1](x)), a[1](x), b[1](x)
    )


def grown(inner):
    return st.one_of(
        st.builds(lambda name, a: one(name, UNARY[name], a), st.sampled_from(list(UNARY)), inner),
        st.builds(lambda name, a, b: two(name, BINARY[name], a, b), st.sampled_from(list(BINARY)), inner, inner),
        st.builds(chosen, st.sampled_from(list(COMPARED)), inner, inner),
    )


leaves = st.one_of(
    st.integers(0, 2).map(lambda i: (["x", i], lambda x: x[i])),
    st.floats(-9, 9).map(lambda c: (c, lambda x: np.float64(c))),
    st.integers(-9, 9).map(lambda c: (c, lambda x: np.float64(c))),
)
trees = st.recursive(leaves, grown, max_leaves=8)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(trees, st.integers(0, 1000))
def test_expressions_agree_with_numpy(tree, seed):
    written, function = tree
    expression = Expression(json.loads(json.dumps([written, ["x", 0]])))
    x = np.random.default_rng(seed).normal(0.0, 3.0, (4, 5, 3))
    with np.errstate(all="ignore"):
        expected = np.broadcast_to(function(np.moveaxis(x, -1, 0)), (4, 5))
    found = expression(x)
    assert found.shape == (4, 5, 2)
    np.testing.assert_array_equal(found[..., 0], expected)
    np.testing.assert_array_equal(found[..., 1], x[..., 0])
    np.testing.assert_array_equal(expression(x[1, 2]), found[1, 2])
    assert 1 <= expression.states <= 3
    again = Expression(json.loads(json.dumps(expression.components)))
    assert again == expression
    assert pickle.loads(pickle.dumps(expression)) == expression


def test_conditions_combine():
    inside = ["where", ["and", [">", ["x", 0], 0], ["not", ["or", [">", ["x", 1], 1], ["<", ["x", 1], -1]]]], 1, 0]
    assert Expression([inside])(np.array([[1, 0], [1, 2], [1, -2], [-1, 0]])).ravel().tolist() == [1, 0, 0, 0]
    assert Expression([["+", 1, 2, ["x", 0], 4], ["maximum", 1, ["x", 0], 3]])(np.array([5.0])).tolist() == [12, 5]


def test_undefined_values_give_no_warnings():
    undefined = Expression([["sqrt", ["x", 0]], ["log", ["x", 1]], ["**", ["x", 1], -1], ["**", 10, ["**", 10, 10]]])
    first, *others = undefined(np.array([-1.0, 0.0])).tolist()
    assert math.isnan(first)
    assert others == [-math.inf, math.inf, math.inf]


NONE = [
    [], "sin", None, {}, ["sin"], [["sin"]], [["sin", 1, 2]], [["y", 0]], [["x", -1]], [["x", 0.0]],
    [["x", True]], [[]], [[["x", 0]]], [None], [True], ["1.0"], [math.nan], [10**400], [["+", 1]],
    [["where", 1, 2, 3]], [["where", ["<", 1, 2], 3]], [["<", 1, 2]], [["sin", ["<", 1, 2]]],
    [["where", ["and", True, True], 1, 2]], [["__import__", "os"]], [["eval", "1"]], [{"x": 0}], [["sin", "x"]],
]  # fmt: skip


def test_invalid_expressions_are_refused():
    for wrong in NONE:
        with pytest.raises(
            ValueError, match=r"output|expression|state|name and arg|must be one of|takes \D*\d arguments"
        ):
            Expression(wrong)


def test_size_and_depth_are_limited():
    deep = ["x", 0]
    for _ in range(24):
        deep = ["sin", deep]
    Expression([deep])
    for _ in range(1000):
        deep = ["sin", deep]
    for wrong in ([["+", *[1] * 2000]], [1] * 2001, [deep]):
        with pytest.raises(ValueError, match="at most 2000 parts, and 24 nested functions"):
            Expression(wrong)
