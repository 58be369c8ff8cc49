"""Functions that serve floats, arrays, tensors and symbols alike."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kkl_gym import elementary

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
unary = pytest.mark.parametrize("name", UNARY)
binary = pytest.mark.parametrize("name", BINARY)
property_test = settings(deadline=None, max_examples=30, derandomize=True)
numbers = st.floats(-10, 10, allow_subnormal=False)


def close(expected):
    return pytest.approx(expected, rel=1e-13, abs=1e-300)


@unary
@property_test
@given(data=st.data())
def test_one_argument_on_floats_and_arrays(name, data):
    function, (on_floats, low, high) = getattr(elementary, name), UNARY[name]
    x = data.draw(st.floats(low, high, allow_subnormal=False))
    expected = on_floats(x)
    assert function(x) == expected
    assert type(function(x)) is float
    assert function(np.array([x, x])) == close([expected] * 2)
    assert function(np.array(x)) == close(expected)
    assert function(np.float64(x)) == close(expected)
    assert function(np.float32(x)) == pytest.approx(on_floats(float(np.float32(x))), rel=1e-6)


@unary
def test_one_argument_on_integers(name):
    assert getattr(elementary, name)(1) == UNARY[name][0](1.0)
    assert getattr(elementary, name)(np.array([1, 1])) == close([UNARY[name][0](1.0)] * 2)


@binary
@property_test
@given(a=numbers, b=numbers)
def test_two_arguments_on_floats_and_arrays(name, a, b):
    function, expected = getattr(elementary, name), BINARY[name](a, b)
    assert function(a, b) == expected
    for left in (a, np.array([a, a]), np.float64(a)):
        for right in (b, np.array([b, b])):
            assert function(left, right) == close(expected if np.ndim(left) == np.ndim(right) == 0 else [expected] * 2)


@unary
def test_one_argument_on_tensors(name):
    torch = pytest.importorskip("torch")
    on_floats, low, high = UNARY[name]
    x = torch.linspace(low, high, 30, dtype=torch.float64)
    expected = [on_floats(value) for value in x.tolist()]
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-5)):
        got = getattr(elementary, name)(x.to(dtype))
        assert got.dtype == dtype
        assert got.tolist() == pytest.approx(expected, rel=tolerance, abs=tolerance)


@binary
def test_two_arguments_on_tensors_and_numbers(name):
    torch = pytest.importorskip("torch")
    function = getattr(elementary, name)
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-6)):
        x = torch.linspace(-3, 3, 8, dtype=dtype)
        for a, b in ((x, 0.5), (0.5, x), (x, x.flip(0)), (2, x), (x, np.float64(0.1)), (x[3], x)):
            got = function(a, b)
            expected = [
                BINARY[name](*pair) for pair in zip(*(np.broadcast_to(v, 8).tolist() for v in (a, b)), strict=True)
            ]
            assert got.dtype == dtype
            assert got.tolist() == pytest.approx(expected, rel=tolerance, abs=tolerance)


@unary
def test_one_argument_on_symbols(name):
    sympy = pytest.importorskip("sympy")
    symbol = sympy.Symbol("x", real=True)
    expected = {"abs": sympy.Abs}.get(name) or getattr(sympy, name)
    assert getattr(elementary, name)(symbol) == expected(symbol)


@binary
def test_two_arguments_on_symbols_and_numbers(name):
    sympy = pytest.importorskip("sympy")
    x, y = sympy.symbols("x y", real=True)
    function = getattr(elementary, name)
    for a, b in ((x, y), (x, 0.5), (0.5, x), (x, np.float64(0.5)), (2, x + y)):
        at = {x: 0.75, y: -1.5}
        numbers = [float(sympy.sympify(v).subs(at)) for v in (a, b)]
        assert float(function(a, b).subs(at)) == close(BINARY[name](*numbers))


@property_test
@given(x=numbers, a=numbers, b=numbers)
def test_where_and_clip_choose_alike(x, a, b):
    sympy, torch = pytest.importorskip("sympy"), pytest.importorskip("torch")
    symbol = sympy.Symbol("x", real=True)

    def equation(x):
        inside = (x > -1.0) & (x <= 2.0) | (x >= 5.0)
        return elementary.where(inside, x * a, b), elementary.clip(x, -1.0, 2.0)

    expected = x * a if -1.0 < x <= 2.0 or x >= 5.0 else b, min(max(x, -1.0), 2.0)
    assert equation(x) == equation(np.float64(x)) == expected
    assert [value[1] for value in equation(np.array([0.0, x]))] == close(expected)
    assert [float(value[1]) for value in equation(torch.tensor([0.0, x], dtype=torch.float64))] == close(expected)
    assert [float(value.subs(symbol, x)) for value in equation(symbol)] == close(expected)


def test_where_on_floats():
    assert elementary.where(0.5 > 0, 1.0, 2.0) == 1.0
    assert elementary.where((0.5 > 0) & (0.5 > 1), 1.0, 2.0) == 2.0
    assert elementary.where(True, np.array([1.0]), 0.0).tolist() == [1.0]


def test_where_of_two_numbers_is_precise():
    torch = pytest.importorskip("torch")
    x = torch.tensor([1.0, -1.0])
    assert elementary.where(x > 0, 0.1, 0.2).tolist() == [0.1, 0.2]  # which float32 would round
    assert elementary.where(x > 0, x, 0.1).dtype == torch.float32
    assert elementary.where(x > 0, 0.1, x.double()).dtype == torch.float64
    with pytest.raises(TypeError, match="not Tensor"):
        elementary.where(x, 1.0, 0.0)


@pytest.mark.parametrize("wrong", [1.0, -2, "x", None, [True], np.array([1.0, 0.0])])
def test_where_takes_conditions_only(wrong):
    with pytest.raises(TypeError, match=rf"comparison such as x\[0\] > 0 .* not {type(wrong).__name__}"):
        elementary.where(wrong, 1.0, 0.0)


EXTREMES = [
    ("exp", 1000.0, math.inf),
    ("exp", -1000.0, 0.0),
    ("log", 0.0, -math.inf),
    ("log", -1.0, math.nan),
    ("sqrt", -1.0, math.nan),
    ("sin", math.inf, math.nan),
    ("tanh", math.inf, 1.0),
    ("exp", math.nan, math.nan),
    ("sign", 0.0, 0.0),
    ("abs", -math.inf, math.inf),
]


@pytest.mark.parametrize(("name", "x", "expected"), EXTREMES)
def test_extremes_are_alike_and_silent(name, x, expected):
    torch, function = pytest.importorskip("torch"), getattr(elementary, name)
    assert function(x) == pytest.approx(expected, nan_ok=True)
    assert function(np.float64(x)) == pytest.approx(expected, nan_ok=True)
    assert float(function(torch.tensor(x))) == pytest.approx(expected, nan_ok=True)
    if math.isfinite(x):
        assert function(np.array([x])) == pytest.approx([expected], nan_ok=True)
    assert function(int(x) if math.isfinite(x) else x) == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("name", ["minimum", "maximum"])
@pytest.mark.parametrize("pair", [(math.nan, 1.0), (1.0, math.nan)])
def test_nan_wins(name, pair):
    torch, function = pytest.importorskip("torch"), getattr(elementary, name)
    assert math.isnan(function(*pair))
    assert np.isnan(function(np.array(pair), np.array(pair[::-1]))).all()
    assert function(*torch.tensor(pair)).isnan()
    assert math.isnan(elementary.clip(math.nan, -1.0, 1.0))


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_the_rest_is_refused(name):
    for wrong in ("1", None, [1.0]):
        with pytest.raises(TypeError, match=f"{name} takes floats, arrays, .* not .*{type(wrong).__name__}"):
            getattr(elementary, name)(*[wrong] * (2 if name in BINARY else 1))


def test_gradients():
    torch = pytest.importorskip("torch")
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


def test_functions_say_what_they_are():
    for name in (*UNARY, *BINARY):
        function = getattr(elementary, name)
        assert function.__name__ == name
        assert function.__doc__.startswith(f"{name}(")
