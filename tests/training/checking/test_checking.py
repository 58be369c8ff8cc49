"""Systems that are deliberately wrong, each with what is said of it; and systems of which nothing is to be said."""

import functools
import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from linear_system import Autonomous, Oscillator

import kkl_gym.compiled
import training.checking.subject
import training.smoothness
from kkl_gym import SYSTEMS, System, get_system
from kkl_gym.compiled import SamplingStep
from kkl_gym.elementary import abs as absolute
from kkl_gym.elementary import sqrt
from kkl_gym.simulate import advance_batch
from training.checking import FIRST, THEN, check, dynamics
from training.checking.subject import Subject
from training.systems import controller

EXAMPLES = Path(__file__).parents[3] / "examples"
DURATION = 2.0


@pytest.fixture(autouse=True)
def _nothing_is_compiled(monkeypatch):
    in_numpy = functools.partial(functools.partial, advance_batch)
    monkeypatch.setattr(training.checking.subject, "batch_step", lambda system: SamplingStep(in_numpy(system)))


def findings(system, name=None, *, dt=None, duration=DURATION, policy=None):
    """Of one check alone, or of all."""
    if name is None:
        return list(check(system, dt=dt, duration=duration, policy=policy))
    if name in FIRST:
        return list(FIRST[name](system))
    return list(THEN[name](Subject(system, dt or system.dt, duration, policy)))


def one(system, name, verdict="problem", **options):
    (found,) = (one for one in findings(system, name, **options) if one.verdict == verdict)
    return found


def problems(system, **options):
    return [one for one in findings(system, **options) if one.verdict == "problem"]


@pytest.mark.parametrize("name", SYSTEMS)
def test_shipped_systems_have_no_problems(name):
    found = findings(get_system(name))
    assert "problem" not in {one.verdict for one in found}
    assert {one.check for one in found} >= {"equations", "rate", "bounds", "sampling", "target", "observability"}
    assert all(bool(one.advice) == (one.verdict != "ok") for one in found)


@pytest.mark.parametrize("name", ["own_system.py:Pendulum", "circle_pendulum.py:CirclePendulum"])
def test_examples_have_no_problems(name):
    assert not problems(get_system(str(EXAMPLES / name)))


@pytest.mark.parametrize(("name", "duration"), [("HeatedTank", 400.0), ("Motor", 0.1)])
def test_neither_have_those_in_physical_units(name, duration):
    assert not problems(get_system(f"{EXAMPLES / 'physical_units.py'}:{name}"), duration=duration)


def test_a_linear_system_has_its_numbers():
    found = {one.check: one.found for one in findings(Oscillator(), duration=20.0)}
    # The norm of ((0, 1), (-1, 0)), whose eigenvalues are +-i.
    assert found["rate"] == "typically 1.41/s in X, at most 1.41/s within the bounds: 1 and 1 substeps of dt = 0.01 s"
    assert (
        "time constants 1 to 1 s (medians over X), of which the fastest spans 100 samples and a motion 20 of"
        in found["sampling"]
    )
    assert "y changes by 0.98 % of its standard deviation" in found["sampling"]
    assert found["inputs"] == "input 1 at its bound 0.5 moves x2 by 0.5 per second"
    assert found["bounds"] == "all of 200 motions of 20 s stay within them, from X and 2X, free and driven"


# Equations.


class Branching(Oscillator):
    name = "branching"

    def f(self, x):
        if x[0] > 0:
            return x[1], -x[0]
        return x[1], -2.0 * x[0]


def test_an_if_on_the_state():
    found = problems(Branching())
    assert [one.check for one in found] == ["equations"]
    assert "on arrays: f(x) of 'branching' failed in" in found[0].found
    assert "(`if x[0] > 0:`)" in found[0].found
    assert "kkl_gym.elementary.where" in found[0].found
    assert found[0].advice == "as it is, batches, training and evaluation do not run"
    assert findings(Branching())[-1].found == "all other checks are left out"


