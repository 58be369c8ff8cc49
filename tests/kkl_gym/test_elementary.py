"""Functions that accept floats, arrays, tensors and symbols."""

import math

import numpy as np
import pytest

from kkl_gym import elementary

sympy, torch = pytest.importorskip("sympy"), pytest.importorskip("torch")
# Name, reference function on floats, range of arguments.
FUNCTIONS = {
    "sin": (math.sin, -10, 10),
    "cos": (math.cos, -10, 10),
    "tan": (math.tan, -1.4, 1.4),
    "exp": (math.exp, -10, 10),
    "log": (math.log, 0.01, 10),
    "sqrt": (math.sqrt, 0.01, 10),
    "tanh": (math.tanh, -10, 10),
    "abs": (math.fabs, -10, 10),
    "sign": (np.sign, -10, 10),
    "atan2": (math.atan2, -10, 10),
    "minimum": (min, -10, 10),
    "maximum": (max, -10, 10),
}
X, Y = sympy.symbols("x y", real=True)


def close(expected):
    return pytest.approx(expected, rel=1e-13, abs=1e-300)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_kind_of_number_gives_the_same(name):
    function, (on_floats, low, high) = getattr(elementary, name), FUNCTIONS[name]
    n = 2 if name in ("atan2", "minimum", "maximum") else 1
    values = np.random.default_rng(0).uniform(low, high, (n, 20))
    points = values.T.tolist()
    expected = [on_floats(*point) for point in points]
    assert [function(*point) for point in points] == expected
    assert type(function(*points[0])) is float
    assert function(*values) == close(expected)
    assert function(*values[:, 0]) == function(*map(np.array, points[0])) == close(expected[0])
    assert function(*[1] * n) == on_floats(*[1.0] * n)
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-5)):
        got = function(*torch.tensor(values).to(dtype))
        assert got.dtype == dtype
        assert got.tolist() == pytest.approx(expected, rel=tolerance, abs=tolerance)
    formula = function(*(X, Y)[:n])
    assert float(formula.subs(dict(zip((X, Y), points[0], strict=False)))) == close(expected[0])


@pytest.mark.parametrize("name", ["atan2", "minimum", "maximum"])
def test_numbers_stand_beside_arrays_tensors_and_symbols(name):
    function, on_floats = getattr(elementary, name), FUNCTIONS[name][0]
    for a, b in ((0.5, -1.5), (2, 3.0), (np.float64(-0.1), 0.1)):
        expected = on_floats(a, b)
        for left, right in ((a, np.array([b, b])), (np.array([a, a]), b)):
            assert function(left, right) == close([expected] * 2)
        for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-6)):
            for left, right in ((a, torch.tensor([b], dtype=dtype)), (torch.tensor([a], dtype=dtype), b)):
                got = function(left, right)
                assert got.dtype == dtype
                assert got.tolist() == pytest.approx([expected], rel=tolerance)
        assert float(function(X, b).subs(X, a)) == close(expected)
        assert float(function(a, X).subs(X, b)) == close(expected)


@pytest.mark.parametrize("x", [-2.5, -1.0, 0.3, 2.0, 3.0, 5.0])
def test_where_and_clip_choose_alike(x):
    def equation(x):
        inside = (x > -1.0) & (x <= 2.0) | (x >= 5.0)
        return elementary.where(inside, x * 3.0, -7.0), elementary.clip(x, -1.0, 2.0)

    expected = x * 3.0 if -1.0 < x <= 2.0 or x >= 5.0 else -7.0, min(max(x, -1.0), 2.0)
    assert equation(x) == equation(np.float64(x)) == expected
    assert [value[1] for value in equation(np.array([0.0, x]))] == close(expected)
    assert [float(value[1]) for value in equation(torch.tensor([0.0, x], dtype=torch.float64))] == close(expected)
    assert [float(value.subs(X, x)) for value in equation(X)] == close(expected)


def test_where_of_two_numbers_is_precise():
    assert elementary.where(True, np.array([1.0]), 0.0).tolist() == [1.0]
    x = torch.tensor([1.0, -1.0])
    assert elementary.where(x > 0, 0.1, 0.2).tolist() == [0.1, 0.2]  # not rounded to float32
    assert elementary.where(x > 0, x, 0.1).dtype == torch.float32
    assert elementary.where(x > 0, 0.1, x.double()).dtype == torch.float64


@pytest.mark.parametrize("wrong", [1.0, "x", None, [True], np.array([1.0, 0.0]), torch.tensor([1.0])])
def test_where_takes_conditions_only(wrong):
    with pytest.raises(TypeError, match=rf"comparison such as x\[0\] > 0 .* not {type(wrong).__name__}"):
        elementary.where(wrong, 1.0, 0.0)


INF, NAN = math.inf, math.nan
EXTREMES = [
    ("exp", 1000.0, INF), ("log", 0.0, -INF), ("sqrt", -1.0, NAN), ("sin", INF, NAN), ("tanh", INF, 1.0),
    ("exp", NAN, NAN), ("sign", 0.0, 0.0), ("abs", -INF, INF), ("minimum", (NAN, 1.0), NAN),
    ("maximum", (1.0, NAN), NAN), ("clip", (NAN, -1.0, 1.0), NAN),
]  # fmt: skip


@pytest.mark.parametrize(("name", "x", "expected"), EXTREMES)
def test_extremes_are_alike_and_silent(name, x, expected):
    function = getattr(elementary, name)
    for kind in (float, np.float64, torch.tensor, np.array):
        with np.errstate(invalid="ignore"):  # from the sine of an infinite array
            value = function(*map(kind, np.atleast_1d(x).tolist()))
        assert float(value) == pytest.approx(expected, nan_ok=True)
