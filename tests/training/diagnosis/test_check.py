"""Checks of systems with deliberate faults, each with its finding, and of systems without problems."""

import importlib.util
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import linear_system
import numpy as np
import pytest
from discrete_systems import Sampled
from linear_system import Oscillator

import kkl_gym.compiled
import training.diagnosis.system
from kkl_gym import SYSTEMS, get_system
from kkl_gym.elementary import sqrt
from kkl_gym.systems import Lorenz
from training.cli import main
from training.diagnosis import CHECKS, check
from training.diagnosis.system import Subject
from training.presets import controller

EXAMPLES = Path(__file__).parents[3] / "examples"


def made(base=Oscillator, **changes):
    """A system like `base` with some other attributes."""
    return type("Made", (base,), {"name": "made", **changes})()


def findings(system, name=None, *, dt=None, duration=2.0, policy=None):
    """Findings of one check, or of all checks."""
    if name is None:
        return list(check(system, dt=dt, duration=duration, policy=policy))
    return list(CHECKS[name](Subject(system, dt or system.dt, duration, policy, (system.measurement_noise,))))


def one(system, name, verdict="problem", **options):
    (found,) = (one for one in findings(system, name, **options) if one.verdict == verdict)
    return found


def problems(system, **options):
    return [one for one in findings(system, **options) if one.verdict == "problem"]


def test_a_system_that_ships():
    found = findings(get_system("van_der_pol"))
    assert "problem" not in {one.verdict for one in found}
    assert {one.check for one in found} == set(CHECKS)
    assert all(bool(one.advice) == (one.verdict != "ok") for one in found)


def test_the_page_explains_every_line_of_its_example():
    page = (EXAMPLES.parent / "docs" / "guides" / "diagnose.md").read_text(encoding="utf-8")
    for name in CHECKS:
        assert f"\n| {name} |" in page


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


def test_the_command_prints_a_table_of_findings(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")
    options = ["--dt", "0.05", "--duration", "2", "--policy", "controller", "--json", str(tmp_path / "found.json")]
    main(["diagnose", f"{linear_system.__file__}:Oscillator", *options])
    shown = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("checking ")]  # if it is slow
    assert shown[-1] == "no problems, no notes"
    for line, finding in zip(shown[:-1], json.loads((tmp_path / "found.json").read_text()), strict=True):
        assert line.split()[0] == finding["verdict"] == "ok"
        assert finding["check"] in line
        assert finding["found"] in line


def on_a_circle(self, rng, n, factor=1.0):
    angle = rng.uniform(0, 2 * np.pi, n)
    return factor * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def test_discrete_time_and_starts_of_its_own():
    system = made(Sampled, draw_starts=on_a_circle)
    found = {one.check: one for one in findings(system)}
    assert "problem" not in {one.verdict for one in found.values()}
    assert found["equations"].found == "step and h work on floats, arrays, symbols"
    assert found["observability"].found.startswith("x2: least error, relative to ")
    with pytest.raises(ValueError, match="makes only steps"):
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
        main(["diagnose", f"{__file__}:Branching", "--parameters", "gain=2", "--json", str(tmp_path / "found.json")])
    assert end.value.code == 1
    shown = capsys.readouterr().out
    assert "→ as it is, batches, training and evaluation do not run" in shown
    assert shown.splitlines()[-1] == "1 problem, 2 notes"
    found = json.loads((tmp_path / "found.json").read_text())
    (wrong,) = (one["found"] for one in found if one["verdict"] == "problem")
    assert wrong in shown  # square brackets are not parsed as markup
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


def test_compiled_or_not(monkeypatch):
    pytest.importorskip("numba")
    machine_code = "large batches of environments run as machine code"
    assert one(Oscillator(), "compiled", "ok").found == f"{machine_code}, and so do single ones"
    cubic = made(f=lambda self, x: (x[1], -(x[0] ** 3)))
    assert "single ones take their steps in Python (ValueError: there is a power" in one(cubic, "compiled", "ok").found
    monkeypatch.setattr(training.diagnosis.system, "batch_step", kkl_gym.compiled.batch_step)
    assert "not integrated" in one(Sampled(), "compiled", "ok").found
    of_numpy = made(f=lambda self, x: (x[1], -np.sin(x[0])))
    assert "several times slower: " in one(of_numpy, "compiled", "note").found
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert one(Oscillator(), "compiled", "note").advice == 'pip install "kkl-gym[fast]"'


LONG = {"duration": 5.0}
NO_INPUT = {"u_max": (), "G": ()}
UPRIGHT = {"f": lambda self, x: (x[1], 4.0 * x[0]), "bounds": ((-4, 4), (-8, 8)), "u_max": (20.0,)}
BLIND = NO_INPUT | {
    "state_names": ("x1", "x2", "bias"),
    "X": ((-1, 1), (-1, 1), (-1, 1)),
    "bounds": ((-30, 30), (-30, 30), (-30, 30)),
    "f": lambda self, x: (x[1], -x[0], 0.0 * x[0]),
}


