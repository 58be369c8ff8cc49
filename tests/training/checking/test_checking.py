"""Systems that are deliberately wrong, each with what is said of it; and systems of which nothing is to be said."""

import functools
import importlib.util
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import linear_system
import numpy as np
import pytest
from discrete_systems import Sampled
from linear_system import Autonomous, Oscillator

import kkl_gym.compiled
import training.checking.subject
import training.smoothness
from kkl_gym import SYSTEMS, get_system
from kkl_gym.compiled import SamplingStep
from kkl_gym.elementary import abs as absolute
from kkl_gym.elementary import sqrt
from kkl_gym.simulate import advance_batch
from training.checking import FIRST, THEN, check, dynamics
from training.checking.subject import Subject
from training.cli import main
from training.systems import controller

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture(autouse=True)
def _nothing_is_compiled(monkeypatch):
    in_numpy = functools.partial(functools.partial, advance_batch)
    monkeypatch.setattr(training.checking.subject, "batch_step", lambda system: SamplingStep(in_numpy(system)))


def made(base=Oscillator, **changes):
    """A system that differs from another in some of its attributes."""
    return type("Made", (base,), {"name": "made", **changes})()


def findings(system, name=None, *, dt=None, duration=2.0, policy=None):
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


def test_a_system_that_ships():
    found = findings(get_system("van_der_pol"))
    assert "problem" not in {one.verdict for one in found}
    assert {one.check for one in found} >= {"equations", "rate", "bounds", "sampling", "target", "observability"}
    assert all(bool(one.advice) == (one.verdict != "ok") for one in found)
    assert found[0].found == "van_der_pol: 2 states (x1, x2); 1 input up to 5; parameters mu = 3"


def test_the_page_explains_every_line_of_its_example():
    found = findings(get_system(str(EXAMPLES / "own_system.py:Pendulum")))
    assert "problem" not in {one.verdict for one in found}
    page = (EXAMPLES.parent / "docs" / "guides" / "check.md").read_text(encoding="utf-8")
    for name in (*FIRST, *THEN):
        assert f"\n| {name} |" in page
    assert all(f" {one.check} " in page.split("```\n")[2] for one in found)


@pytest.mark.parametrize(
    ("name", "duration"),
    [
        (f"{EXAMPLES}/circle_pendulum.py:CirclePendulum", 2.0),
        pytest.param(f"{EXAMPLES}/physical_units.py:Motor", 0.1, marks=pytest.mark.slow),
        pytest.param(f"{EXAMPLES}/physical_units.py:HeatedTank", 400.0, marks=pytest.mark.slow),
        *(pytest.param(name, 2.0, marks=pytest.mark.slow) for name in SYSTEMS),
    ],
)
def test_neither_do_others_have_problems(name, duration):
    assert not problems(get_system(name), duration=duration)


def test_a_linear_system_has_its_numbers():
    subject = Subject(Oscillator(), 0.01, 20.0)
    found = {name: next(THEN[name](subject)).found for name in ("rate", "sampling", "inputs", "bounds")}
    # The norm of ((0, 1), (-1, 0)), whose eigenvalues are +-i.
    assert found["rate"] == "typically 1.41/s in X, at most 1.41/s within the bounds"
    assert (
        "time constants 1 to 1 s (medians over X), of which the fastest spans 100 samples and a motion 20 of"
        in found["sampling"]
    )
    assert "y changes by 0.98 % of its standard deviation" in found["sampling"]
    assert found["inputs"] == "input 1 at its bound 0.5 moves x2 by 0.5 per second"
    assert found["bounds"] == "all of 200 motions of 20 s stay within them, from X and 2X, free and driven"


def test_the_command_prints_a_table_of_findings(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")
    options = ["--dt", "0.05", "--duration", "2", "--policy", "controller", "--json", str(tmp_path / "found.json")]
    main(["check", f"{linear_system.__file__}:Oscillator", *options])
    shown = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("checking ")]  # if it is slow
    assert shown[-1] == "no problems, no notes"
    for line, finding in zip(shown[:-1], json.loads((tmp_path / "found.json").read_text()), strict=True):
        assert line.split()[0] == finding["verdict"] == "ok"
        assert finding["check"] in line
        assert finding["found"] in line
    assert any("under the policy" in line for line in shown)


