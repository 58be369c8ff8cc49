"""Invalid arguments raise a ValueError that names the argument, and leave the target's state unchanged."""

import math
from decimal import Decimal
from functools import partial

import numpy as np
import pytest
from monitor_limits import limits

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
from observers import MLP, KKLObserver, LinearFilter, Monitor, load

N = 3
ENV, ENVS = partial(KKLEnv, "van_der_pol"), partial(KKLVectorEnv, "van_der_pol", N)
ARTIFACT = load("van_der_pol").artifact
NO_NUMBERS = (True, "0.5", 0.5j, Decimal("0.5"), math.nan, 10**400, object(), [None], np.ma.masked, np.timedelta64(1))
LEVELS, POSITIVE = (*NO_NUMBERS, -0.1, math.inf), (*NO_NUMBERS, 0.0, -1.0, math.inf)
STEPS, FLAGS = (True, "2", 2.0, 1.5, 0, math.nan, [2], object()), (1, "yes", None, [True], 0.5)
CHOICES = ("nonsense", "", 3, b"x", object(), [])
MAPPINGS = ("x", 3, [("mu", 1.0)], {"unknown": 1.0}, {1: 2})
A, B = np.diag([-1.0, -2.0]), np.ones((2, 1))
WEIGHTS, BIASES = [np.ones((4, 2)), np.ones((1, 4))], [np.ones(4), np.ones(1)]


def arrays_unlike(good, *more):
    """Invalid values for an array of real numbers with the shape of `good`."""
    good = np.asarray(good, dtype=float)
    strange = [good.astype(kind) for kind in ("U8", "bool", "c16", "O")] + [good.astype("i8").astype("M8[s]")]
    shapes = [np.concatenate([good, good], axis=-1), good.sum() + np.zeros(())]
    return [*strange, *shapes, np.ma.array(good, mask=True), np.full(good.shape, math.nan), "x", object(), *more]


BOX = np.array([[-1.0, 1.0], [-1.0, 2.0]])
ENVIRONMENT_ARGUMENTS = {
    "dt": (POSITIVE, "dt"),
    "process_noise": (LEVELS, "process_noise"),
    "measurement_noise": ((*LEVELS, (0.1, 0.1)), "measurement_noise"),
    "observe": (CHOICES, "observe"),
    "render_mode": (CHOICES, "render_mode"),
    "parameters": ((*MAPPINGS, {"mu": math.nan}, {"mu": "3"}, {"mu": True}), "parameter"),
    "start_box": (arrays_unlike(BOX, BOX[:1], BOX[:, ::-1], 1e3 * BOX), "start_box"),
    "sensor": (("quantised", 3, {"noise": 1.0}, {"gain": "2"}, {"bias": math.inf}, {"quantum": -0.1}, {"delay": 1.5},
                {"bias": [0.0, 1.0]}, {"saturation": 3.0}, {"saturation": (1, 1)}, {"saturation": ((0, 0), (1, 1))},
                {"every": 0}, {"drop_out": 1}, {"coloured_noise": 0.1}, {"coloured_noise": 0.1, "time_constant": 0}),
               "sensor|bias|saturation|coloured_noise|time_constant"),
}  # fmt: skip
MAP_ARGUMENTS = {
    "measurement_noise": ((*LEVELS, 1.01, (0.1, 0.1)), "measurement_noise"),
    "monitor": (FLAGS, "monitor"),
}
OBSERVER_ARGUMENTS = {
    **MAP_ARGUMENTS,
    "process_noise": (LEVELS, "process_noise"),
    "compiled": ((1, "yes", [True]), "compiled"),
    "tracking": ((1, "yes", [True]), "tracking"),
    "gate": (POSITIVE, "gate"),
    "delay": ((*NO_NUMBERS, -1, 1.5, 1001), "delay"),
}
WRAPPER_ARGUMENTS = {
    **MAP_ARGUMENTS,
    "observer": (("nonsense", 3, object()), "observer"),
    "estimate": ((*CHOICES, "y"), "estimate"),
    "ignore_input": (FLAGS, "ignore_input"),
    "uncertainty": (FLAGS, "uncertainty"),
}
TIME_CONSTANTS = ((), 4.0, (1, 1.2), (0.0,), (1e9,), ("1",), (math.nan,))


