"""The base class of systems: x' = f(x) + g(x) u + w with a measured output y = h(x) + v.

Every equation is written once, on components, in plain arithmetic. The same method therefore takes Python
floats (fast single steps), NumPy arrays (batches), torch tensors (derivatives) and sympy symbols (formulas).
"""

import functools
import inspect
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from kkl_gym.declarations import complete
from kkl_gym.equations import components, rate_at, target_of
from kkl_gym.loading import load_class
from observers.checks import is_finite, mapping, shown

Components = Sequence[Any] | np.ndarray  # one float, array, tensor or symbol for each component
Box = tuple[tuple[float, float], ...]  # (low, high) of each component

DT = 0.01  # s, the default sampling interval where it suits a system's rate
# Each pair is (limit of rate * DT, target of rate * dt). Between the two limits the default dt is DT. Beyond a limit it
# is the target divided by the rate, rounded down to 1, 2 or 5 times a power of ten.
SHORT_STEP, LONG_STEP = (0.002, 0.02), (5.0, 1.0)
PROCESS_NOISE = 0.05  # default bound, in multiples of a system's scale per time unit (``pace``)
NOISE_SHARE = 0.05  # default measurement noise as a share of an output's range
# Attributes of a class with an empty body; Python 3.13 adds the last two.
EMPTY = {"__module__", "__qualname__", "__doc__", "__firstlineno__", "__static_attributes__"}


