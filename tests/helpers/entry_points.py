"""Where values come in: the arguments of constructors and calls, and what can be seen of their effect."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import meanings as means
import numpy as np
from bad_values import array_value, mapping_value, scalar_value

import observers
from kkl_gym import (
    ActionRepeat,
    KKLEnv,
    KKLMemory,
    KKLObservation,
    KKLVectorEnv,
    KKLVectorMemory,
    KKLVectorObservation,
    VectorActionRepeat,
    get_system,
)
from observers import MLP, Artifact, KKLObserver, Limits, LinearFilter, Monitor

N = 3  # rows of vectors
ENVIRONMENTS, OBSERVERS, WRAPPERS = AREAS = ("make, reset, step", "observers", "wrappers, vectors")


@dataclass(frozen=True)
class Entry:
    """One argument of one call.

    ``says`` is a regular expression for the words of a clear error, ``good`` a right value, ``means`` one of the
    functions of :mod:`meanings`; ``call(target, value)`` and ``later(target)`` return what can be seen of the effect
    and of the target's state, ``values(good, rng)`` makes a value to try, and ``make()`` a target, if any is needed.
    """

    area: str
    name: str
    says: str
    good: Any
    means: Callable[[Any], tuple[bool, Any]]
    call: Callable[[Any, Any], Any]
    values: Callable[[Any, Any], Any] = scalar_value
    make: Callable[[], Any] = lambda: None
    later: Callable[[Any], Any] = lambda target: None


def constructors(area, rows):
    """Rows of (name, says, good, means, function from a value to what is seen, and where not scalar the values)."""
    for name, says, good, meaning, make, *values in rows:
        yield Entry(area, name, says, good, meaning, lambda _, v, make=make: make(v), *values)


def calls(area, name, make, later, rows):
    """Rows of (argument, says, good, means, call, values) on a target."""
    for argument, says, good, meaning, call, values in rows:
        yield Entry(area, f"{name}({argument})", says, good, meaning, call, values, make, later)


# What is seen


def driven(env):
    """Spaces, a start and two steps."""
    still = np.zeros(env.action_space.shape)
    spaces = [(space.low, space.high) for space in (env.observation_space, env.action_space)]
    return [spaces, env.reset(seed=0), env.step(still), env.step(still)]


def moved(env):
    """What follows from the state and the generators of an environment."""
    action = np.full(env.action_space.shape, 0.25)
    return [env.step(action), env.reset(), env.step(action)]


def observed(observer):
    """What follows from the state of an observer."""
    shape, ny, nu = observer.z.shape[:-1], observer.artifact.ny, observer.artifact.nu
    return [observer.step(np.full((*shape, ny), 0.5), np.full((*shape, nu), 0.1)), observer.step(None), observer.z]


def started(observer):
    """What a new observer says."""
    return [observer.reset([0.3]), observed(observer)]


# Targets


def reset(env):
    env.reset(seed=1)
    return env


def single(**options):
    return reset(KKLEnv("van_der_pol", **options))


def vector(**options):
    return reset(KKLVectorEnv("van_der_pol", N, **{"max_episode_steps": 7, **options}))


def disabled():
    return vector(autoreset_mode="Disabled")


def limited():
    return gym.make("KKLVanDerPol-v0", max_episode_steps=20)


def observer(name="van_der_pol", rows=(), **options):
    made = observers.load(name, 0.2, **options)
    made.reset(np.full((*rows, 1), 0.4))
    return made


# Environments


def resets(area, name, make, *rows):
    """Arguments of ``reset``, of a vector with a number of rows."""
    seed = means.seeds(*rows) if rows else means.whole(0, optional=True)
    arguments = [
        ("seed", "seeds?", 3, seed, lambda e, v: e.reset(seed=v), scalar_value),
        ("options", "options?|x0", {"x0": [0.5, 0.5]}, means.options(*rows), lambda e, v: e.reset(seed=4, options=v),
         mapping_value),
        ("x0", "x0", np.array([0.5, -0.5]), means.start(*rows), lambda e, v: e.reset(seed=5, options={"x0": v}),
         array_value),
    ]  # fmt: skip
    if rows:
        some = np.array([True, False, True])
        arguments += [
            ("seeds", "seeds?", np.array([3, 4, 5]), seed, lambda e, v: e.reset(seed=v), array_value),
            ("starts", "x0", np.ones((*rows, 2)), means.start(*rows), lambda e, v: e.reset(options={"x0": v}),
             array_value),
            ("reset_mask", "reset_mask", some, means.mask(*rows),
             lambda e, v: e.reset(seed=6, options={"reset_mask": v}), array_value),
        ]  # fmt: skip
    yield from calls(area, f"{name}.reset", make, moved, arguments)


def steps(area, name, make, *rows):
    """The argument of ``step``."""
    good, right = np.full((*rows, 1), 0.5), means.actions(*rows, 1)
    rows = [("action", "actions?", good, right, lambda e, v: e.step(v), array_value)]
    yield from calls(area, f"{name}.step", make, moved, rows)


def environments():
    """Systems, single and vector environments."""
    box = np.array([[-1.0, 1.0], [-1.0, 2.0]])
    for kind, rows in ((KKLEnv, ()), (KKLVectorEnv, (N,))):
        for name, says, good, meaning, values in (
            ("system", "[sS]ystem", "lorenz", means.system, scalar_value),
            ("dt", "dt", 0.02, means.real(lambda dt: 0 < dt < 10, optional=True), scalar_value),
            ("process_noise", "process_noise", 0.1, means.level, scalar_value),
            ("measurement_noise", "measurement_noise", 0.2, means.levels(), scalar_value),
            ("observe", "observe", "output", means.one_of("state", "output"), scalar_value),
            ("parameters", "parameters?|rate", {"mu": 2.0}, means.parameters, mapping_value),
            ("start_box", "start_box", box, means.start_box, array_value),
            ("render_mode", "render_mode", "rgb_array", means.one_of(None, "rgb_array"), scalar_value),
        ):  # fmt: skip
            made = lambda _, v, kind=kind, rows=rows, name=name: driven(  # noqa: E731
                kind(v, *rows) if name == "system" else kind("van_der_pol", *rows, **{name: v})
            )
            yield Entry(ENVIRONMENTS, f"{kind.__name__}({name})", says, good, meaning, made, values)
    yield from constructors(ENVIRONMENTS, (
        ("KKLVectorEnv(num_envs)", "num_envs", 2, means.whole(1, 10**6),
         lambda v: driven(KKLVectorEnv("van_der_pol", v))),
        ("KKLVectorEnv(max_episode_steps)", "max_episode_steps", 2, means.whole(1, optional=True),
         lambda v: driven(KKLVectorEnv("van_der_pol", 2, max_episode_steps=v))),
        ("KKLVectorEnv(autoreset_mode)", "autoreset_mode", "SameStep", means.mode,
         lambda v: driven(KKLVectorEnv("van_der_pol", 2, autoreset_mode=v))),
        ("System.replace(mu)", "mu", 2.0, means.real(np.isfinite),
         lambda v: get_system("van_der_pol").replace({"mu": v})),
    ))  # fmt: skip
    for name, make, rows in (("KKLEnv", single, ()), ("KKLVectorEnv", vector, (N,)), ("DISABLED", disabled, (N,))):
        yield from resets(ENVIRONMENTS, name, make, *rows)
        yield from steps(ENVIRONMENTS, name, make, *rows)


# Observers

PATH = str(Path(observers.__file__).parent / "maps" / "van_der_pol.safetensors")
ARTIFACT = Artifact.read(PATH)
Y, U = np.full((5, 1), 0.3), np.full((4, 1), 0.1)


def is_map(value):
    """What names an observer."""
    return isinstance(value, str | Path) and str(value) in (PATH, *observers.shipped()), value


def running():
    """Loading, setting and running observers."""
    most = ARTIFACT.inverse.measurement_noise_max
    yield from constructors(OBSERVERS, (
        ("load(name)", "observer", "van_der_pol", is_map, lambda v: started(observers.load(v))),
        ("KKLObserver(artifact)", "artifact", ARTIFACT, means.instance(Artifact), lambda v: started(KKLObserver(v))),
    ))  # fmt: skip
    for name, good, meaning in (
        ("measurement_noise", 0.2, means.levels(most)), ("process_noise", 0.1, means.level),
        ("monitor", True, means.flag),
    ):  # fmt: skip
        yield from constructors(OBSERVERS, (
            (f"load({name})", name, good, meaning,
             lambda v, name=name: started(observers.load("van_der_pol", **{name: v}))),
            (f"KKLObserver({name})", name, good, meaning,
             lambda v, name=name: started(KKLObserver(ARTIFACT, **{name: v}))),
        ))  # fmt: skip
        if name != "monitor":
            meaning = means.levels(most, optional=False) if name == "measurement_noise" else meaning
            row = (name, name, good, meaning, lambda o, v, name=name: setattr(o, name, v), scalar_value)
            yield from calls(OBSERVERS, "KKLObserver.", observer, observed, [row])

    def sample(*shape):
        return means.array(means.within((*shape, 1)), optional=True)  # None is a missing one, or no input

    batch = means.array(lambda y: y.ndim and means.within((*y.shape[:-1], 1))(y))
    record = means.array(
        lambda y: y.ndim > 1 and len(y) and with_gaps((*y.shape[:-1], 1))(y) and np.isfinite(y[0]).all()
    )
    inputs = means.array(lambda u: u.shape in ((4, 1), (5, 1)) and means.within((4, 1))(u[:4]), optional=True)
    yield from calls(OBSERVERS, "observer", observer, observed, (
        ("reset y", "y", Y[0], batch, lambda o, v: o.reset(v), array_value),
        ("step y", "y", Y[0], sample(), lambda o, v: o.step(v, [0.1]), array_value),
        ("step u", "u", U[0], sample(), lambda o, v: o.step([0.3], v), array_value),
        ("coasting u", "u", U[0], sample(), lambda o, v: o.step(None, v), array_value),
        ("advance y", "y", Y[0], sample(), lambda o, v: o.advance(v), array_value),
        ("estimate y", "y", Y, record, lambda o, v: o.estimate(v), array_value),
        ("estimate u", "u", U, inputs, lambda o, v: o.estimate(Y, v), array_value),
    ))  # fmt: skip
    state, known = np.array([0.5, 0.5]), means.array(means.within((2,)), optional=True)
    zero = means.array(lambda u: u.ndim < 2 and not u.any(), optional=True)
    yield from calls(OBSERVERS, "with T", lambda: observer("van_der_pol-spinn"), observed, (
        ("reset x0", "x0", state, known, lambda o, v: o.reset([0.5], v), array_value),
        ("estimate x0", "x0", state, known, lambda o, v: o.estimate(Y, x0=v), array_value),
        ("step u", "u", np.zeros(1), zero, lambda o, v: o.step([0.3], v), array_value),
    ))  # fmt: skip
    rows, two = np.array([True, False, True]), means.array(means.within((2, 1)))
    yield from calls(OBSERVERS, "batch", lambda: observer(rows=(N,), monitor=True), observed, (
        ("restart y", "y", Y[:2], two, lambda o, v: o.restart(v, rows), array_value),
        ("restart rows", "rows|y must have shape", rows, two_of_three, lambda o, v: o.restart(Y[:2], v), array_value),
        ("advance rows", "rows", rows, means.bools((N,), True), lambda o, v: o.advance(Y[:3], rows=v), array_value),
        ("decode rows", "rows", rows, means.bools((N,), True), lambda o, v: o.decode(v), array_value),
        ("step y", "y", Y[:3], means.array(with_gaps((N, 1)), optional=True), lambda o, v: o.step(v), array_value),
        ("step u", "u", Y[:3], sample(N), lambda o, v: o.step(Y[:3], v), array_value),
    ))  # fmt: skip


def with_gaps(shape):
    """Samples of that shape, of which some may be missing."""
    return lambda y: means.within(shape)(np.nan_to_num(y, nan=0.0))


def two_of_three(rows):
    right, found = means.bools((N,))(rows)
    return right and found.sum() == 2, found


A, B = np.diag([-1.0, -2.0]), np.ones((2, 1))
WEIGHTS, BIASES = [np.ones((4, 2)), np.ones((1, 4))], [np.ones(4), np.ones(1)]
LIMITS = {
    "levels": np.array([0.0, 1.0]), "mean": np.array([[0.3], [0.5]]), "low": np.array([[0.0], [0.4]]),
    "high": np.array([[0.1], [2.1]]), "window": 0.1, "warm_up": 0.05, "false_alarms": 0.01, "duration": 50.0,
}  # fmt: skip


def filtered(linear):
    return [linear.transition, linear.early_y, linear.late_y, linear.held_u, linear.equilibrium]


def limits(**changes):
    made = Limits(**{**LIMITS, **changes})
    return [made.at(0.0), made.at(0.2)]


def watched(limits, level, dt):
    monitor, scores = Monitor(limits, level, dt), []
    rows = monitor.start(1)
    for residual in np.linspace(0.1, 0.3, 20):
        rows = monitor.update(rows, np.array([[residual]]), np.array([[True]]))
        scores.append(monitor.score(rows))
    return scores


def parts():
    """What observers are made of."""
    square = means.array(lambda v: v.shape == (2, 2) and (v.diagonal() < 0).all())
    column = means.array(lambda v: v.ndim == 2 and len(v) == 2 and v.size and (np.abs(v) < 1e301).all())
    positive, level = means.real(lambda v: 0 < v < np.inf), means.levels(1.0, optional=False)
    known, point = Limits(**LIMITS), np.ones(2)
    yield from constructors(OBSERVERS, (
        ("LinearFilter(A)", "A|nz", A, square, lambda v: filtered(LinearFilter(v, B, 0.1)), array_value),
        ("LinearFilter(B)", "B|outputs", B, column, lambda v: filtered(LinearFilter(A, v, 0.1)), array_value),
        ("LinearFilter(dt)", "dt", 0.1, positive, lambda v: filtered(LinearFilter(A, B, v))),
        ("LinearFilter(nu)", "nu", 1, means.whole(0, 64), lambda v: filtered(LinearFilter(A, B, 0.1, v))),
        ("MLP(weight)", "weights", WEIGHTS[0], means.array(means.within((4, 2), 1e38)),
         lambda v: MLP([v, WEIGHTS[1]], BIASES, "tanh")(point), array_value),
        ("MLP(weights)", "weights", 1.0, means.nothing, lambda v: MLP(v, BIASES, "tanh")(point)),
        ("MLP(activation)", "activation", "tanh", means.one_of("tanh", "silu"),
         lambda v: MLP(WEIGHTS, BIASES, v)(point)),
        ("Monitor(limits)", "limits", known, means.instance(Limits), lambda v: watched(v, 0.2, 0.01)),
        ("Monitor(level)", "noise", 0.2, level, lambda v: watched(known, v, 0.01)),
        ("Monitor(dt)", "dt", 0.01, positive, lambda v: watched(known, 0.2, v)),
        ("Limits(levels)", "limits|levels", LIMITS["levels"],
         means.array(lambda v: v.shape in ((2,), (2, 1)) and v.flat[0] == 0 < v.flat[1] <= 1e30),
         lambda v: limits(levels=v), array_value),
        ("Limits(mean)", "limits|levels", LIMITS["mean"],
         means.array(lambda v: v.shape == (2, 1) and ((v > 0) & (v <= 1e30)).all()),
         lambda v: limits(mean=v), array_value),
    ))  # fmt: skip


# Wrappers


def wrappers():
    """Wrappers and wrapped environments."""
    most = ARTIFACT.inverse.measurement_noise_max
    for kind, inside in ((KKLObservation, limited), (KKLVectorObservation, vector)):
        for name, says, good, meaning in (
            ("observer", "observer", PATH, lambda v: (v is None or is_map(v)[0], v)),
            ("estimate", "estimate", "z", means.one_of("x", "z")),
            ("measurement_noise", "measurement_noise", 0.2, means.levels(most)),
            ("ignore_input", "ignore_input", True, means.flag),
            ("monitor", "monitor", True, means.flag),
            ("uncertainty", "uncertainty|error bars", False, means.flag),
        ):
            made = lambda _, v, kind=kind, inside=inside, name=name: driven(kind(inside(), **{name: v}))  # noqa: E731
            yield Entry(WRAPPERS, f"{kind.__name__}({name})", says, good, meaning, made)
    for kind in (KKLObservation, KKLVectorObservation, ActionRepeat, VectorActionRepeat, KKLMemory):
        more = (2,) if kind in (ActionRepeat, VectorActionRepeat) else ()
        made = lambda _, v, kind=kind, more=more: driven(kind(v, *more))  # noqa: E731
        yield Entry(WRAPPERS, f"{kind.__name__}(env)", "environments?|Env", None, means.nothing, made)
    yield from constructors(WRAPPERS, (
        ("KKLMemory(time_constants)", "time_constants", [1.0, 4.0], means.array(means.time_constants),
         lambda v: driven(KKLMemory(limited(), time_constants=v)), array_value),
        ("ActionRepeat(repeat)", "repeat", 2, means.whole(1), lambda v: driven(ActionRepeat(limited(), v))),
        ("VectorActionRepeat(repeat)", "repeat", 2, means.whole(1),
         lambda v: driven(VectorActionRepeat(disabled(), v))),
    ))  # fmt: skip
    for name, make, rows in (
        ("KKLObservation", lambda: KKLObservation(single()), ()),
        ("KKLVectorMemory", lambda: KKLVectorMemory(vector()), (N,)),
        ("z of SAME_STEP", lambda: KKLVectorObservation(vector(autoreset_mode="SameStep"), estimate="z"), (N,)),
        ("VectorActionRepeat", lambda: VectorActionRepeat(KKLVectorObservation(disabled()), 2), (N,)),
    ):
        yield from resets(WRAPPERS, name, lambda make=make: reset(make()), *rows)
        yield from steps(WRAPPERS, name, lambda make=make: reset(make()), *rows)


ENTRIES = [*environments(), *running(), *parts(), *wrappers()]
