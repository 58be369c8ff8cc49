import functools
import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kkl_gym import SYSTEMS, Lorenz, ReverseDuffing, Rossler, System, VanDerPol, get_system

everyone = pytest.mark.parametrize("name", SYSTEMS)
VARIANTS = {
    "duffing": ReverseDuffing(),
    "duffing-fast": ReverseDuffing(a=4, b=9),
    "duffing-negative": ReverseDuffing(a=-2, b=0.5),
    "vdp": VanDerPol(),
    "vdp-stiff": VanDerPol(mu=20),
    "rossler": Rossler(),
    "rossler-unstable": Rossler(a=8),
    "rossler-slow": Rossler(a=-3, b=2, c=1),
    "lorenz": Lorenz(),
    "lorenz-swapped": Lorenz(sigma=28, rho=10),
    "lorenz-fast": Lorenz(beta=200),
    "lorenz-negative": Lorenz(sigma=-50, rho=10),
}


def states(system, factor=2):
    return st.tuples(*(st.floats(factor * low, factor * high) for low, high in system.X))


def symbolic(system):
    sympy = pytest.importorskip("sympy")
    x = sympy.symbols(f"x1:{system.nx + 1}")
    g = sympy.Matrix([list(row) for row in system.g(x)])
    return x, sympy.Matrix(list(system.f(x))), g, sympy.Matrix(list(system.h(x)))


@functools.cache
def from_symbols(name):
    """f, g and h as functions of numbers, made from formulas."""
    sympy = pytest.importorskip("sympy")
    x, *formulas = symbolic(get_system(name))
    return [sympy.lambdify(x, formula) for formula in formulas]


property_test = settings(deadline=None, max_examples=60, derandomize=True)


@everyone
@property_test
@given(data=st.data())
def test_arrays_agree_with_floats(name, data):
    system = get_system(name)
    x = data.draw(states(system))
    batch = np.array([x, x[::-1]]).T
    for method in (system.f, system.h):
        assert np.array_equal(np.array(method(batch))[:, 0], method(x))
    assert np.array_equal(system.drift(batch.T), np.transpose(system.f(batch)))
    assert np.array_equal(system.output(batch.T), np.transpose(system.h(batch)))


@everyone
@property_test
@given(data=st.data())
def test_symbols_agree_with_floats(name, data):
    system = get_system(name)
    x = data.draw(states(system))
    for method, function in zip((system.f, system.g, system.h), from_symbols(name), strict=True):
        assert np.allclose(np.ravel(method(x)), np.ravel(function(*x)), rtol=1e-12, atol=1e-12)


@everyone
@property_test
@given(data=st.data())
def test_tensors_agree_with_floats(name, data):
    torch = pytest.importorskip("torch")
    system = get_system(name)
    x = data.draw(states(system))
    tensors = torch.tensor(x, dtype=torch.float64).unbind()
    for method in (system.f, system.h):
        assert np.array_equal([float(c) for c in method(tensors)], method(x))


@everyone
def test_sizes_fit(name):
    system = get_system(name)
    x = [1.0] * system.nx
    assert len(system.f(x)) == system.nx == len(system.scale) == len(system.target) == len(system.state_names)
    assert np.shape(system.g(x)) == (system.nx, system.nu)
    assert len(system.h(x)) == system.ny == 1
    assert system.name == name
    assert all(type(c) is float for c in (*system.f(x), *system.h(x)))