@dataclass(frozen=True)
class System:
    """A system; its physical parameters are the fields of a frozen dataclass, all of them floats.

    A subclass is decorated with ``@dataclass(frozen=True)``, sets the class variables below and defines
    :meth:`f` and :meth:`h`. See ``examples/own_system.py`` for a complete one. Any units will do: only the size of a
    state relative to ``X`` matters.

    Parameters
    ----------
    **parameters : float
        Physical parameters, by the names that the subclass gives them.

    Attributes
    ----------
    name : str
        Identifies the system in artifacts and error messages.
    state_names : tuple of str, length nx
        Names of the states with their units, for plots and documentation. The default is x1, x2, ...
    X : tuple of (float, float), length nx
        Training box, (low, high) of each state: starts are drawn in it, and observers are trained on it.
    X_centre : tuple of float, length nx
        The centre of multiples of X, such as 2X. The default is the middle of X.
    bounds : tuple of (float, float), length nx
        Declared bounds, (low, high) of each state: an episode ends where the state leaves them.
    u_max : tuple of float, length nu
        Bound of each input. The default is an empty tuple, for an autonomous system.
    G : tuple of tuple of float, shape (nx, nu)
        Constant input matrix. Override :meth:`g` where it depends on the state.
    scale : tuple of float, length nx
        Typical size of each state, for the reward and the process noise. The default is the training box's half-width.
    portrait : (int, int)
        The two states that a phase portrait shows, by index. The default is the first and the last.
    process_noise : float
        Default bound of the process noise as a multiple of ``scale`` per second. If it is not set, it is 0.05 divided
        by the system's :attr:`pace`.
    measurement_noise : float or tuple of float, length ny
        Default standard deviation of the measurement noise, one for all outputs or one for each. If it is not set, it
        is 5 % of the range of each output over X.
    dt : float
        Default sampling interval in seconds. If it is not set, it is 0.01 s where that suits the system's rate, and
        otherwise follows from the rate.

    Raises
    ------
    TypeError
        When the subclass is defined, if a class variable is missing or does not fit the others. When an instance is
        made, if the subclass has parameters and lacks ``@dataclass(frozen=True)``.
    ValueError
        If a parameter is not a finite number.
    """

    name: ClassVar[str]
    state_names: ClassVar[tuple[str, ...]] = ()
    X: ClassVar[Box]
    X_centre: ClassVar[tuple[float, ...]] = ()
    bounds: ClassVar[Box]
    u_max: ClassVar[tuple[float, ...]] = ()
    G: ClassVar[tuple[tuple[float, ...], ...]] = ()
    scale: ClassVar[tuple[float, ...]] = ()
    portrait: ClassVar[tuple[int, int]] = (0, -1)
    discrete: ClassVar[bool] = False  # whether the subclass defines step

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # An empty class is left alone: cloudpickle makes one, and then sets attributes that are already complete.
        if not vars(cls).keys() <= EMPTY:
            complete(cls, System)

    def __post_init__(self) -> None:
        if "discrete" not in vars(type(self)):
            complete(type(self), System)
        own = vars(type(self)).get("__dataclass_fields__", {})
        for name, kind in inspect.get_annotations(type(self)).items():
            if name not in own and "ClassVar" not in str(kind):
                raise TypeError(f"{type(self).__name__} has a parameter {name}, but lacks @dataclass(frozen=True)")
        for name, value in self.parameters.items():
            if not is_finite(value):
                raise ValueError(f"parameter {name} of {self.name} must be a finite number, got {shown(value)}")
            object.__setattr__(self, name, float(value))

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # Another process finds a class in a user's script by the script's path.
        script = getattr(sys.modules.get(type(self).__module__), "__kkl_gym_script__", None)
        return _restored, (f"{script}:{type(self).__qualname__}" if script else type(self), self.parameters)

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
        return len(components(self.h, inner_state(self)))

    @property
    def parameters(self) -> dict[str, float]:
        """The physical parameters by name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    @property
    def target(self) -> tuple[float, ...]:
        """The equilibrium that a controller should hold, nx numbers; default: the origin."""
        return (0.0,) * self.nx

    @property
    def dt(self) -> float:
        """Default sampling interval of environments and observers, in seconds.

        It is 0.01 s, unless that is far too long or too short for the rate at which f changes. A class variable of this
        name overrides it.
        """
        try:
            rate = self.typical_rate
        except ValueError:  # the rate cannot be computed, or is 0 (an integrator, which any interval suits)
            return DT
        (least, slow), (most, fast) = SHORT_STEP, LONG_STEP
        if least <= rate * DT <= most:
            return DT
        longest = (slow if rate * DT < least else fast) / rate
        power = 10.0 ** math.floor(math.log10(longest))
        return max(m * power for m in (1.0, 2.0, 5.0) if m * power <= longest)

    @property
    def pace(self) -> float:
        """Time unit of this system in seconds, 100 sampling intervals; the shipped systems have 1 s."""
        return 100.0 * self.dt

    @property
    def duration(self) -> float:
        """Default duration of motions in training and evaluation, in seconds."""
        return 50.0 * self.pace

    @property
    def process_noise(self) -> float:
        """Default bound of the process noise, in multiples of ``scale`` per second."""
        return PROCESS_NOISE / self.pace

    @property
    def measurement_noise(self) -> float | tuple[float, ...]:
        """Default standard deviation of the measurement noise, one for all outputs or one for each."""
        levels = tuple(float(f"{NOISE_SHARE * size:.2g}") for size in self.output_range)
        return levels[0] if len(set(levels)) == 1 else levels

    @functools.cached_property
    def output_range(self) -> tuple[float, ...]:
        """Range of each noise-free output over a thousand starts, length ny; 1 for a constant output."""
        size = np.ptp(self.output(_starts(self)), axis=0)
        return tuple(np.where(size > 0, size, 1.0).tolist())

    @functools.cached_property
    def typical_rate(self) -> float:
        """Median rate of f(x) + g(x) u in 1/s at 1,000 starts, for the largest input; ValueError if 0 or not finite."""
        return typical_rate(self, _starts(self))

    def f(self, x: Components) -> Components:
        """Drift f(x): nx components, from the nx components of ``x``.

        Components of ``x`` are floats, arrays, tensors or symbols. Returned components are numbers, or of the same type
        as those of ``x``. Every subclass defines this method or :meth:`step`.
        """
        if not self.discrete:
            raise NotImplementedError(f"{type(self).__name__} does not define f")
        moved = self.step(x, (0.0,) * self.nu)
        return [(after - before) / self.dt for before, after in zip(x, moved, strict=True)]

    def step(self, x: Components, u: Components) -> Components:
        """Return the next state of a system in discrete time, a sampling interval after x, under the held input u.

        A system with this method needs no f and g, must set ``dt``, and is not integrated. Process noise adds w dt to
        the next state. f is then the mean derivative over an interval in which the input is 0. Components are as for
        :meth:`f`.
        """
        raise NotImplementedError(f"{type(self).__name__} is integrated from f; it defines no step")

    def draw_starts(self, rng: np.random.Generator, n: int, factor: float = 1.0) -> np.ndarray:
        """Draw ``n`` starts, (n, nx), within ``factor`` times X; default: uniform in that box.

        Override it where not every point of X is a state, as for an angle given by its cosine and sine; such a system
        also sets ``process_noise = 0.0``, because noise would make x invalid. Starts must lie within the bounds.
        """
        return rng.uniform(*self.box(factor), (n, self.nx))

    def g(self, x: Components) -> Sequence[Components]:
        """Input matrix g(x): nx rows of nu entries, from components as for :meth:`f`. The default is ``G``."""
        return self.G or ((),) * self.nx

    def h(self, x: Components) -> Components:
        """Output map h(x): ny components, from components as for :meth:`f`. Every subclass defines it."""
        raise NotImplementedError(f"{type(self).__name__} does not define h")

    def reward(self, x: Components, u: Components) -> Any:
        """Reward that environments return for a sampling interval; default: 1 at :attr:`target`, and less elsewhere.

        The default is 1 / (1 + 4 c) with c = mean(((x - target) / scale)^2). A system that overrides this method or
        :meth:`terminated` defines its own task, and ``kkl-gym agent train`` trains agents for it.

        Parameters
        ----------
        x : sequence of length nx
            Components of the state at the end of the interval: floats or arrays.
        u : sequence of length nu
            Components of the physical input that acted.

        Returns
        -------
        float, or the type of the components of ``x``
            The reward.
        """
        return nearness(goal_of(self), x, u)

    def terminated(self, x: Components) -> Any:
        """Whether an episode ends at x, with components as for :meth:`f`. Beyond ``bounds`` it ends in any case."""
        return False

    @property
    def states_task(self) -> bool:
        """Whether the system defines its own reward or its own end of episodes."""
        return type(self).reward is not System.reward or type(self).terminated is not System.terminated

    def output(self, x: np.ndarray) -> np.ndarray:
        """Noise-free outputs h(x) of many states. Shapes: ``x`` (..., nx); returns (..., ny)."""
        return on_states(self.h, x)

    def drift(self, x: np.ndarray) -> np.ndarray:
        """Drift f(x) of many states, without input and noise. Shapes: ``x`` (..., nx); returns (..., nx)."""
        return on_states(self.f, x)

    def rate(self, x: Components) -> Any:
        """How fast f changes along a motion, in 1/s: a norm of df/dx. The default ``dt`` follows from it.

        By default it is a numerical derivative, with each state in units of X's half-width, so that the rate does not
        depend on the user's units. An estimate of the integration error then sets the number of substeps. If a subclass
        overrides this method, its rate sets that number: a substep lasts at most 0.4 / rate. Override it if f jumps.
        """
        return slope(self.f, x, self.X)

    def box(self, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner, (nx,), of ``factor`` times the training box about ``X_centre``, cut at the bounds."""
        low, high = np.array(self.X, dtype=float).T
        if factor != 1:
            centre, (lowest, highest) = np.array(self.X_centre), np.array(self.bounds, dtype=float).T
            low = np.maximum(centre + factor * (low - centre), lowest)
            high = np.minimum(centre + factor * (high - centre), highest)
        return low, high

    def replace(self, parameters: Mapping[str, float]) -> "System":
        """Return a copy with some parameters changed; ValueError if a name is unknown or a value is not finite."""
        known = self.parameters
        parameters = mapping("parameters", parameters)
        for name in parameters:
            if name not in known:
                raise ValueError(f"{self.name} has no parameter {shown(name)}; it has {', '.join(known) or 'none'}")
        return type(self)(**{**known, **parameters})


