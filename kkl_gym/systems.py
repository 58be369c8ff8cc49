"""Equations of the four benchmark systems of the paper (docs/background/paper.md), and their lookup by name."""

# ruff: noqa: D102 - System documents the methods that each system overrides

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, ClassVar

from kkl_gym.equations import check_equations
from kkl_gym.loading import load_class
from kkl_gym.system import Box, Components, System
from observers.checks import mapping, shown
from observers.names import matching, suggestion


@dataclass(frozen=True)
class ReverseDuffing(System):
    """Reverse Duffing oscillator (paper, sec. 8, eq. rev_duff), y = x1, input on x2.

    x1' = a x2^3, x2' = -b x1 + u. If u = 0, a x2^4/4 + b x1^2/2 is constant, so motions are periodic; small ones
    have long periods. All quantities are dimensionless. The origin is a degenerate equilibrium whose linearisation
    cannot be stabilised. The paper has no parameters; a = b = 1 is its system.

    Parameters
    ----------
    a : float
        How fast x2 drives x1.
    b : float
        How fast x1 drives x2 back.
    """

    a: float = 1.0
    b: float = 1.0

    name: ClassVar[str] = "reverse_duffing"
    X: ClassVar[Box] = ((-2, 2), (-2, 2))
    bounds: ClassVar[Box] = ((-20, 20), (-7, 7))
    u_max: ClassVar[tuple[float, ...]] = (1.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,))
    scale: ClassVar[tuple[float, ...]] = (2.0, 1.5)
    dt: ClassVar[float] = 0.01
    measurement_noise: ClassVar[float] = 0.5

    def f(self, x: Components) -> Components:
        x1, x2 = x
        return self.a * (x2 * x2 * x2), -self.b * x1  # at a = b = 1 equal to the paper's equations to the last bit

    def h(self, x: Components) -> Components:
        return (x[0],)

    def rate(self, x: Components) -> Any:
        # The linearised motion's frequency is sqrt(3 a b) |x2|; the result bounds it. Motions speed up as sqrt(a b).
        return math.sqrt(abs(self.a * self.b)) * (1.0 + 2.0 * abs(x[1]))


@dataclass(frozen=True)
class VanDerPol(System):
    """Van der Pol oscillator (paper, sec. 8, eq. vdp), y = x1, input on x2.

    x1' = x2, x2' = mu (1 - x1^2) x2 - x1 + u. Dimensionless; the origin is unstable, and motions from all other
    states tend to the limit cycle. Far from the limit cycle the system is stiff: d(x2')/d(x2) = -297 at x1 = 10.

    Parameters
    ----------
    mu : float
        Strength of the damping, which is negative where x1^2 < 1.
    """

    mu: float = 3.0

    name: ClassVar[str] = "van_der_pol"
    X: ClassVar[Box] = ((-5, 5), (-8, 8))
    bounds: ClassVar[Box] = ((-12, 12), (-30, 30))
    u_max: ClassVar[tuple[float, ...]] = (5.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,))
    scale: ClassVar[tuple[float, ...]] = (2.0, 4.0)
    dt: ClassVar[float] = 0.01
    measurement_noise: ClassVar[float] = 0.5

    def f(self, x: Components) -> Components:
        x1, x2 = x
        return x2, self.mu * (1.0 - x1 * x1) * x2 - x1

    def h(self, x: Components) -> Components:
        return (x[0],)

    def rate(self, x: Components) -> Any:
        x1, x2 = x
        return 1.0 + abs(self.mu * (1.0 - x1 * x1)) + 2.0 * abs(self.mu * x1 * x2) ** 0.5