def test_equations_are_the_published_ones():
    assert ReverseDuffing().f((2.0, 3.0)) == (27.0, -2.0)
    assert ReverseDuffing(a=2, b=5).f((2.0, 3.0)) == (54.0, -10.0)
    assert VanDerPol().f((2.0, 3.0)) == (3.0, -29.0)
    assert Rossler(a=1, b=2, c=3).f((4.0, 5.0, 6.0)) == (-11.0, 9.0, 8.0)
    assert Lorenz(sigma=2, rho=3, beta=4).f((5.0, 6.0, 7.0)) == (2.0, -26.0, 2.0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_rate_bounds_the_eigenvalues(variant):
    sympy = pytest.importorskip("sympy")
    system = VARIANTS[variant]
    x, f, _, _ = symbolic(system)
    jacobian = sympy.lambdify(x, f.jacobian(x))
    low, high = system.box(2)
    rng = np.random.default_rng(1)
    random = rng.uniform(low, high, (300, system.nx))
    grid = np.array(np.meshgrid(*([a, 0, (a + b) / 2, b] for a, b in zip(low, high, strict=True)))).reshape(
        system.nx, -1
    )
    for point in (*random, *grid.T, system.target):
        fastest = np.abs(np.linalg.eigvals(np.array(jacobian(*point), float))).max()
        assert fastest <= system.rate(point.tolist() if isinstance(point, np.ndarray) else point) * (1 + 1e-9)


@everyone
def test_rate_serves_floats_and_batches(name):
    system = get_system(name)
    x = np.random.default_rng(2).uniform(*system.box(2), (50, system.nx))
    batch = system.rate(x.T)
    assert batch.shape == (50,)
    assert np.allclose(batch, [system.rate(row) for row in x.tolist()], rtol=1e-14)


def test_default_rate_is_the_norm_of_the_jacobian():
    system = Lorenz()
    x, f, _, _ = symbolic(system)
    at = (3.0, -4.0, 25.0)
    half = np.ptp(system.X, axis=1) / 2
    norm = np.linalg.norm(np.array(f.jacobian(x).subs(dict(zip(x, at, strict=True))), float) * half / half[:, None])
    assert System.rate(system, at) == pytest.approx(norm, rel=1e-5)
    assert System.rate(system, np.array([at, at]).T) == pytest.approx([norm, norm], rel=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_target_is_an_equilibrium(variant):
    system = VARIANTS[variant]
    if variant in ("rossler-slow",):
        system = Rossler(a=-3, b=0.05, c=1)
    if variant == "lorenz-negative":
        system = Lorenz(sigma=-50, rho=10, beta=1)
    assert system.f(system.target) == pytest.approx([0.0] * system.nx, abs=1e-10)


@everyone
def test_target_lies_in_the_training_box(name):
    system = get_system(name)
    assert all(low < t < high for t, (low, high) in zip(system.target, system.X, strict=True))


def test_target_that_does_not_exist_raises():
    with pytest.raises(ValueError, match=r"rho=0\.5"):
        _ = Lorenz(rho=0.5).target
    with pytest.raises(ValueError, match="a=10"):
        _ = Rossler(a=10, b=10).target


def test_rossler_target_is_the_inner_equilibrium():
    system = Rossler()
    roots = np.roots([system.a, system.c, system.b])
    assert system.target[1] == pytest.approx(roots[np.abs(roots).argmin()])


def test_swapped_lorenz_is_reachable():
    swapped = get_system("lorenz", {"sigma": 28, "rho": 10})
    assert swapped == Lorenz(sigma=28, rho=10) != Lorenz()
    assert swapped.parameters == {"sigma": 28.0, "rho": 10.0, "beta": 8 / 3}


def test_swapped_lorenz_settles():
    swapped = get_system("lorenz", {"sigma": 28, "rho": 10})
    eigenvalues = np.linalg.eigvals(jacobian_at(swapped, swapped.target))
    assert eigenvalues.real.max() < 0 < np.linalg.eigvals(jacobian_at(Lorenz(), Lorenz().target)).real.max()


def jacobian_at(system, point):
    x, f, _, _ = symbolic(system)
    return np.array(f.jacobian(x).subs(dict(zip(x, point, strict=True))), float)


def test_reverse_duffing_conserves_its_energy():
    sympy = pytest.importorskip("sympy")
    a, b = 2.0, 0.5
    x, f, _, _ = symbolic(ReverseDuffing(a, b))
    energy = a * x[1] ** 4 / 4 + b * x[0] ** 2 / 2
    assert sympy.simplify(sum(sympy.diff(energy, xi) * fi for xi, fi in zip(x, f, strict=True))) == 0


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"nu": 1.0}, "van_der_pol has no parameter 'nu'; it has mu"),
        ({"mu": math.nan}, "parameter mu of van_der_pol .* nan"),
        ({"mu": math.inf}, "mu .* inf"),
        ({"mu": "3"}, "mu .* '3'"),
        ({"mu": True}, "mu .* True"),
        ({"mu": None}, "mu .* None"),
    ],
)
def test_bad_parameters_are_named(parameters, match):
    with pytest.raises(ValueError, match=match):
        get_system("van_der_pol", parameters)


