"""The shipped systems' equations, rates and targets, and the lookup of systems by name."""

import sys

import numpy as np
import pytest

from kkl_gym import SYSTEMS, Lorenz, ReverseDuffing, Rossler, System, VanDerPol, get_system

sympy = pytest.importorskip("sympy")
everyone = pytest.mark.parametrize("name", SYSTEMS)
VARIANTS = {
    "duffing": ReverseDuffing(),
    "duffing-negative": ReverseDuffing(a=-2, b=0.5),
    "vdp-stiff": VanDerPol(mu=20),
    "rossler": Rossler(),
    "rossler-unstable": Rossler(a=8),
    "rossler-slow": Rossler(a=-3, b=0.05, c=1),
    "lorenz": Lorenz(),
    "lorenz-swapped": Lorenz(sigma=28, rho=10),
    "lorenz-fast": Lorenz(beta=200),
    "lorenz-negative": Lorenz(sigma=-50, rho=10, beta=1),
}


def symbolic(system):
    x = sympy.symbols(f"x1:{system.nx + 1}")
    return x, sympy.Matrix(list(system.f(x)))


def jacobian_at(system, point):
    x, f = symbolic(system)
    return np.array(f.jacobian(x).subs(dict(zip(x, point, strict=True))), float)


@everyone
def test_arrays_tensors_and_symbols_agree_with_floats(name):
    torch = pytest.importorskip("torch")
    system = get_system(name)
    batch = np.random.default_rng(2).uniform(*system.box(2), (10, system.nx))
    symbols = sympy.symbols(f"x1:{system.nx + 1}")
    for method, of_rows in ((system.f, system.drift), (system.h, system.output), (system.g, None)):
        alone = [method(row) for row in batch.tolist()]
        formula = sympy.lambdify(symbols, sympy.Matrix(method(symbols)))
        assert np.allclose(np.reshape(alone, (10, -1)), [np.ravel(formula(*row)) for row in batch], rtol=1e-12)
        if of_rows is not None:
            assert np.array_equal(np.transpose(method(batch.T)), alone)
            assert np.array_equal(of_rows(batch), alone)
            assert np.array_equal(np.transpose([c.numpy() for c in method(torch.tensor(batch.T).unbind())]), alone)
            assert all(type(c) is float for c in alone[0])
    rates = system.rate(batch.T)
    assert rates.shape == (10,)
    assert np.allclose(rates, [system.rate(row) for row in batch.tolist()], rtol=1e-14)


def test_equations_are_the_published_ones():
    assert ReverseDuffing().f((2.0, 3.0)) == (27.0, -2.0)
    assert ReverseDuffing(a=2, b=5).f((2.0, 3.0)) == (54.0, -10.0)
    assert VanDerPol().f((2.0, 3.0)) == (3.0, -29.0)
    assert Rossler(a=1, b=2, c=3).f((4.0, 5.0, 6.0)) == (-11.0, 9.0, 8.0)
    assert Lorenz(sigma=2, rho=3, beta=4).f((5.0, 6.0, 7.0)) == (2.0, -26.0, 2.0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_rate_bounds_the_eigenvalues_and_the_target_is_an_equilibrium(variant):
    system = VARIANTS[variant]
    assert system.f(system.target) == pytest.approx([0.0] * system.nx, abs=1e-10)
    x, f = symbolic(system)
    jacobian = sympy.lambdify(x, f.jacobian(x))
    low, high = system.box(2)
    random = np.random.default_rng(1).uniform(low, high, (100, system.nx))
    grid = np.meshgrid(*([a, 0, (a + b) / 2, b] for a, b in zip(low, high, strict=True)))
    for point in (*random.tolist(), *np.reshape(grid, (system.nx, -1)).T.tolist(), system.target):
        fastest = np.abs(np.linalg.eigvals(np.array(jacobian(*point), float))).max()
        assert fastest <= system.rate(point) * (1 + 1e-9)


def test_default_rate_is_the_norm_of_the_jacobian():
    system, at = Lorenz(), (3.0, -4.0, 25.0)
    half = np.ptp(system.X, axis=1) / 2
    norm = np.linalg.norm(jacobian_at(system, at) * half / half[:, None])
    assert System.rate(system, at) == pytest.approx(norm, rel=1e-5)
    assert System.rate(system, np.array([at, at]).T) == pytest.approx([norm, norm], rel=1e-5)


def test_targets():
    with pytest.raises(ValueError, match=r"rho=0\.5"):
        _ = Lorenz(rho=0.5).target
    with pytest.raises(ValueError, match="a=10"):
        _ = Rossler(a=10, b=10).target
    system = Rossler()
    roots = np.roots([system.a, system.c, system.b])
    assert system.target[1] == pytest.approx(roots[np.abs(roots).argmin()])  # the equilibrium nearest to 0


@everyone
def test_get_system_takes_names_classes_and_instances(name):
    cls = SYSTEMS[name]
    assert get_system(name) == get_system(cls) == get_system(cls()) == get_system(f"kkl_gym.systems:{cls.__name__}")
    assert get_system(Lorenz(rho=10), {"beta": 2}) == Lorenz(rho=10, beta=2)


def test_get_system_from_a_script_or_a_module(script, monkeypatch):
    system = get_system(f"{script}:Pendulum", {"damping": 0.5})
    assert (system.name, system.nu, system.ny, system.parameters) == ("pendulum", 0, 1, {"damping": 0.5})
    assert system.scale == (3.0, 2.0)
    assert type(get_system(f"{script}:Pendulum")) is type(system)  # the script is loaded once
    monkeypatch.chdir(script.parent)
    assert type(get_system("pendulum_script.py:Pendulum")) is type(system)
    monkeypatch.syspath_prepend(script.parent)
    assert get_system("pendulum_script:Pendulum").name == "pendulum"
    sys.modules.pop("pendulum_script")
    with pytest.raises(ValueError, match="not a subclass of"):
        get_system(f"{script}:NoSystem")


@pytest.mark.parametrize("nonsense", ["nonsense", "no_such_module:Class", "kkl_gym:NoClass", "kkl_gym:__version__"])
def test_nonsense_names_raise_with_the_name(nonsense):
    with pytest.raises(ValueError, match=r"unknown system|cannot load|not a subclass") as raised:
        get_system(nonsense)
    assert repr(nonsense) in str(raised.value)
    if ":" not in nonsense:
        assert "reverse_duffing, van_der_pol, rossler, lorenz" in str(raised.value)