def named(make, table):
    return [(lambda v, name=name: make(**{name: v}), words, values) for name, (values, words) in table.items()]


@pytest.mark.parametrize(("make", "words", "bad"), [
    *named(ENV, ENVIRONMENT_ARGUMENTS), *named(ENVS, ENVIRONMENT_ARGUMENTS),
    *named(partial(load, "van_der_pol"), OBSERVER_ARGUMENTS),
    *named(partial(KKLObserver, ARTIFACT), OBSERVER_ARGUMENTS),
    *named(lambda **given: KKLObservation(ENV(), **given), WRAPPER_ARGUMENTS),
    *named(lambda **given: KKLVectorObservation(ENVS(), **given), WRAPPER_ARGUMENTS),
    *named(limits, {name: (arrays_unlike(getattr(limits(), name), -1.0 - getattr(limits(), name)), "limits|levels")
                    for name in ("levels", "mean", "low", "high")}
           | dict.fromkeys(("window", "warm_up", "false_alarms", "duration"),
                           ((*NO_NUMBERS, -1.0, math.inf), "limits|window"))),
    *((lambda v, kind=kind, more=more: kind(v, *more), "[Ee]nv|environments", (None, 3, "CartPole-v1", object()))
      for kind, *more in ((KKLObservation,), (KKLVectorObservation,), (KKLMemory,), (ActionRepeat, 2),
                          (VectorActionRepeat, 2))),
    *((lambda v, kind=kind, more=more: kind(v, *more), "[Ss]ystem", (None, 3, int, "Lorentz", "", "kkl_gym:KKLEnv"))
      for kind, *more in ((KKLEnv,), (KKLVectorEnv, N))),
    (lambda v: KKLVectorEnv("lorenz", v), "num_envs", (*STEPS, 10**400)),
    (lambda v: ENVS(max_episode_steps=v), "max_episode_steps", STEPS),
    (lambda v: ENVS(autoreset_mode=v), "autoreset_mode|AutoresetMode", CHOICES),
    (lambda v: ActionRepeat(ENV(), v), "repeat", STEPS),
    (lambda v: VectorActionRepeat(ENVS(autoreset_mode="Disabled"), v), "repeat", STEPS),
    (lambda v: KKLMemory(ENV(), time_constants=v), "time_constants", TIME_CONSTANTS),
    (lambda v: get_system("van_der_pol").replace({"mu": v}), "mu", NO_NUMBERS),
    (lambda v: LinearFilter(v, B, 0.1), "A|nz", arrays_unlike(A, -A, -np.ones(2))),
    (lambda v: LinearFilter(A, v, 0.1), "B|outputs", arrays_unlike(B.T)),
    (lambda v: LinearFilter(A, B, v), "dt", POSITIVE),
    (lambda v: LinearFilter(A, B, 0.1, v), "number of inputs", (*NO_NUMBERS, -1, 65, 1.0)),
    (lambda v: MLP([v, WEIGHTS[1]], BIASES, "tanh"), "weights|layer", arrays_unlike(WEIGHTS[0].T)),
    (lambda v: MLP(WEIGHTS, BIASES, v), "activation", (*CHOICES, "gelu")),
    (lambda v: Monitor(limits(), 0.2, v), "dt", POSITIVE),
])  # fmt: skip
def test_arguments(make, words, bad):
    for value in bad:
        with pytest.raises(ValueError, match=rf"\b({words})"):
            make(value)


def observing(rows=(), **options):
    observer = load("van_der_pol", 0.2, **options)
    observer.reset(np.full((*rows, 1), 0.4))
    return observer


def reset(env):
    env.reset(seed=1)
    return env


y, u, record, x0 = np.array([0.3]), np.array([0.1]), np.full((5, 1), 0.3), np.ones(2)
mask, three = np.array([True, False, True]), np.full((3, 1), 0.3)
masks = [mask.astype(float), mask[:2], [1, 0, 1], "x", True, np.ma.array(mask, mask=[True, False, False])]
huge, seeds = [np.array([math.inf]), np.array([1e16])], (1.5, -1, "x", True, [1, 2], [7, -1, 3])


