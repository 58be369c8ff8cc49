"""A system's parameters, or biases of its outputs, as additional constant states."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from kkl_gym.equations import input_matrix
from kkl_gym.system import Box, Components, System
from observers.checks import shown
from training.trajectories.motions import Controller

# With k uncertain parameters, a share NOMINAL_SHARE ** k of the training motions has the system's own values of all k,
# and the other motions have other values. NOMINAL_SHARE was chosen on the four systems that ship: with 0.6 and layers
# of 256 units, the map of lorenz no longer distinguished a plant with the system's own parameters from others.
NOMINAL_SHARE = 2 / 3
STILL = 1e-12  # scale of an additional state: hardly any process noise acts on it, and 0 would be invalid
EVERY = "all"  # stands for every parameter that is not named
ROOM = 1e6  # distance of a parameter's bounds from the middle of its range, in widths of the range

Ranges = Mapping[str, tuple[float, float]]


def relative_ranges(system: System, half_widths: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Return ranges around the values of a system's parameters, with half-widths relative to these values."""
    known = system.parameters
    if half_widths and not known:
        raise ValueError(f"{system.name} has no parameters that could be uncertain")
    for name in half_widths:
        if name not in known and name != EVERY:
            raise ValueError(f"{system.name} has no parameter {shown(name)} to be uncertain; it has {', '.join(known)}")
    ranges = {}
    for name, value in known.items():
        if width := half_widths.get(name, half_widths.get(EVERY, 0.0)):
            if not value:
                text = f"{name} of {system.name} is 0 and has no relative range"
                raise ValueError(f"{text}: exclude it, with the half-width 0 ({name}=0)")
            ranges[name] = (value - width * abs(value), value + width * abs(value))
    return ranges


def nominal_share(ranges: Ranges) -> float:
    """Return the share of the training motions that have the system's own parameters."""
    return NOMINAL_SHARE ** len(ranges)


def with_parameters(system: System, ranges: Ranges, *, in_training: bool = False) -> System:
    """Return a system whose states are x, followed by the parameters in ``ranges``, which stay constant in a motion.

    An observer of this system can estimate the parameters. With ``in_training``, a share of the motions has the
    system's own parameters, because these are the likeliest. The parameters of the other motions lie more often near
    the ends of their ranges, where errors are largest.
    """
    if not ranges:
        return system

    def model(x: Components) -> System:
        changed = object.__new__(type(system))  # bypasses the class's check, which requires floats
        changed.__dict__.update(system.__dict__, **dict(zip(ranges, x[system.nx :], strict=True)))
        return changed

    def h(x: Components) -> Components:
        return model(x).h(x[: system.nx])

    own = {name: getattr(system, name) for name in ranges}
    return _with_constants(system, system.name, ranges, own, model, h, in_training=in_training)


def with_bias(system: System, half_widths: float | Sequence[float]) -> System:
    """Return a system whose states are x, followed by the constant biases of outputs with a positive half-width."""
    given = np.atleast_1d(np.asarray(half_widths, dtype=float))
    if len(given) not in (1, system.ny):
        raise ValueError(f"bias must be one number, or one for each of {system.ny} outputs, got {half_widths}")
    widths = np.broadcast_to(given, (system.ny,)).tolist()
    biased = [i for i, width in enumerate(widths) if width]
    ranges = {f"y{i + 1}_bias": (-widths[i], widths[i]) for i in biased}

    def h(x: Components) -> Components:
        values = list(system.h(x[: system.nx]))
        for i, bias in zip(biased, x[system.nx :]):
            values[i] = values[i] + bias
        return values

    own = dict.fromkeys(ranges, 0.0)
    return _with_constants(system, f"{system.name} with a bias", ranges, own, lambda x: system, h)


def _with_constants(
    system: System,
    title: str,
    ranges: Ranges,
    own: Mapping[str, float],
    model: Callable[[Components], System],
    outputs: Callable[[Components], Components],
    *,
    in_training: bool = False,
) -> System:
    """Return a system with additional constant states, the equations of ``model(x)`` and outputs ``outputs(x)``."""
    nx, limits = system.nx, [(float(low), float(high)) for low, high in ranges.values()]
    low, high = np.transpose(limits)
    middle, room = (low + high) / 2, ROOM * (high - low)
    still = ((0.0,) * system.nu,) * len(ranges)
    constant = bool(system.nu) and type(system).g is System.g and not system.discrete

    class WithConstants(System):
        name = title
        state_names: ClassVar[tuple[str, ...]] = (*system.state_names, *ranges)
        X: ClassVar[Box] = (*system.X, *limits)
        X_centre: ClassVar[tuple[float, ...]] = (*system.X_centre, *middle.tolist())
        bounds: ClassVar[Box] = (*system.bounds, *zip((middle - room).tolist(), (middle + room).tolist()))
        u_max: ClassVar[tuple[float, ...]] = system.u_max
        G: ClassVar[tuple[tuple[float, ...], ...]] = (*system.G, *still) if constant else ()
        scale: ClassVar[tuple[float, ...]] = (*system.scale, *(STILL,) * len(ranges))
        dt = system.dt
        process_noise = system.process_noise
        measurement_noise = system.measurement_noise

        def draw_starts(self, rng: Any, n: int, factor: float = 1.0) -> Any:
            x = super().draw_starts(rng, n)  # the factor does not widen the ranges of parameters
            x[:, :nx] = system.draw_starts(rng, n, factor)
            if in_training:
                along = (2 * x[:, nx:] - low - high) / (high - low)  # from -1 to 1
                x[:, nx:] = (low + high + np.sin(along * np.pi / 2) * (high - low)) / 2
                x[rng.random(n) < nominal_share(ranges), nx:] = [*own.values()]
            return x

        @property
        def target(self) -> tuple[float, ...]:
            return (*system.target, *own.values())

        def h(self, x: Components) -> Components:
            return outputs(x)

        def rate(self, x: Components) -> Any:
            return system.rate(x[:nx])  # with the system's own parameters: users' formulas may refuse arrays

        if system.discrete:

            def step(self, x: Components, u: Components) -> Components:
                return [*model(x).step(x[:nx], u), *x[nx:]]

        else:

            def f(self, x: Components) -> Components:
                return [*model(x).f(x[:nx]), *(0.0 * value for value in x[nx:])]

            if system.nu and not constant:

                def g(self, x: Components) -> Sequence[Components]:
                    return [*input_matrix(model(x), x[:nx]), *still]

    return WithConstants()


def blind(policy: Controller, nx: int) -> Controller:
    """Return a policy that passes only the first nx states of an extended system on to ``policy``."""
    return lambda x: policy(x[:, :nx])
