"""Nonlinear systems x' = f(x) + g(x) u + w with a measured output y = h(x) + v.

Every equation is written once, on components, in plain arithmetic. The same method therefore takes Python
floats (fast single steps), NumPy arrays (batches), torch tensors (derivatives) and sympy symbols (formulas).
"""

# ruff: noqa: D102 - what each system overrides is documented on System

import importlib
import importlib.util
import inspect
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

Components = Sequence[Any] | np.ndarray  # one float, array, tensor or symbol for each component
Box = tuple[tuple[float, float], ...]  # (low, high) of each component


@dataclass(frozen=True)
class System:
    """A system; its physical parameters are the fields of a frozen dataclass, all of them floats.

    A subclass is decorated with ``@dataclass(frozen=True)``, sets the class variables below and defines
    :meth:`f` and :meth:`h`. See ``examples/own_system.py`` for a complete one.

    Class variables
    ---------------
    name : identifies the system in artifacts and error messages.
    state_names : names of the states with their units, for plots and documentation.
    X : training box, (low, high) of each state: where starts are drawn and observers are trained.
    bounds : declared bounds, (low, high) of each state: an episode ends where the state leaves them.
    u_max : bound of each input; the default, none, makes an autonomous system.
    G : constant input matrix, ``nx`` rows of ``nu`` numbers; override :meth:`g` where it depends on the state.
    scale : typical size of each state, for the reward and the process noise; default: the training box's half-width.
    process_noise : default bound of the process noise as a multiple of ``scale`` per second.
    """

    name: ClassVar[str]
    state_names: ClassVar[tuple[str, ...]] = ()
    X: ClassVar[Box]
    bounds: ClassVar[Box]
    u_max: ClassVar[tuple[float, ...]] = ()
    G: ClassVar[tuple[tuple[float, ...], ...]] = ()
    scale: ClassVar[tuple[float, ...]] = ()
    process_noise: ClassVar[float] = 0.05

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if not hasattr(cls, "X") or not hasattr(cls, "bounds") or not hasattr(cls, "name"):
            raise TypeError(f"{cls.__name__} must set the class variables name, X and bounds")
        nx, nu = len(cls.X), len(cls.u_max)
        if len(cls.bounds) != nx:
            raise TypeError(f"{cls.__name__}: X has {nx} states and bounds has {len(cls.bounds)}")
        for (low, high), (lower, upper) in zip(cls.X, cls.bounds, strict=True):
            if not (math.isfinite(lower) and math.isfinite(upper) and lower <= low < high <= upper):
                raise TypeError(f"{cls.__name__}: X = {cls.X} must lie within finite bounds = {cls.bounds}")
        if any(not 0 < u < math.inf for u in cls.u_max):
            raise TypeError(f"{cls.__name__}: u_max = {cls.u_max} must be positive and finite")
        if cls.g is System.g and nu and (len(cls.G) != nx or any(len(row) != nu for row in cls.G)):
            raise TypeError(f"{cls.__name__}: G = {cls.G} must have {nx} rows of {nu} numbers, or override g(x)")
        cls.scale = cls.scale or tuple((high - low) / 2 for low, high in cls.X)
        cls.state_names = cls.state_names or tuple(f"x{i + 1}" for i in range(nx))

    def __post_init__(self) -> None:
        for name, value in self.parameters.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"parameter {name} of {self.name} must be a finite number, got {value!r}")
            object.__setattr__(self, name, float(value))

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.X)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.u_max)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.h([0.0] * self.nx))

    @property
    def parameters(self) -> dict[str, float]:
        """The physical parameters by name."""
        return asdict(self)

    @property
    def target(self) -> tuple[float, ...]:
        """The equilibrium that a controller should hold, shape (nx,); default: the origin."""
        return (0.0,) * self.nx

    def f(self, x: Components) -> Components:
        """Drift: ``nx`` components of the state in, ``nx`` components of f(x) out."""
        raise NotImplementedError(f"{type(self).__name__} does not define f")

    def g(self, x: Components) -> Sequence[Components]:
        """Input matrix g(x): ``nx`` rows of ``nu`` entries; default: the constant ``G``."""
        return self.G or ((),) * self.nx

    def h(self, x: Components) -> Components:
        """Output map: ``ny`` components of h(x)."""
        raise NotImplementedError(f"{type(self).__name__} does not define h")

    def rate(self, x: Components) -> Any:
        """How fast f changes along its motion, in 1/s: a norm of df/dx, from which the substeps follow.

        The default differentiates f numerically; override it with a formula where single steps must be fast.
        """
        fx, eps = self.f(x), 1e-6
        total = 0.0
        for j in range(self.nx):
            moved = [*x[:j], x[j] + eps, *x[j + 1 :]]
            total = total + sum(((b - a) / eps) ** 2 for a, b in zip(fx, self.f(moved), strict=True))
        return total**0.5

    def box(self, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner, each (nx,), of the training box multiplied by ``factor``."""
        low, high = np.array(self.X).T * factor
        return low, high

    def replace(self, parameters: Mapping[str, float]) -> "System":
        """The same system with some parameters changed; raises ValueError on an unknown name."""
        known = self.parameters
        for name in parameters:
            if name not in known:
                raise ValueError(f"{self.name} has no parameter {name!r}; it has {', '.join(known) or 'none'}")
        return type(self)(**{**known, **parameters})


@dataclass(frozen=True)
class ReverseDuffing(System):
    """Reverse Duffing oscillator (paper, sec. 8, eq. rev_duff), y = x1, input on x2.

    x1' = x2^3, x2' = -x1 + u. Conservative without input: x2^4/4 + x1^2/2 is constant, so motions are periodic,
    with a period that grows as they shrink. Dimensionless; the origin is a degenerate equilibrium whose
    linearisation cannot be stabilised.
    """

    name: ClassVar[str] = "reverse_duffing"
    X: ClassVar[Box] = ((-2, 2), (-2, 2))
    bounds: ClassVar[Box] = ((-20, 20), (-7, 7))
    u_max: ClassVar[tuple[float, ...]] = (1.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,))
    scale: ClassVar[tuple[float, ...]] = (2.0, 1.5)

    def f(self, x: Components) -> Components:
        x1, x2 = x
        return x2 * x2 * x2, -x1

    def h(self, x: Components) -> Components:
        return (x[0],)

    def rate(self, x: Components) -> Any:
        return 1.0 + 2.0 * abs(x[1])  # above sqrt(3) |x2|, the frequency of the linearised motion


@dataclass(frozen=True)
class VanDerPol(System):
    """Van der Pol oscillator (paper, sec. 8, eq. vdp), y = x1, input on x2.

    x1' = x2, x2' = mu (1 - x1^2) x2 - x1 + u. Dimensionless; the origin is unstable and every other motion tends
    to the limit cycle. Stiff far from it: d(x2')/d(x2) = -297 at x1 = 10.
    """

    mu: float = 3.0

    name: ClassVar[str] = "van_der_pol"
    X: ClassVar[Box] = ((-5, 5), (-8, 8))
    bounds: ClassVar[Box] = ((-12, 12), (-30, 30))
    u_max: ClassVar[tuple[float, ...]] = (5.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,))
    scale: ClassVar[tuple[float, ...]] = (2.0, 4.0)

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
    Some starts outside the training box escape to infinity. The target is the inner equilibrium, which no static
    gain on y stabilises through this input.
    """

    a: float = 0.2
    b: float = 0.2
    c: float = 5.7

    name: ClassVar[str] = "rossler"
    X: ClassVar[Box] = ((-10, 10), (-10, 10), (0, 20))
    bounds: ClassVar[Box] = ((-50, 50), (-70, 70), (-5, 500))
    u_max: ClassVar[tuple[float, ...]] = (2.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((1.0,), (0.0,), (0.0,))
    scale: ClassVar[tuple[float, ...]] = (8.0, 8.0, 10.0)

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
        # x1 = -a x2, x3 = -x2 and a x2^2 + c x2 + b = 0; the root near zero is the inner equilibrium.
        discriminant = self.c**2 - 4 * self.a * self.b
        if discriminant < 0 or self.c <= 0:
            raise ValueError(f"no inner equilibrium at a={self.a}, b={self.b}, c={self.c}: need c > 0, c^2 >= 4ab")
        x2 = -2 * self.b / (self.c + math.sqrt(discriminant))
        return (-self.a * x2, x2, -x2)


@dataclass(frozen=True)
class Lorenz(System):
    """Lorenz's system (paper, sec. 8, eq. lorenz; E. N. Lorenz, J. Atmos. Sci. 20, 1963), y = x2, input on x2.

    x1' = sigma (x2 - x1), x2' = x1 (rho - x3) - x2 + u, x3' = x1 x2 - beta x3. Dimensionless; chaotic at the default
    parameters. The paper prints the first two parameters swapped (p = 28, q = 10), with which the motion settles on
    an equilibrium; ``Lorenz(sigma=28, rho=10)`` is that system. The target is the equilibrium C+.
    """

    sigma: float = 10.0
    rho: float = 28.0
    beta: float = 8.0 / 3.0

    name: ClassVar[str] = "lorenz"
    X: ClassVar[Box] = ((-20, 20), (-30, 30), (0, 50))
    bounds: ClassVar[Box] = ((-60, 60), (-120, 120), (-50, 160))
    u_max: ClassVar[tuple[float, ...]] = (10.0,)
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,), (0.0,))
    scale: ClassVar[tuple[float, ...]] = (15.0, 18.0, 20.0)

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
    """The system named by ``system``, with ``parameters`` changed from their defaults.

    Parameters
    ----------
    system : a shipped name (``"van_der_pol"``), a class of the user's as ``"package.module:Class"`` or
        ``"path/to/script.py:Class"``, or a :class:`System` (class or instance) itself.
    parameters : physical parameters by name.

    Raises
    ------
    ValueError : if the name is unknown, the class cannot be found, or a parameter is unknown or not finite.
    """
    if isinstance(system, str):
        system = _find(system)
    if isinstance(system, type) and issubclass(system, System):
        system = system()
    if not isinstance(system, System):
        raise ValueError(f"expected a system or the name of one, got {system!r}")
    return system.replace(parameters or {})


def _find(name: str) -> type[System]:
    if name in SYSTEMS:
        return SYSTEMS[name]
    where, colon, class_name = name.rpartition(":")
    if not colon:
        raise ValueError(
            f"unknown system {name!r}; shipped: {', '.join(SYSTEMS)}; your own: 'module:Class' or 'script.py:Class'"
        )
    try:
        found = getattr(_module(where), class_name)
    except (ImportError, AttributeError, OSError) as error:
        raise ValueError(f"cannot load the system {name!r}: {error}") from error
    if not (inspect.isclass(found) and issubclass(found, System) and found is not System):
        raise ValueError(f"{name!r} is {found!r}, not a subclass of kkl_gym.System")
    return found


def _module(where: str) -> Any:
    if not where.endswith(".py"):
        if not where or where.startswith("."):
            raise ImportError(f"{where!r} is no absolute module name")
        return importlib.import_module(where)
    path = Path(where).resolve()
    key = f"kkl_gym user script {path}"
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, path)
        if spec is None or spec.loader is None or not path.is_file():
            raise ImportError(f"no file {where}")
        sys.modules[key] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[key])
        except BaseException:
            del sys.modules[key]
            raise
    return sys.modules[key]


__all__ = ["SYSTEMS", "Lorenz", "ReverseDuffing", "Rossler", "System", "VanDerPol", "get_system"]