class MathSine(Oscillator):
    name = "math-sine"

    def f(self, x):
        return x[1], -math.sin(x[0])


def test_functions_of_math():
    (found,) = problems(MathSine())
    assert "on arrays" in found.found
    assert "use kkl_gym.elementary.sin" in found.found


class NumpySine(Oscillator):
    name = "numpy-sine"

    def f(self, x):
        return x[1], -np.sin(x[0])


def test_functions_of_numpy_cost_what_symbols_give():
    assert not problems(NumpySine())
    (found,) = (one for one in findings(NumpySine(), "equations") if "on symbols" in one.found)
    assert found.verdict == "note"
    assert "no Kalman filter" in found.advice
    assert "where equations do not work on symbols" in one(NumpySine(), "observability", "note").found


class Special(Oscillator):
    name = "special"

    def f(self, x):
        return x[1], -x[0] + (1.0 if isinstance(x[0], float) else 0.0)


def test_equations_that_say_something_else_to_arrays():
    found = findings(Special(), "equations")[0]
    assert "on arrays they do not say what they say on floats, such as at x = [" in found.found


def test_the_class_lists_what_it_declares():
    text = one(get_system("van_der_pol"), "system", "ok").found
    assert text == "van_der_pol: 2 states (x1, x2); 1 input up to 5; parameters mu = 3"


class Rooted(Oscillator):
    name = "rooted"

    def f(self, x):
        return x[1], -sqrt(x[0] + 0.5)


def test_equations_that_are_no_numbers_in_a_part_of_the_bounds():
    found = one(Rooted(), "finite")
    assert "25 % of X" in found.found.replace("24 %", "25 %").replace("26 %", "25 %")
    assert "of the bounds" in found.found
    assert found.advice.startswith("draw the bounds, and X, where the equations hold, which is for x1 above -0.4")


class Wedge(Oscillator):
    name = "wedge"

    def f(self, x):
        return x[1], -sqrt(x[0] + x[1])


def test_a_part_that_no_single_state_says():
    assert one(Wedge(), "finite").advice == "draw the bounds, and X, where the equations hold, or change the equations"


class Cubic(Oscillator):
    name = "cubic"

    def f(self, x):
        return x[1], -(x[0] ** 3)


def test_compiled_or_not(monkeypatch):
    machine_code = "large batches of environments run as machine code"
    assert one(Oscillator(), "compiled", "ok").found.startswith(machine_code)
    monkeypatch.setattr(training.checking.subject, "batch_step", kkl_gym.compiled.batch_step)
    pytest.importorskip("numba")
    assert one(Oscillator(), "compiled", "ok").found == f"{machine_code}, and so do single ones"
    assert "single ones take their steps in Python (ValueError: f has a power" in one(Cubic(), "compiled", "ok").found
    assert "several times slower: " in one(NumpySine(), "compiled", "note").found
    assert "not integrated" in one(Rotation(), "compiled", "ok").found
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert one(Oscillator(), "compiled", "note").advice == 'pip install "kkl-gym[fast]"'


# Inputs and starts.


class IdleInput(Oscillator):
    name = "idle-input"
    u_max = (1.0, 1.0)
    G = ((0.0, 0.0), (1.0, 0.0))


def test_an_input_that_moves_nothing():
    found = one(IdleInput(), "inputs")
    assert found.found == "input 2 moves no state"
    assert "column 2 of G" in found.advice


class InputByState(Oscillator):
    name = "input-by-state"

    def g(self, x):
        return (0.0,), (2.0 + 0.0 * x[0],)


def test_an_input_matrix_that_depends_on_the_state():
    assert "moves x2 by 1 per second" in one(InputByState(), "inputs", "ok").found


class Flat(Oscillator):
    name = "flat"

    def draw_starts(self, rng, n, factor=1.0):
        return rng.uniform(-1, 1, n)