def goal_of(system: System) -> list[tuple[float, float]]:
    """Return nx pairs for the default reward: each state's target, and the weight of its squared distance."""
    return [(t, 1.0 / (system.nx * size * size)) for t, size in zip(target_of(system), system.scale, strict=True)]


def nearness(goal: Iterable[tuple[float, float]], x: Components, u: Components) -> Any:
    """Return the default reward, as :meth:`System.reward` defines it."""
    cost = 0.0
    for xi, (target, weight) in zip(x, goal):
        cost = cost + weight * ((xi - target) * (xi - target))
    return 1.0 / (1.0 + 4.0 * cost)


def nearness_of_rows(target: np.ndarray, weight: np.ndarray, x: np.ndarray, u: Components) -> np.ndarray:
    """Return the default reward of a batch. Shapes: ``target`` and ``weight`` (nx,), ``x`` (nx, n)."""
    deviation = x - target[:, None]
    deviation *= deviation
    return 1.0 / (1.0 + 4.0 * (weight @ deviation))


def reward_of(system: System, *, rows: bool = False) -> Callable[[Any, Components], Any]:
    """Return the reward function for one state or for a batch; the default reward reads the target only once, here."""
    if type(system).reward is not System.reward:
        return system.reward
    goal = goal_of(system)
    return functools.partial(nearness_of_rows, *np.array(goal).T) if rows else functools.partial(nearness, goal)