def on_a_circle(self, rng, n, factor=1.0):
    angle = rng.uniform(0, 2 * np.pi, n)
    return factor * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def test_discrete_time_and_starts_of_its_own():
    system = made(Sampled, draw_starts=on_a_circle)
    found = {one.check: one for one in findings(system)}
    assert "problem" not in {one.verdict for one in found.values()}
    assert found["equations"].found.startswith("step and h work on floats, arrays, tensors, symbols")
    assert found["inputs"].found == "input 1 at its bound 0.5 moves x2 by 0.5 per second"
    assert found["starts"].found == "draw_starts of its own, all within the bounds"
    assert "rate" not in found
    assert found["observability"].found.startswith("x2: predicted error ")
    with pytest.raises(ValueError, match="no others"):
        findings(system, dt=0.2)


@dataclass(frozen=True)
class Branching(Oscillator):
    gain: float = 1.0

    name: ClassVar[str] = "branching"

    def f(self, x):
        if x[0] > 0:
            return x[1], -x[0]
        return x[1], -self.gain * x[0]


def test_an_if_on_the_state_is_a_problem_and_ends_the_command_with_status_1(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit) as end:
        main(["check", f"{__file__}:Branching", "--parameters", "gain", "2", "--json", str(tmp_path / "found.json")])
    assert end.value.code == 1
    shown = capsys.readouterr().out
    assert "gain = 2" in shown
    assert "→ as it is, batches, training and evaluation do not run" in shown
    assert shown.splitlines()[-1] == "1 problem, 3 notes"
    found = json.loads((tmp_path / "found.json").read_text())
    (wrong,) = (one["found"] for one in found if one["verdict"] == "problem")
    assert wrong in shown  # square brackets are no markup
    assert "on arrays: f(x) of 'branching' failed in" in wrong
    assert "(`if x[0] > 0:`)" in wrong
    assert "kkl_gym.elementary.where" in wrong
    assert found[-1]["found"] == "all other checks are left out"


def test_functions_of_other_modules():
    found = one(made(f=lambda self, x: (x[1], -math.sin(x[0]))), "equations").found
    assert "on arrays" in found
    assert "use kkl_gym.elementary.sin" in found
    of_numpy = made(f=lambda self, x: (x[1], -np.sin(x[0])))
    assert not problems(of_numpy)
    (note,) = (one for one in findings(of_numpy, "equations") if "on symbols" in one.found)
    assert note.verdict == "note"
    assert "no Kalman filter" in note.advice
    assert "where equations do not work on symbols" in one(of_numpy, "observability", "note").found


def test_equations_that_say_something_else_to_arrays():
    special = made(f=lambda self, x: (x[1], -x[0] + (1.0 if isinstance(x[0], float) else 0.0)))
    found = findings(special, "equations")[0].found
    assert "on arrays they do not say what they say on floats, such as at x = [" in found


def test_compiled_or_not(monkeypatch):
    pytest.importorskip("numba")
    machine_code = "large batches of environments run as machine code"
    assert one(Oscillator(), "compiled", "ok").found == f"{machine_code}, and so do single ones"
    cubic = made(f=lambda self, x: (x[1], -(x[0] ** 3)))
    assert "single ones take their steps in Python (ValueError: f has a power" in one(cubic, "compiled", "ok").found
    monkeypatch.setattr(training.checking.subject, "batch_step", kkl_gym.compiled.batch_step)
    assert "not integrated" in one(Sampled(), "compiled", "ok").found
    of_numpy = made(f=lambda self, x: (x[1], -np.sin(x[0])))
    assert "several times slower: " in one(of_numpy, "compiled", "note").found
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert one(Oscillator(), "compiled", "note").advice == 'pip install "kkl-gym[fast]"'


