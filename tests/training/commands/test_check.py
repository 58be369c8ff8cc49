"""``kkl-gym check``."""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import linear_system
import pytest
from linear_system import Oscillator

import training.checking.subject
from kkl_gym.compiled import SamplingStep
from kkl_gym.simulate import advance_batch
from training.cli import main


@dataclass(frozen=True)
class Named(Oscillator):
    """Written where no array can follow."""

    gain: float = 1.0

    name: ClassVar[str] = "named"

    def f(self, x):
        return x[1], -self.gain * x[0] if x[0] > 0 else -x[0]


@pytest.fixture(autouse=True)
def _nothing_is_compiled(monkeypatch):
    in_numpy = functools.partial(functools.partial, advance_batch)
    monkeypatch.setattr(training.checking.subject, "batch_step", lambda system: SamplingStep(in_numpy(system)))
    monkeypatch.setenv("COLUMNS", "400")


def test_a_table_of_findings(capsys):
    options = ["--dt", "0.05", "--duration", "2", "--policy", "controller", "--json", "found.json"]
    main(["check", f"{linear_system.__file__}:Oscillator", *options])
    shown = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("checking ")]  # if it is slow
    assert shown[-1] == "no problems, no notes"
    found = json.loads(Path("found.json").read_text())
    for line, finding in zip(shown[:-1], found, strict=True):
        assert line.split()[0] == finding["verdict"] == "ok"
        assert finding["check"] in line
        assert finding["found"] in line
    assert any("under the policy" in finding["found"] for finding in found)


def test_a_problem_is_shown_with_advice_and_ends_with_status_1(capsys):
    with pytest.raises(SystemExit) as end:
        main(["check", f"{__file__}:Named", "--parameters", "gain", "2", "--json", "found.json"])
    assert end.value.code == 1
    shown = capsys.readouterr().out
    assert "gain = 2" in shown
    assert "x[0] > 0" in shown  # square brackets are no markup
    assert "→ as it is, batches, training and evaluation do not run" in shown
    assert shown.splitlines()[-1] == "1 problem, 3 notes"
    assert "problem" in {finding["verdict"] for finding in json.loads(Path("found.json").read_text())}