@dataclass(frozen=True)
class Rossler(System):
    """Rössler's system (paper, sec. 8, eq. ross; O. E. Rössler, Phys. Lett. A 57, 1976), y = x2, input on x1.

    x1' = -x2 - x3 + u, x2' = x1 + a x2, x3' = b + x3 (x1 - c). Dimensionless; chaotic at the default parameters.
    Motions from some starts outside the training box escape to infinity. The target is the inner equilibrium. No static
    gain from y to this input stabilises the target.

    Parameters
    ----------
    a : float
        Growth rate of x2.
    b : float
        Constant part of x3'.
    c : float
        Value of x1 above which x3 grows.
    """

    a: float = 0.2
    b: float = 0.2
    c: float = 5.7

    name: ClassVar[str] = "rossler"
    X: ClassVar[Box] = ((-10, 10), (-10, 10), (0, 20))
    # Multiples of X are centred at the origin, because the paper multiplies the corners of the box.
    X_centre: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)
    bounds: ClassVar[Box] = ((-50, 50), (-70, 70), (-5, 500))
    u_max: ClassVar[tuple[float, ...]] = (2.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((1.0,), (0.0,), (0.0,))
    scale: ClassVar[tuple[float, ...]] = (8.0, 8.0, 10.0)
    dt: ClassVar[float] = 0.01
    measurement_noise: ClassVar[float] = 0.5
    portrait: ClassVar[tuple[int, int]] = (0, 1)

    def f(self, x: Components) -> Components:
        x1, x2, x3 = x
        return -x2 - x3, x1 + self.a * x2, self.b + x3 * (x1 - self.c)

    def h(self, x: Components) -> Components:
        return (x[1],)

    def rate(self, x: Components) -> Any:
        x1, _, x3 = x
        return 1.3 + abs(self.a) + abs(x1 - self.c) + abs(x3) ** 0.5

    @property
    def target(self) -> tuple[float, ...]:
        # At equilibria x1 = -a x2, x3 = -x2 and a x2^2 + c x2 + b = 0; the root near zero gives the inner equilibrium.
        discriminant = self.c**2 - 4 * self.a * self.b
        if discriminant < 0 or self.c <= 0:
            raise ValueError(f"no inner equilibrium at a={self.a}, b={self.b}, c={self.c}: need c > 0, c^2 >= 4ab")
        x2 = -2 * self.b / (self.c + math.sqrt(discriminant))
        return (-self.a * x2, x2, -x2)


@dataclass(frozen=True)
class Lorenz(System):
    """Lorenz's system (paper, sec. 8, eq. lorenz; E. N. Lorenz, J. Atmos. Sci. 20, 1963), y = x2, input on x2.

    x1' = sigma (x2 - x1), x2' = x1 (rho - x3) - x2 + u, x3' = x1 x2 - beta x3. Dimensionless; chaotic at the default
    parameters. The paper prints the first two parameters swapped (p = 28, q = 10). With these, which are
    ``Lorenz(sigma=28, rho=10)``, motions settle on an equilibrium. The target is the equilibrium C+.

    Parameters
    ----------
    sigma : float
        Prandtl number.
    rho : float
        Ratio of the Rayleigh number to its critical value.
    beta : float
        Geometric factor of the convection cells.
    """

    sigma: float = 10.0
    rho: float = 28.0
    beta: float = 8.0 / 3.0

    name: ClassVar[str] = "lorenz"
    X: ClassVar[Box] = ((-20, 20), (-30, 30), (0, 50))
    X_centre: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)  # the origin, as for Rössler
    bounds: ClassVar[Box] = ((-60, 60), (-120, 120), (-50, 160))
    u_max: ClassVar[tuple[float, ...]] = (10.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,), (0.0,))
    scale: ClassVar[tuple[float, ...]] = (15.0, 18.0, 20.0)
    dt: ClassVar[float] = 0.01
    measurement_noise: ClassVar[float] = 0.5

    def f(self, x: Components) -> Components:
        x1, x2, x3 = x
        return self.sigma * (x2 - x1), x1 * (self.rho - x3) - x2, x1 * x2 - self.beta * x3

    def h(self, x: Components) -> Components:
        return (x[1],)

    def rate(self, x: Components) -> Any:
        x1, _, x3 = x
        return max(abs(self.sigma), abs(self.beta)) + abs(x1) + abs(self.sigma * (self.rho - x3)) ** 0.5

    @property
    def target(self) -> tuple[float, ...]:
        if self.rho <= 1 or self.beta <= 0:
            raise ValueError(f"C+ exists for rho > 1 and beta > 0 only, got rho={self.rho}, beta={self.beta}")
        x1 = math.sqrt(self.beta * (self.rho - 1))
        return (x1, x1, self.rho - 1)


SYSTEMS: dict[str, type[System]] = {cls.name: cls for cls in (ReverseDuffing, VanDerPol, Rossler, Lorenz)}


def get_system(system: "str | System | type[System]", parameters: Mapping[str, float] | None = None) -> System:
    """Return a system, given by name, class or instance, with the given ``parameters`` changed.

    Parameters
    ----------
    system : str, System or type of System
        A shipped name (``"van_der_pol"``, ``"VanDerPol"`` or ``"KKLVanDerPol-v0"``), a user's class as
        ``"package.module:Class"`` or ``"path/to/script.py:Class"``, a script that defines one system, or a
        :class:`System` (class or instance) itself.
    parameters : mapping of str to float, optional
        Physical parameters by name.

    Returns
    -------
    System
        An instance with these parameters.

    Raises
    ------
    ValueError
        If the name is unknown, the class cannot be found, or a parameter is unknown or not finite.
    EquationError
        If a user's equations fail or do not return components.
    """
    if isinstance(system, str):
        system = _find(system)
    if isinstance(system, type) and issubclass(system, System):
        missing = [field.name for field in fields(system) if field.default is MISSING]
        if missing:
            raise ValueError(
                f"{system.__name__} has no default for {', '.join(missing)}: give one, or pass an instance"
            )
        try:
            system = system()
        except TypeError as error:  # the class lacks @dataclass
            raise ValueError(str(error)) from error
    if not isinstance(system, System) or type(system) is System:
        hint = "; in the JSON of a specification write it as 'script.py:Class'" if isinstance(system, Mapping) else ""
        raise ValueError(f"the system must be a name or a kkl_gym.System, got {shown(system)}{hint}")
    found = system.replace(mapping("parameters", parameters))
    if type(found) not in SYSTEMS.values():
        check_equations(found)
    return found


def _find(name: str) -> type[System]:
    if ":" in name or name.endswith(".py"):
        return load_class(name, System)
    if (known := matching(name, SYSTEMS)) is None:
        raise ValueError(
            f"unknown system {shown(name)}{suggestion(name, SYSTEMS)}; shipped: {', '.join(SYSTEMS)}; your own: "
            "'module:Class' or 'script.py:Class'"
        )
    return SYSTEMS[known]


__all__ = ["SYSTEMS", "Lorenz", "ReverseDuffing", "Rossler", "System", "VanDerPol", "get_system"]