@pytest.mark.parametrize(
    ("name", "verdict", "changes", "options", "found", "advice"),
    [
        ("equations", "problem", {"f": lambda self, x: (x[1], -sqrt(x[0] + 0.5))}, {}, " % of 2X, such as",
         "choose X and the bounds where the equations hold, or change the equations"),
        ("equations", "problem", {"u_max": (1.0, 1.0), "G": ((0.0, 0.0), (1.0, 0.0))}, {}, "input 2 moves no state",
         "give column 2 of G"),
        ("bounds", "problem", UPRIGHT, LONG, "50 of 50 free and 50 of 50 driven leave the bounds",
         "widen the bounds, shrink X, shorten the motions, reduce u_max, or give a policy"),
        ("sampling", "note", {}, {"dt": 0.7, "duration": 60.0}, "dt = 0.7 s", "samples are few: take dt = 0.1 s"),
        ("sampling", "problem", {}, {"dt": 1.5, "duration": 60.0}, "dt = 1.5 s",
         "the motion between samples is lost: take dt = 0.1 s"),  # about sixty samples per period, 2 pi
        ("output", "problem", {"h": lambda self, x: (x[0], 0.0 * x[0] + 2.5)}, {}, "y2 is 2.5 everywhere in X",
         "let h measure something that moves, or leave this output out"),
        ("observability", "problem", BLIND, {}, "y does not determine bias", "let h measure bias too, or"),
        ("observability", "problem", BLIND | {"f": lambda self, x: (x[1] + x[2], 0.0 * x[0], 0.0 * x[0])}, {},
         "y does not determine a combination of x2 and bias", "let h measure x2 or bias too"),
        ("observability", "note", BLIND | {"h": lambda self, x: (x[0] + 1e-3 * x[2],)}, {}, "y hardly determines bias",
         "let h measure bias too"),
    ],
)  # fmt: skip
def test_findings_name_the_fault_and_the_fix(name, verdict, changes, options, found, advice):
    finding = one(made(**changes), name, verdict, **options)
    assert found in finding.found
    assert advice in finding.advice
    assert bool(finding.advice) == (verdict != "ok")


def test_a_system_that_only_a_policy_holds():
    upright = made(**UPRIGHT)
    assert findings(upright, "bounds", policy=controller(upright, upright.dt), **LONG)[0].verdict == "ok"
    found = one(upright, "bounds", policy=lambda x: np.zeros((len(x), 1)), **LONG)
    assert "100 of 100 under the policy leave the bounds" in found.found
    assert found.advice.endswith("reduce u_max, or reduce dt")


def test_starts_of_another_shape_end_the_check():
    *_, wrong, left_out = findings(made(draw_starts=lambda self, rng, n, factor=1.0: rng.uniform(-1, 1, n)))
    assert wrong.found == "draw_starts(rng, 100, 1) returns starts of shape (100,)"
    assert wrong.advice == "return (100, 2)"
    assert left_out.found == "all other checks are left out"


def test_motions_that_need_too_many_substeps():
    (found,) = (one for one in findings(Oscillator(), dt=1e6) if one.verdict == "problem")
    assert (found.check, "would need more than" in found.found) == ("sampling", True)


def test_equations_that_divide_by_zero_in_the_middle_of_X():
    found = findings(made(g=lambda self, x: ((0.0,), (1 / x[0],))))[-1]
    assert (found.check, found.verdict, found.found) == ("sampling", "problem", "float division by zero")


@dataclass(frozen=True)
class ThroughThird(Lorenz):
    """Lorenz with the output x3 and an input on x3: (x1, x2) -> (-x1, -x2) is a symmetry."""

    name: ClassVar[str] = "lorenz_through_x3"
    G: ClassVar = ((0.0,), (0.0,), (1.0,))

    def h(self, x):
        return (x[2],)


def test_a_symmetry_is_no_poor_observability():
    found = findings(ThroughThird(), "observability", duration=6.0)
    assert [one.verdict for one in found] == ["problem", "ok"]
    assert found[0].found.startswith("y determines x1, x2 only locally: distant states")
    assert not any("only locally" in one.found for one in findings(Lorenz(), "observability", duration=6.0))


@pytest.mark.parametrize(
    "changes",
    [
        {"f": lambda self, x: (-x[0], 0.0 * x[0]), "g": lambda self, x: ((x[1],), (0.0,))},  # x1' = -x1 + x2 u
        {"h": lambda self, x: (x[0] ** 2,)},  # without an input, x and -x have the same output
    ],
)
def test_states_that_only_an_input_makes_observable(changes):
    assert {one.verdict for one in findings(made(**changes), "observability", duration=10.0)} == {"ok"}
    if "h" in changes:
        found = one(made(**NO_INPUT | changes), "observability", duration=10.0).found
        assert found.startswith("y determines x1, x2 only locally")


def test_noise_that_hides_a_state():
    system = made(h=lambda self, x: (x[0], x[1]), measurement_noise=(300.0, 200.0))
    for name, found in zip(("x1", "x2"), findings(system, "observability")):
        assert found.verdict == "note"
        assert re.search(r"; 1\d\d % at noise 300, 200; ", found.found)
        assert found.found.endswith("at noise 300, 200, y shows nothing of it")
        assert found.advice == f"reduce the noise, or let h measure another quantity that depends on {name}"