def drawn(*shape):
    return lambda self, rng, n, factor=1.0: 20 * factor * rng.uniform(-1, 1, (n, *shape))


LONG = {"duration": 5.0}
NO_INPUT = {"u_max": (), "G": ()}
OFF_TARGET = {"X": ((-2, 2), (-1, 1)), "f": lambda self, x: (x[1], 1.0 - x[0])}  # at rest at (1, 0)
SETTLING = NO_INPUT | {"f": lambda self, x: (-5.0 * x[0], x[0] - 5.0 * x[1])}
UPRIGHT = {"f": lambda self, x: (x[1], 4.0 * x[0]), "bounds": ((-4, 4), (-8, 8)), "u_max": (20.0,)}
FAST = UPRIGHT | {"f": lambda self, x: (x[1], 400.0 * x[0]), "u_max": (1000.0,), "dt": 0.1}
HIGH = {"rate": lambda self, x: 300.0 + 0.0 * x[0]}
BLIND = NO_INPUT | {
    "state_names": ("x1", "x2", "bias"),
    "X": ((-1, 1), (-1, 1), (-1, 1)),
    "bounds": ((-30, 30), (-30, 30), (-30, 30)),
    "f": lambda self, x: (x[1], -x[0], 0.0 * x[0]),
}


@pytest.mark.parametrize(
    ("name", "verdict", "changes", "options", "found", "advice"),
    [
        ("finite", "problem", {"f": lambda self, x: (x[1], -sqrt(x[0] + 0.5))}, {}, " % of X, ",
         "draw the bounds, and X, where the equations hold, which is for x1 above -0.4"),
        ("finite", "problem", {"f": lambda self, x: (x[1], -sqrt(x[0] + x[1]))}, {}, "of the bounds",
         "draw the bounds, and X, where the equations hold, or change the equations"),
        ("inputs", "problem", {"u_max": (1.0, 1.0), "G": ((0.0, 0.0), (1.0, 0.0))}, {}, "input 2 moves no state",
         "give column 2 of G"),
        ("inputs", "ok", {"g": lambda self, x: ((0.0,), (2.0 + 0.0 * x[0],))}, {}, "moves x2 by 1 per second", ""),
        ("starts", "problem", {"draw_starts": drawn()}, {}, "draw_starts(rng, 100, 1) returns starts of shape (100,)",
         "return an array of shape (100, 2)"),
        ("starts", "problem", {"draw_starts": drawn(2)}, {}, "draw_starts(rng, 100, 2) lie beyond the bounds",
         "draw them within the bounds"),
        ("rate", "problem", {"rate": lambda self, x: 0.01 + 0.0 * x[0]}, {},
         "the fastest eigenvalue of df/dx is 1/s at the median", "leave rate(x) out, whose default says 1.41/s"),
        ("rate", "note", HIGH, {}, "The norm of df/dx is 1.41/s", "lower rate(x)"),
        ("rate", "note", {"X": ((-1, 1), (-1e4, 1e4)), "bounds": ((-1e6, 1e6), (-1e6, 1e6))}, {},
         "The fastest eigenvalue of df/dx is 1/s", "let X's half-widths fit"),
        ("bounds", "problem", UPRIGHT, LONG, "50 of 50 free and 50 of 50 driven leave them",
         "train with --policy controller, under which 100 of 100 stay"),
        ("bounds", "problem", UPRIGHT | {"u_max": (0.01,)}, LONG, "leave them", "--policy script.py:function"),
        ("bounds", "problem", FAST, LONG, "leave them", "or take a smaller dt"),
        ("bounds", "problem", UPRIGHT | NO_INPUT, LONG, "leave them", "10 times as wide: shrink X"),
        ("sampling", "ok", {}, {"dt": 0.05, "duration": 60.0},
         "dt = 0.05 s, motions of 60 s (the rate suggests 0.01 and 50 s)", ""),
        ("sampling", "note", {}, {"dt": 0.7, "duration": 60.0}, "dt = 0.7 s", "samples are few: take dt = 0.1 s"),
        ("sampling", "problem", {}, {"dt": 1.5, "duration": 60.0}, "dt = 1.5 s",
         "the motion between samples is lost: take dt = 0.1 s"),  # 2 pi / 0.1: some sixty samples a period
        ("sampling", "note", {}, {"duration": 0.5}, "motions of 0.5 s",
         "motions end before the slow part has moved: take a duration of 5 s"),
        ("output", "problem", {"h": lambda self, x: (x[0], 0.0 * x[0] + 2.5)}, {}, "y2 is 2.5 everywhere in X",
         "let h measure something that moves, or leave this output out"),
        ("output", "note", {"measurement_noise": 1.0}, {}, "noise 1 by default",
         "set measurement_noise: 0.1 is 5 % of the range"),
        ("output", "note", SETTLING, LONG, "hardly any more in their second half", "a shorter duration shows more"),
        ("process noise", "ok", {"process_noise": 0.0}, {}, "none by default", ""),
        ("process noise", "problem", {"process_noise": 5.0}, {"duration": 50.0},
         "over 50 s it leads 2.04 half-widths of X away", "set process_noise = 0.05, "),  # 5 sqrt(0.01 50 / 3)
        ("target", "problem", OFF_TARGET, {}, "target (0, 0), the default, is no equilibrium, and no input within its "
         "bounds makes it one: x' = (0, 0.5) per second at best", "let target return an equilibrium, such as (1, 0)"),
        ("target", "ok", OFF_TARGET | {"u_max": (1.5,)}, {},
         "target (0, 0), the default, is an equilibrium under u = (-1)", ""),
        ("target", "note", OFF_TARGET | NO_INPUT, {}, "x' = (0, 1) per second", "let target return an equilibrium"),
        ("target", "problem", {"f": lambda self, x: (x[1] + 3.0, 1.0 - x[0])}, {}, "is no equilibrium",
         "let target return a state at which some input within its bounds holds"),
        ("target", "problem", {"target": (0.0,)}, {}, "is no state", "return 2 finite numbers"),
        ("target", "problem", {"target": (50.0, 0.0)}, {}, "lies beyond the bounds", "such as (0, 0)"),
        ("target", "note", {"target": (2.0, 0.0)}, {}, "lies beyond X", "such as (0, 0)"),
        ("observability", "note", UPRIGHT, {}, "no error can be predicted for motions without input", "mend first"),
        ("observability", "problem", BLIND, {}, "y tells nothing of bias at the start", "let h measure bias too, or"),
        ("observability", "problem", BLIND | {"f": lambda self, x: (x[1] + x[2], 0.0 * x[0], 0.0 * x[0])}, {},
         "y tells nothing of a combination of x2 and bias at the start", "let h measure x2 or bias too"),
        ("observability", "note", BLIND | {"h": lambda self, x: (x[0] + 1e-3 * x[2],)}, {}, "y tells little of bias",
         "let h measure bias too"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_found_and_how_to_change_it(name, verdict, changes, options, found, advice):
    said = one(made(**changes), name, verdict, **options)
    assert found in said.found
    assert advice in said.advice
    assert bool(said.advice) == (verdict != "ok")


def test_a_system_without_a_rate(monkeypatch):
    monkeypatch.setattr("training.checking.THEN", {"rate": THEN["rate"]})
    found = one(made(f=lambda self, x: (0.0 * x[0], 0.0 * x[1])), None)
    assert found.check == "rate"
    assert "override it to say how fast f changes" in found.found


def test_bounds_that_are_too_narrow():
    elongated = {"f": lambda self, x: (4.0 * x[1], -0.25 * x[0])}  # x1 swings four times as far as x2
    found = one(made(Autonomous, bounds=((-1.3, 1.3), (-3, 3)), **elongated), "bounds", dt=0.1, duration=20.0)
    assert "leave them" in found.found
    assert "most often x1" in found.found
    low, high = map(float, found.advice.removeprefix("widen the bounds of x1 to (").removesuffix(")").split(","))
    assert -4.6 < low < -4.0  # sqrt(17) and some room
    assert 4.0 < high < 4.6
    wide = made(Autonomous, bounds=((1.2 * low, 1.2 * high), (-3, 3)), **elongated)
    assert one(wide, "bounds", "ok", dt=0.1, duration=20.0)


def test_a_system_that_only_a_policy_holds():
    upright = made(**UPRIGHT)
    assert findings(upright, "bounds", policy=controller(upright), **LONG)[0].verdict == "ok"
    found = one(upright, "bounds", policy=lambda x: np.zeros((len(x), 1)), **LONG)
    assert "100 of 100 under the policy leave them" in found.found
    assert found.advice.startswith("let the policy hold the system")


def test_motions_that_need_too_many_substeps(monkeypatch):
    def fails(*args, **options):
        raise dynamics.SubstepsError("stiff changes at a rate of 1e+09/s; take a smaller dt")

    monkeypatch.setattr("training.checking.subject.simulate", fails)
    found = one(Oscillator(), None)
    assert (found.check, found.found) == ("bounds", "stiff changes at a rate of 1e+09/s")
    assert found.advice == "take a smaller dt"
    (found,) = (one for one in findings(Oscillator(), dt=1e6) if one.check == "sampling")
    assert "would need more than" in found.found
    assert found.advice.startswith("take dt <= ")


def test_steps_that_take_long_and_samples_that_tell_nothing_new(monkeypatch):
    monkeypatch.setattr(dynamics, "SLOW", 0.0)
    assert "lower dt" in one(Oscillator(), "speed", "note").advice
    assert "lower rate(x)" in one(made(**HIGH), "speed", "note").advice
    monkeypatch.setattr(dynamics, "IDLE", 0.02)
    found = one(Oscillator(), "sampling", "note", duration=10.0)
    assert found.advice == "samples tell hardly anything new: take dt = 0.05 s"


@pytest.mark.parametrize(("smooth", "seconds"), [(1e-30, 100), (1e-3, 500)])
def test_motions_that_come_to_where_f_is_steep(smooth, seconds, monkeypatch):
    """Two tanks that run empty. Of 1,000 intervals those are followed that 1,000 substeps make, or 200."""
    monkeypatch.setattr("training.checking.subject.STEPS", 1000)
    monkeypatch.setattr("training.checking.subject.MOTIONS", 20)
    monkeypatch.setattr("training.checking.THEN", {"bounds": THEN["bounds"]})
    tanks = NO_INPUT | {"X": ((0.05, 0.6), (0.05, 0.6)), "bounds": ((-0.1, 2), (-0.1, 2)), "dt": 0.5, "duration": 500.0}

    def f(self, x):
        outflow = [0.0144 * level / sqrt(absolute(level) + smooth) for level in x]
        return -outflow[0], outflow[0] - outflow[1]

    *_, bounds = findings(made(**tanks, f=f), duration=None)
    assert bounds.found.startswith(f"all of 20 motions of {seconds} s stay within them")


def test_motions_that_are_lost_take_no_substeps():
    leaving = made(f=lambda self, x: (10.0 + 0.0 * x[0], 0.0 * x[1]))
    assert Subject(leaving, 0.01, 30.0).affordable() == 30.0


def test_a_state_of_which_y_tells_nothing_but_which_the_motion_forgets():
    forgotten = made(**BLIND | {"f": lambda self, x: (x[1], -x[0], -2.0 * x[2])})
    (found,) = (one for one in findings(forgotten, "observability") if "nothing" in one.found)
    assert found.verdict == "note"
    assert "forgets by itself" in found.found


def test_a_spectrum_that_makes_T_smooth(monkeypatch):
    monkeypatch.setattr(training.smoothness, "FOLLOWED", 30.0)
    assert one(Oscillator(), "spinn", "ok").found.startswith("T is smooth for the eigenvalues -")
    monkeypatch.setattr(training.smoothness, "SMOOTH", 2.0)
    assert "--pipeline input-aware" in one(Oscillator(), "spinn", "note").advice