class Far(Oscillator):
    name = "far"

    def draw_starts(self, rng, n, factor=1.0):
        return rng.uniform(-20 * factor, 20 * factor, (n, 2))


def test_starts_of_another_shape_or_out_of_bounds():
    assert "draw_starts(rng, 100, 1) returns starts of shape (100,)" in one(Flat(), "starts").found
    found = one(Far(), "starts")
    assert "draw_starts(rng, 100, 2) lie beyond the bounds" in found.found
    assert "within the bounds" in found.advice


@dataclass(frozen=True)
class Rotation(System):
    """The oscillator in discrete time, started on a circle."""

    name: ClassVar[str] = "rotation"
    X: ClassVar = ((-1, 1), (-1, 1))
    bounds: ClassVar = ((-30, 30), (-30, 30))
    u_max: ClassVar = (0.5,)
    dt: ClassVar[float] = 0.1

    def step(self, x, u):
        c, s = math.cos(0.1), math.sin(0.1)
        return c * x[0] + s * x[1], c * x[1] - s * x[0] + 0.1 * u[0]

    def h(self, x):
        return (x[0],)

    def draw_starts(self, rng, n, factor=1.0):
        angle = rng.uniform(0, 2 * np.pi, n)
        return factor * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def test_discrete_time_and_starts_of_its_own():
    found = findings(Rotation())
    assert "problem" not in {one.verdict for one in found}
    by_name = {one.check: one.found for one in found}
    assert by_name["equations"].startswith("step and h work on floats, arrays, tensors, symbols")
    assert by_name["inputs"] == "input 1 at its bound 0.5 moves x2 by 0.5 per second"
    assert by_name["starts"] == "draw_starts of its own, all within the bounds"
    assert "rate" not in by_name
    assert by_name["observability"].startswith("x2: predicted error 4.7 %")
    with pytest.raises(ValueError, match="no others"):
        findings(Rotation(), dt=0.2)


# Motions.


class Elongated(Autonomous):
    """x1 swings four times as far as x2."""

    name = "elongated"
    bounds = ((-1.3, 1.3), (-3, 3))

    def f(self, x):
        return 4.0 * x[1], -0.25 * x[0]


def test_bounds_that_are_too_narrow():
    found = one(Elongated(), "bounds", dt=0.1, duration=20.0)
    assert "leave them" in found.found
    assert "most often x1" in found.found
    low, high = map(float, found.advice.removeprefix("widen the bounds of x1 to (").removesuffix(")").split(","))
    assert -4.6 < low < -4.0  # sqrt(17) and some room
    assert 4.0 < high < 4.6

    class Wide(Elongated):
        name = "wide"
        bounds = ((1.2 * low, 1.2 * high), (-3, 3))

    assert one(Wide(), "bounds", "ok", dt=0.1, duration=20.0)


class Upright(Oscillator):
    """Falls, unless the input acts against it."""

    name = "upright"
    bounds = ((-4, 4), (-8, 8))
    u_max = (20.0,)

    def f(self, x):
        return x[1], 4.0 * x[0]


class Weak(Upright):
    name = "weak"
    u_max = (0.01,)


class Fast(Upright):
    """Falls too fast for a controller that acts every 0.1 s."""

    name = "fast"
    u_max = (1000.0,)
    dt = 0.1

    def f(self, x):
        return x[1], 400.0 * x[0]


class Adrift(Upright):
    name = "adrift"
    u_max = ()
    G = ()


def test_a_system_that_no_random_input_holds():
    found = one(Upright(), "bounds", duration=5.0)
    assert "50 of 50 free and 50 of 50 driven leave them" in found.found
    assert "train with --policy controller, under which 100 of 100 stay" in found.advice
    assert "--policy script.py:function" in one(Weak(), "bounds", duration=5.0).advice
    assert "smaller dt" not in one(Weak(), "bounds", duration=5.0).advice
    assert "or take a smaller dt" in one(Fast(), "bounds", duration=5.0).advice
    assert one(Adrift(), "bounds", duration=5.0).advice.endswith("10 times as wide: shrink X")
    assert "no error can be predicted for motions without input" in one(Upright(), "observability", "note").found


