"""Functions that serve floats, arrays, tensors and symbols alike."""

import math

import numpy as np
import pytest

from kkl_gym import elementary

sympy, torch = pytest.importorskip("sympy"), pytest.importorskip("torch")
# Name, what it is on floats, and a range of arguments.
UNARY = {
    "sin": (math.sin, -10, 10),
    "cos": (math.cos, -10, 10),
    "tan": (math.tan, -1.4, 1.4),
    "exp": (math.exp, -10, 10),
    "log": (math.log, 0.01, 10),
    "sqrt": (math.sqrt, 0.01, 10),
    "tanh": (math.tanh, -10, 10),
    "abs": (math.fabs, -10, 10),
    "sign": (np.sign, -10, 10),
}
BINARY = {"atan2": math.atan2, "minimum": min, "maximum": max}
X = sympy.Symbol("x", real=True)


def close(expected):
    return pytest.approx(expected, rel=1e-13, abs=1e-300)


@pytest.mark.parametrize("name", UNARY)
def test_one_argument(name):
    function, (on_floats, low, high) = getattr(elementary, name), UNARY[name]
    values = np.random.default_rng(0).uniform(low, high, 20)
    expected = [on_floats(value) for value in values.tolist()]
    assert [function(value) for value in values.tolist()] == expected
    assert type(function(values.tolist()[0])) is float
    assert function(values) == close(expected)
    assert function(np.array(values[0])) == function(values[0]) == close(expected[0])
    assert function(np.float32(values[0])) == pytest.approx(on_floats(float(np.float32(values[0]))), rel=1e-6)
    assert function(1) == on_floats(1.0)
    assert function(np.array([1, 1])) == close([on_floats(1.0)] * 2)
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-5)):
        got = function(torch.tensor(values).to(dtype))
        assert got.dtype == dtype
        assert got.tolist() == pytest.approx(expected, rel=tolerance, abs=tolerance)
    assert function(X) == ({"abs": sympy.Abs}.get(name) or getattr(sympy, name))(X)


@pytest.mark.parametrize("name", BINARY)
def test_two_arguments(name):
    function, on_floats = getattr(elementary, name), BINARY[name]
    for a, b in [*np.random.default_rng(0).uniform(-10, 10, (10, 2)).tolist(), [1.0, 1.0], [0.0, -2.0]]:
        expected = on_floats(a, b)
        assert function(a, b) == expected
        assert function(np.float64(a), b) == close(expected)
        for left, right in ((a, np.array([b, b])), (np.array([a, a]), b), (np.array([a, a]), np.array([b, b]))):
            assert function(left, right) == close([expected] * 2)
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-6)):
        x = torch.linspace(-3, 3, 8, dtype=dtype)
        for a, b in ((x, 0.5), (0.5, x), (x, x.flip(0)), (2, x), (x, np.float64(0.1)), (x[3], x)):
            got = function(a, b)
            pairs = zip(*(np.broadcast_to(v, 8).tolist() for v in (a, b)), strict=True)
            assert got.dtype == dtype
            assert got.tolist() == pytest.approx([on_floats(*pair) for pair in pairs], rel=tolerance, abs=tolerance)
    y = sympy.Symbol("y", real=True)
    at = {X: 0.75, y: -1.5}
    for a, b in ((X, y), (X, 0.5), (0.5, X), (X, np.float64(0.5)), (2, X + y)):
        numbers = [float(sympy.sympify(v).subs(at)) for v in (a, b)]
        assert float(function(a, b).subs(at)) == close(on_floats(*numbers))


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
    assert elementary.where(x > 0, 0.1, 0.2).tolist() == [0.1, 0.2]  # which float32 would round
    assert elementary.where(x > 0, x, 0.1).dtype == torch.float32
    assert elementary.where(x > 0, 0.1, x.double()).dtype == torch.float64


@pytest.mark.parametrize("wrong", [1.0, "x", None, [True], np.array([1.0, 0.0]), torch.tensor([1.0])])
def test_where_takes_conditions_only(wrong):
    with pytest.raises(TypeError, match=rf"comparison such as x\[0\] > 0 .* not {type(wrong).__name__}"):
        elementary.where(wrong, 1.0, 0.0)


EXTREMES = [
    ("exp", 1000.0, math.inf),
    ("log", 0.0, -math.inf),
    ("sqrt", -1.0, math.nan),
    ("sin", math.inf, math.nan),
    ("tanh", math.inf, 1.0),
    ("exp", math.nan, math.nan),
    ("sign", 0.0, 0.0),
    ("abs", -math.inf, math.inf),
]


@pytest.mark.parametrize(("name", "x", "expected"), EXTREMES)
def test_extremes_are_alike_and_silent(name, x, expected):
    function, expected = getattr(elementary, name), pytest.approx(expected, nan_ok=True)
    for value in (x, np.float64(x), torch.tensor(x), int(x) if math.isfinite(x) else x):
        assert float(function(value)) == expected
    if math.isfinite(x):
        assert function(np.array([x]))[0] == expected


@pytest.mark.parametrize("name", ["minimum", "maximum"])
@pytest.mark.parametrize("pair", [(math.nan, 1.0), (1.0, math.nan)])
def test_nan_wins(name, pair):
    function = getattr(elementary, name)
    assert math.isnan(function(*pair))
    assert np.isnan(function(np.array(pair), np.array(pair[::-1]))).all()
    assert function(*torch.tensor(pair)).isnan()
    assert math.isnan(elementary.clip(math.nan, -1.0, 1.0))


def test_gradients():
    x = torch.tensor([0.3, -0.7], dtype=torch.float64, requires_grad=True)
    for value, slope in (
        (elementary.sin(x), [math.cos(0.3), math.cos(0.7)]),
        (elementary.abs(x), [1.0, -1.0]),
        (elementary.sign(x) * x, [1.0, -1.0]),
        (elementary.maximum(x, 0.0), [1.0, 0.0]),
        (elementary.clip(x, -0.5, 0.5), [1.0, 0.0]),
        (elementary.where(x > 0, x * x, -x), [0.6, -1.0]),
        (elementary.atan2(x, 1.0), [1 / 1.09, 1 / 1.49]),
    ):
        (got,) = torch.autograd.grad(value.sum(), x)
        assert got.tolist() == close(slope)