def test_system_without_parameters_says_so():
    class Bare(System):
        name = "bare"
        X, bounds = ((-1, 1),), ((-2, 2),)

        def f(self, x):
            return (-x[0],)

        def h(self, x):
            return (x[0],)

    with pytest.raises(ValueError, match="bare has no parameter 'mu'; it has none"):
        get_system(Bare, {"mu": 1.0})


def test_systems_are_frozen_values():
    assert VanDerPol(2) == VanDerPol(mu=2.0)
    assert isinstance(VanDerPol(2).mu, float)
    with pytest.raises(AttributeError):
        VanDerPol().mu = 2.0


@everyone
def test_get_system_takes_names_classes_and_instances(name):
    cls = SYSTEMS[name]
    assert get_system(name) == get_system(cls) == get_system(cls()) == get_system(f"kkl_gym.systems:{cls.__name__}")


def test_get_system_keeps_and_changes_an_instances_parameters():
    assert get_system(Lorenz(rho=10)) == Lorenz(rho=10)
    assert get_system(Lorenz(rho=10), {"beta": 2}) == Lorenz(rho=10, beta=2)


def test_get_system_from_a_script(script, monkeypatch):
    system = get_system(f"{script}:Pendulum", {"damping": 0.5})
    assert (system.name, system.nu, system.ny, system.parameters) == ("pendulum", 0, 1, {"damping": 0.5})
    assert system.scale == (3.0, 2.0)
    assert type(get_system(f"{script}:Pendulum")) is type(system)  # the script is loaded once
    monkeypatch.chdir(script.parent)
    assert type(get_system("pendulum_script.py:Pendulum")) is type(system)


def test_get_system_from_a_module(script, monkeypatch):
    monkeypatch.syspath_prepend(script.parent)
    assert get_system("pendulum_script:Pendulum").name == "pendulum"
    sys.modules.pop("pendulum_script")


@pytest.mark.parametrize("nonsense", [
    "nonsense", "", "Lorenz", "no_such_module:Class", "kkl_gym:NoClass", "no/such/file.py:Class",
    ":Lorenz", "..:Lorenz", "kkl_gym:KKLEnv", "kkl_gym:__version__", "kkl_gym:System",
])  # fmt: skip
def test_nonsense_names_raise_with_the_name(nonsense):
    with pytest.raises(ValueError, match=r"unknown system|cannot load|not a subclass") as raised:
        get_system(nonsense)
    assert repr(nonsense) in str(raised.value)


@pytest.mark.parametrize("nonsense", [None, 3, int, object()])
def test_nonsense_objects_raise(nonsense):
    with pytest.raises(ValueError, match="system must be"):
        get_system(nonsense)


def test_nonsense_lists_what_ships():
    with pytest.raises(ValueError, match="reverse_duffing, van_der_pol, rossler, lorenz"):
        get_system("nonsense")


def test_wrong_class_in_a_script_raises(script):
    with pytest.raises(ValueError, match="not a subclass of"):
        get_system(f"{script}:NoSystem")


def test_script_that_fails_is_not_half_loaded(tmp_path):
    path = tmp_path / "failing.py"
    path.write_text("raise RuntimeError('mine')")
    for _ in range(2):
        with pytest.raises(
            ValueError, match=r"cannot load the system '.*failing\.py:Class': .*failing\.py, line 1 "
        ) as raised:
            get_system(f"{path}:Class")
        assert "(`raise RuntimeError('mine')`): RuntimeError: mine" in str(raised.value)


def test_missing_methods_are_named():
    mine = type("Mine", (System,), {"name": "mine", "X": ((-1, 1),) * 2, "bounds": ((-9, 9),) * 2})()
    with pytest.raises(NotImplementedError, match="Mine does not define f"):
        mine.f((0.0, 0.0))
    with pytest.raises(NotImplementedError, match="Mine does not define h"):
        mine.h((0.0, 0.0))