def test_the_same_under_a_policy():
    assert findings(Upright(), "bounds", policy=controller(Upright()))[0].verdict == "ok"
    found = one(Upright(), "bounds", duration=5.0, policy=lambda x: np.zeros((len(x), 1)))
    assert "100 of 100 under the policy leave them" in found.found
    assert found.advice.startswith("let the policy hold the system")


def test_motions_that_need_too_many_substeps(monkeypatch):
    def fails(*args, **options):
        raise dynamics.SubstepsError("stiff changes at a rate of 1e+09/s; take a smaller dt")

    monkeypatch.setattr("training.checking.subject.simulate", fails)
    found = problems(Oscillator())
    assert [(one.check, one.found, one.advice) for one in found] == [
        ("bounds", "stiff changes at a rate of 1e+09/s", "take a smaller dt")
    ]
    (found,) = (one for one in findings(Oscillator(), dt=1e6) if one.check == "sampling")
    assert "would need more than" in found.found
    assert found.advice.startswith("take dt <= ")


class Low(Oscillator):
    name = "low"

    def rate(self, x):
        return 0.01 + 0.0 * x[0]


class High(Oscillator):
    name = "high"

    def rate(self, x):
        return 300.0 + 0.0 * x[0]


class Unscaled(Oscillator):
    """X says nothing of how far the states move: x2 has a range ten thousand times as large as it needs."""

    name = "unscaled"
    X = ((-1, 1), (-1e4, 1e4))
    bounds = ((-1e6, 1e6), (-1e6, 1e6))


def test_rates_that_say_too_little_or_too_much():
    found = one(Low(), "rate")
    assert "the fastest eigenvalue of df/dx is 1/s at the median" in found.found
    assert "leave rate(x) out, whose default says 1.41/s" in found.advice
    found = one(High(), "rate", "note")
    assert "The norm of df/dx is 1.41/s" in found.found
    assert found.advice == "lower rate(x)"
    found = one(Unscaled(), "rate", "note")
    assert "The fastest eigenvalue of df/dx is 1/s" in found.found
    assert "let X's half-widths fit" in found.advice


class Integrator(Oscillator):
    name = "integrator"

    def f(self, x):
        return 0.0 * x[0], 0.0 * x[1]


def test_a_system_without_a_rate():
    (found,) = (one for one in problems(Integrator()) if one.check == "rate")
    assert "override it to say how fast f changes" in found.found


def test_steps_that_take_long(monkeypatch):
    monkeypatch.setattr(dynamics, "SLOW", 0.0)
    assert "override rate(x) with a formula" in one(Oscillator(), "speed", "note").advice
    assert "lower rate(x)" in one(High(), "speed", "note").advice


@pytest.mark.parametrize(("dt", "verdict"), [(0.05, "ok"), (0.7, "note"), (1.5, "problem")])
def test_sampling_intervals(dt, verdict):
    found = one(Oscillator(), "sampling", verdict, dt=dt, duration=60.0)
    assert f"dt = {dt} s, motions of 60 s (the rate suggests 0.01 and 50 s)" in found.found
    assert ("take dt = 0.1 s" in found.advice) == (verdict != "ok")  # 2 pi / 0.1: some sixty samples a period


def test_samples_that_tell_nothing_new_and_motions_that_are_short(monkeypatch):
    found = one(Oscillator(), "sampling", "note", duration=0.5)
    assert found.advice == "motions end before the slow part has moved: take a duration of 5 s"
    monkeypatch.setattr(dynamics, "IDLE", 0.02)
    found = one(Oscillator(), "sampling", "note", duration=10.0)
    assert found.advice == "samples tell hardly anything new: take dt = 0.05 s"


# Sizes.