def later(target):
    """Results of later calls, which depend on the state of the target."""
    if isinstance(target, KKLObserver):
        rows = target.z.shape[:-1]
        return [target.step(np.full((*rows, 1), 0.5), np.full((*rows, 1), 0.1)), target.step(None)]
    return [target.step(np.full(target.action_space.shape, 0.25))[0], target.reset()[0]]


@pytest.mark.parametrize(("make", "call", "words", "good", "bad"), [
    (observing, lambda o, v: o.reset(v), "y", y, [*arrays_unlike(y), *huge]),
    *((observing, call, "y", y, [*arrays_unlike(y)[:-3], "x", *huge])
      for call in (lambda o, v: o.step(v, u), lambda o, v: o.advance(v))),
    *((observing, call, "u", u, [*arrays_unlike(u), *huge])
      for call in (lambda o, v: o.step(y, v), lambda o, v: o.step(None, v))),
    (observing, lambda o, v: o.estimate(v), "y|record", record, arrays_unlike(record, record[:0], record + math.inf)),
    (observing, lambda o, v: o.estimate(record, v), "u", record, arrays_unlike(record, record[:1])),
    (observing, lambda o, v: o.reset(y, v), "x0", x0, arrays_unlike(x0, x0[None], x0 - math.inf)),
    (observing, lambda o, v: o.step(y, dt=v), "dt", 0.02, [*POSITIVE, 1e4]),
    (observing, lambda o, v: o.estimate(record, t=v), "t", 0.01 * np.arange(5), [x0, np.zeros(5), -np.arange(5), "x"]),
    (observing, lambda o, v: setattr(o, "measurement_noise", v), "measurement_noise", 0.3, [*LEVELS, None, 1.01, []]),
    (observing, lambda o, v: setattr(o, "process_noise", v), "process_noise", 0.3, LEVELS),
    *((partial(observing, (N,)), call, "rows", mask, masks)
      for call in (lambda o, v: o.advance(three, rows=v), lambda o, v: o.decode(v))),
    (partial(observing, (N,)), lambda o, v: o.restart(v, mask), "y", three[:2], arrays_unlike(three[:2], three)),
    (partial(observing, (N,)), lambda o, v: o.step(v), "y", three, [*arrays_unlike(three)[:-3], "x", three[:2]]),
    *((make, lambda e, v: e.step(v), "actions?", good, [*arrays_unlike(good, None), np.zeros((1, 2, 3))])
      for make, good in ((ENV, u), (lambda: KKLObservation(ENV()), u), (lambda: KKLMemory(ENV()), u),
                         (ENVS, three), (lambda: KKLVectorObservation(ENVS()), three),
                         (lambda: KKLVectorMemory(ENVS()), three))),
    *((make, lambda e, v: e.reset(seed=4, options={"x0": v}), "x0", x0, arrays_unlike(x0, 99 * x0, [1.0]))
      for make in (ENV, ENVS, lambda: KKLObservation(ENV()), lambda: KKLVectorObservation(ENVS()))),
    *((make, lambda e, v: e.reset(seed=4, options=v), "options?", {}, ["x", 3, {"start": 0}]) for make in (ENV, ENVS)),
    (ENVS, lambda e, v: e.reset(seed=v), "seeds?", 3, seeds),
    (ENVS, lambda e, v: e.reset(seed=6, options={"reset_mask": v}), "reset_mask", mask, [*masks, np.zeros(N, bool)]),
])  # fmt: skip
def test_calls(make, call, words, good, bad):
    tried, other = (each if isinstance(each, KKLObserver) else reset(each) for each in (make(), make()))
    for value in bad:
        with pytest.raises(ValueError, match=rf"\b({words})\b"):
            call(tried, value)
    for one, expected in zip(later(tried), later(other), strict=True):
        np.testing.assert_array_equal(one, expected)
    call(tried, good)