def on_states(equations: Callable[[Components], Components], x: np.ndarray) -> np.ndarray:
    """Evaluate f or h on an array of states instead of components. Shapes: ``x`` (..., nx); returns (..., m)."""
    values = components(equations, np.moveaxis(x, -1, 0))
    return np.stack([np.broadcast_to(value, x.shape[:-1]) for value in values], axis=-1)


def inner_state(system: System) -> tuple[float, ...]:
    """Return a state in X for a first call of the equations: not the centre, where some equations divide by zero."""
    return tuple(low + (high - low) * ((0.5 + 0.618 * i) % 1.0) for i, (low, high) in enumerate(system.X, 1))


def _starts(system: System) -> np.ndarray:
    """Draw a thousand starts (1000, nx), the same at every call."""
    return system.draw_starts(np.random.default_rng(0), 1000)


def dot(row: Iterable[Any], u: Components) -> Any:
    """Return a row of the input matrix times u. Shapes: ``row``, ``u`` of length nu."""
    total = 0.0  # not sum(), which rounds in another way from Python 3.12 on
    for gij, uj in zip(row, u, strict=True):
        total = total + gij * uj
    return total


def slope(field: Callable[[Any], Components], x: Components, X: Box) -> Any:
    """Return a norm of a vector field's numerical derivative, with states in units of X's half-widths."""
    units = [5e-7 * (high - low) for low, high in X]  # a millionth of the half-widths
    fx, total = field(x), 0.0
    for j, unit in enumerate(units):
        # The step is larger where X lies so far from 0 that floats hardly resolve a millionth of its half-width.
        step = max(unit, 2e-8 * max(map(abs, X[j])))
        moved = field([*x[:j], x[j] + step, *x[j + 1 :]])
        ratios = ((b - a) / other * (unit / step) for a, b, other in zip(fx, moved, units, strict=True))
        total = total + sum(ratio**2 for ratio in ratios)
    return total**0.5


def rate_under(system: System, x: Components, u: Components) -> Any:
    """Return the rate of f(x) + g(x) u for a held u, in 1/s; ``rate(x)`` if g is constant or ``rate`` is overridden."""
    if type(system).g is System.g or type(system).rate is not System.rate:
        return system.rate(x)
    return slope(lambda x: [fi + dot(row, u) for fi, row in zip(system.f(x), system.g(x), strict=True)], x, system.X)


def typical_rate(system: System, starts: np.ndarray) -> float:
    """Return the median rate of f(x) + g(x) u over ``starts`` (n, nx), under the largest input."""
    rate_at(system, starts.T)  # raises an EquationError if ``rate`` fails
    rate = float(np.median(np.broadcast_to(rate_under(system, starts.T, system.u_max), len(starts))))
    if not 0 < rate < math.inf:
        raise ValueError(f"{system.name}.rate(x) is {rate} in X: override it by a formula for how fast f changes")
    return rate


def _restored(kind: "type[System] | str", parameters: Mapping[str, float]) -> System:
    """Rebuild a pickled system from its class, or from ``script.py:Class``."""
    return (load_class(kind, System) if isinstance(kind, str) else kind)(**parameters)