class Constant(Oscillator):
    name = "constant"

    def h(self, x):
        return x[0], 0.0 * x[0] + 2.5


def test_an_output_that_does_not_move():
    found = one(Constant(), "output")
    assert found.found == "y2 is 2.5 everywhere in X"
    assert "leave this output out" in found.advice


class Loud(Oscillator):
    name = "loud"
    measurement_noise = 1.0


class Settling(Autonomous):
    name = "settling"

    def f(self, x):
        return -5.0 * x[0], x[0] - 5.0 * x[1]


def test_outputs_that_are_noisy_or_come_to_rest():
    assert one(Loud(), "output", "note").advice == "set measurement_noise: 0.1 is 5 % of the range"
    assert "shorter duration" in one(Settling(), "output", "note", duration=20.0).advice


class Shaken(Oscillator):
    name = "shaken"
    process_noise = 5.0


class Undisturbed(Oscillator):
    name = "undisturbed"
    process_noise = 0.0


def test_process_noise_that_drowns_the_motion():
    found = one(Shaken(), "process noise", duration=50.0)
    assert "x1 up to 5 per second (8" in found.found  # x2 has a standard deviation of 1 / sqrt(3)
    assert "over 50 s it leads 2.04 half-widths of X away" in found.found  # 5 sqrt(0.01 50 / 3)
    assert found.advice.startswith("set process_noise = 0.05, ")
    assert one(Undisturbed(), "process noise", "ok").found == "none by default"


class OffTarget(Oscillator):
    """At rest at (1, 0)."""

    name = "off-target"
    X = ((-2, 2), (-1, 1))

    def f(self, x):
        return x[1], 1.0 - x[0]


class Held(OffTarget):
    name = "held"
    u_max = (1.5,)


class Undriven(OffTarget):
    name = "undriven"
    u_max = ()
    G = ()


class Nowhere(OffTarget):
    name = "nowhere"

    def f(self, x):
        return x[1] + 3.0, 1.0 - x[0]


def test_targets_that_are_no_equilibria():
    found = one(OffTarget(), "target")
    assert found.found.startswith("target (0, 0), the default, is no equilibrium, and no input within its bounds")
    assert "x' = (0, 0.5) per second at best" in found.found
    assert found.advice == "let target return an equilibrium, such as (1, 0)"
    assert one(Held(), "target", "ok").found == "target (0, 0), the default, is an equilibrium under u = (-1)"
    assert "x' = (0, 1) per second" in one(Undriven(), "target", "note").found
    assert "some input within its bounds holds" in one(Nowhere(), "target").advice


@pytest.mark.parametrize(
    ("target", "verdict", "text"),
    [
        ((0.0,), "problem", "is no state"),
        ((50.0, 0.0), "problem", "lies beyond the bounds"),
        ((2.0, 0.0), "note", "lies beyond X"),
    ],
)
def test_targets_that_lie_elsewhere(target, verdict, text):
    at = target

    class Aimed(Oscillator):
        name = "aimed"
        target = at

    assert text in one(Aimed(), "target", verdict).found


# What y tells.


@dataclass(frozen=True)
class Blind(System):
    """The oscillator, and a state of which y tells nothing."""

    growth: float = 0.0

    name: ClassVar[str] = "blind"
    state_names: ClassVar = ("x1", "x2", "bias")
    X: ClassVar = ((-1, 1), (-1, 1), (-1, 1))
    bounds: ClassVar = ((-30, 30), (-30, 30), (-30, 30))

    def f(self, x):
        return x[1], -x[0], self.growth * x[2]

    def h(self, x):
        return (x[0],)


class Sum(Blind):
    name = "sum"

    def f(self, x):
        return x[1] + x[2], 0.0 * x[0], 0.0 * x[0]


class Faint(Blind):
    name = "faint"

    def h(self, x):
        return (x[0] + 1e-3 * x[2],)


