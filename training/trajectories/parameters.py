"""A system's parameters as further states, which do not move."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from kkl_gym.equations import input_matrix
from kkl_gym.system import Box, Components, System
from observers.checks import shown
from training.trajectories.policies import Controller

# Of motions in training with one uncertain parameter, the share that has its own value; with more, the power of their
# number, for it is the less likely that all are as said. Chosen on the four systems that ship: at 0.6 and a width of
# 256 Lorenz's map no longer distinguished its own plant from the others.
NOMINAL_SHARE = 2 / 3
STILL = 1e-12  # scale of a parameter's process noise, of which there is to be none
EVERY = "all"  # in the place of a parameter's name
MAX_BIAS = 10.0  # of an output's range in X, far more than a network of its scale resolves
ROOM = 1e6  # half-widths of its range that a parameter may lie from the middle

Ranges = Mapping[str, tuple[float, float]]


def relative_ranges(system: System, half_widths: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Ranges about the values that a system's parameters have; half-widths are parts of these values."""
    known = system.parameters
    for name in half_widths:
        if name not in known and name != EVERY:
            raise ValueError(
                f"{system.name} has no parameter {shown(name)} to be uncertain; it has {', '.join(known) or 'none'}"
            )
    if half_widths and not known:
        raise ValueError(f"{system.name} has no parameters that could be uncertain")
    widths = {name: half_widths.get(name, half_widths.get(EVERY, 0.0)) for name in known}
    ranges = {}
    for name, width in widths.items():
        value = known[name]
        if width and not value:
            raise ValueError(
                f"the parameter {name} of {system.name} is 0, which has no relative range: leave it out, {name}=0"
            )
        if width:
            ranges[name] = (value - width * abs(value), value + width * abs(value))
    return ranges


def nominal_share(ranges: Ranges) -> float:
    """Share of the motions in training that have the system's own parameters."""
    return NOMINAL_SHARE ** len(ranges)


def with_parameters(system: System, ranges: Ranges, *, in_training: bool = False) -> System:
    """A system whose states are x and then some of its parameters, with derivative zero.

    An observer of such a system estimates parameters, a motion of it has parameters of its own, and derivatives by its
    states are derivatives by parameters as well.

    In training some motions have the system's own parameters, which are the likeliest: two in three where one parameter
    is uncertain. In the others parameters lie more often near the ends of their ranges, where plants are hardest to
    serve.
    """
    for name, limits in ranges.items():
        if name not in system.parameters:
            raise ValueError(
                f"{system.name} has no parameter {shown(name)}; it has {', '.join(system.parameters) or 'none'}"
            )
        if not limits[0] < limits[1]:
            raise ValueError(f"the range of {name} must go from low to high, got {shown(limits)}")
    if not ranges:
        return system
    nx, names, own = system.nx, tuple(ranges), [getattr(system, name) for name in ranges]
    limits_of = [(float(low), float(high)) for low, high in ranges.values()]
    middles = [(low + high) / 2 for low, high in limits_of]
    still = ((0.0,) * system.nu,) * len(names)
    constant = bool(system.nu) and type(system).g is System.g and not system.discrete

    def model(x: Components) -> System:
        changed = object.__new__(type(system))  # past the class's own check, which asks for floats
        changed.__dict__.update(system.__dict__, **dict(zip(names, x[nx:], strict=True)))
        return changed

    class WithParameters(System):
        name = system.name
        state_names: ClassVar[tuple[str, ...]] = (*system.state_names, *names)
        X: ClassVar[Box] = (*system.X, *limits_of)
        X_centre: ClassVar[tuple[float, ...]] = (*system.X_centre, *middles)
        bounds: ClassVar[Box] = (
            *system.bounds,
            *((mid - ROOM * (b - a), mid + ROOM * (b - a)) for mid, (a, b) in zip(middles, limits_of)),
        )
        u_max: ClassVar[tuple[float, ...]] = system.u_max
        G: ClassVar[tuple[tuple[float, ...], ...]] = (*system.G, *still) if constant else ()
        scale: ClassVar[tuple[float, ...]] = (*system.scale, *(STILL,) * len(names))
        dt = system.dt
        process_noise = system.process_noise
        measurement_noise = system.measurement_noise

        def draw_starts(self, rng: Any, n: int, factor: float = 1.0) -> Any:
            x = super().draw_starts(rng, n)  # parameters keep to their ranges, and states to what the system draws
            x[:, :nx] = system.draw_starts(rng, n, factor)
            if in_training:
                low, high = np.transpose(limits_of)
                along = (2 * x[:, nx:] - low - high) / (high - low)  # -1 to 1
                x[:, nx:] = (low + high + np.sin(along * np.pi / 2) * (high - low)) / 2
                x[rng.random(n) < nominal_share(ranges), nx:] = own
            return x

        @property
        def target(self) -> tuple[float, ...]:
            return (*system.target, *own)

        def h(self, x: Components) -> Components:
            return model(x).h(x[:nx])

        def rate(self, x: Components) -> Any:
            return system.rate(x[:nx])  # near enough, and a formula for it may decide on its parameters

        if system.discrete:

            def step(self, x: Components, u: Components) -> Components:
                return [*model(x).step(x[:nx], u), *x[nx:]]

        else:

            def f(self, x: Components) -> Components:
                return [*model(x).f(x[:nx]), *(0.0 * value for value in x[nx:])]

            if system.nu and not constant:

                def g(self, x: Components) -> Sequence[Components]:
                    return [*input_matrix(model(x), x[:nx]), *still]

    return WithParameters()


def with_bias(system: System, half_widths: float | Sequence[float]) -> System:
    """A system whose states are x and then a constant bias of each output that may have one, up to its half-width."""
    given = np.atleast_1d(np.asarray(half_widths, dtype=float))
    if len(given) not in (1, system.ny):
        raise ValueError(f"bias must be one number, or one of each of {system.ny} outputs, got {half_widths}")
    widths = np.broadcast_to(given, (system.ny,))
    for i, (width, size) in enumerate(zip(widths.tolist(), system.output_range, strict=True)):
        if width > MAX_BIAS * size:
            raise ValueError(
                f"a bias of up to {width:g} is more than {MAX_BIAS:g} times the range {size:.3g} of y{i + 1}"
            )
    ranges = {f"y{i + 1}_bias": (-width, width) for i, width in enumerate(widths.tolist()) if width}

    def h(self: System, x: Components) -> Components:
        values = type(system).h(self, x)
        return [value + getattr(self, f"y{i + 1}_bias", 0.0) for i, value in enumerate(values)]

    biased: System = object.__new__(
        dataclasses.make_dataclass(
            "Biased",
            [(name, float, 0.0) for name in ranges],
            bases=(type(system),),
            namespace={"name": f"{system.name} with a bias", "h": h},
            frozen=True,
        )
    )
    biased.__dict__.update(vars(system), **dict.fromkeys(ranges, 0.0))
    return with_parameters(biased, ranges)


def blind(policy: Controller, nx: int) -> Controller:
    """A policy for a system of :func:`with_parameters` that sees the nx states alone."""
    return lambda x: policy(x[:, :nx])