def test_states_of_which_y_tells_nothing():
    found = one(Blind(), "observability")
    assert found.found == "y tells nothing of bias at the start"
    assert found.advice == "let h measure bias too, or leave it out of the state"
    assert one(Sum(), "observability").found == "y tells nothing of a combination of x2 and bias at the start"
    (forgotten,) = (one for one in findings(Blind(growth=-2.0), "observability") if "nothing" in one.found)
    assert forgotten.verdict == "note"
    assert "forgets by itself" in forgotten.found
    assert "y tells little of bias" in one(Faint(), "observability", "note").found


def test_a_spectrum_that_makes_T_smooth(monkeypatch):
    monkeypatch.setattr(training.smoothness, "FOLLOWED", 30.0)
    assert one(Oscillator(), "spinn", "ok").found.startswith("T is smooth for the eigenvalues -")
    monkeypatch.setattr(training.smoothness, "SMOOTH", 2.0)
    assert "--pipeline input-aware" in one(Oscillator(), "spinn", "note").advice


def test_motions_are_no_longer_than_can_be_followed_in_seconds(monkeypatch):
    monkeypatch.setattr("training.checking.THEN", {"bounds": THEN["bounds"]})
    monkeypatch.setattr("training.checking.subject.STEPS", 1500)
    (found,) = (one for one in findings(High(), duration=None) if one.check == "bounds")
    assert "motions of 2 s" in found.found  # 1,500 / (300 0.01 / 0.4) intervals
    with pytest.raises(ValueError, match="duration"):
        findings(Oscillator(), duration=1e-3)
    with pytest.raises(ValueError, match="dt"):
        findings(Oscillator(), dt=-1.0)


@dataclass(frozen=True)
class Draining(System):
    """Two tanks that run empty, where the outflow of Torricelli is infinitely steep. Metres and seconds."""

    smooth: float = 0.0  # m

    name = "draining"
    X = ((0.05, 0.6), (0.05, 0.6))
    bounds = ((-0.1, 2.0), (-0.1, 2.0))
    u_max = (5e-5,)
    G = ((65.0,), (0.0,))

    def f(self, x):
        outflow = [0.0144 * level / sqrt(absolute(level) + self.smooth) for level in x]
        return -outflow[0], outflow[0] - outflow[1]

    def h(self, x):
        return (x[1],)


@pytest.mark.parametrize(("smooth", "verdict"), [(1e-30, "note"), (1e-3, "ok")])
def test_motions_that_come_to_where_f_is_steep(smooth, verdict, monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr(training.checking.subject, "batch_step", kkl_gym.compiled.batch_step)
    monkeypatch.setattr("training.checking.subject.STEPS", 1000)
    monkeypatch.setattr("training.checking.THEN", {name: THEN[name] for name in ("rate", "bounds")})
    *_, rate, bounds = findings(Draining(smooth), duration=None)
    # Of 1,000 intervals of 0.5 s those are left that 1,000 substeps make, or 200.
    assert bounds.found.startswith(f"all of 200 motions of {500 if verdict == 'ok' else 100} s stay within them")
    assert rate.verdict == verdict
    assert ("end where f is steep" in rate.found) == (verdict == "note")
    assert ("sqrt(abs(x) + c)" in rate.advice) == (verdict == "note")


def test_motions_that_are_lost_take_no_substeps():
    class Leaving(Oscillator):
        name = "leaving"

        def f(self, x):
            return 10.0 + 0.0 * x[0], 0.0 * x[1]

    assert Subject(Leaving(), 0.01, 30.0).affordable() == 30.0


def test_the_page_explains_every_line():
    page = (EXAMPLES.parent / "docs" / "guides" / "check.md").read_text(encoding="utf-8")
    for name in (*FIRST, *THEN):
        assert f"\n| {name} |" in page
    shown = page.split("```\n")[2]
    assert all(f" {one.check} " in shown for one in findings(get_system(str(EXAMPLES / "own_system.py:Pendulum"))))
