"""The steps in docs/guides/own_system.md, followed literally in a copy of the packages."""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from training.presets import Profile

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "guides" / "own_system.md").read_text()

# The line above a block of code tells the reader how to use the block.
NEW = re.compile(r"New file `(?P<path>[^`]+)`:")
EDIT = re.compile(r"In `(?P<path>[^`]+)`, (?P<where>below|in place of) the line that begins with `(?P<line>[^`]+)`:")
SCRIPT, LOOK, FULL = "This runs now:", "For a first look", "In full"


def blocks():
    """The line above each block of code, its language, and its text."""
    found = re.findall(r"([^\n]+)\n\n```(\w+)\n(.*?)```\n", PAGE, re.DOTALL)
    assert len(found) == PAGE.count("```") // 2
    return found


def edit(text, where, line, new):
    """Insert `new` below the first line that begins with `line`, or in its place."""
    lines = text.splitlines(keepends=True)
    at = next(i for i, one in enumerate(lines) if one.startswith(line))
    lines[at] = lines[at] + new if where == "below" else new
    return "".join(lines)


@pytest.mark.slow
def test_following_the_page_adds_a_system(tmp_path):
    """All steps except the full trainings, in one test, which copies the packages once."""
    root = tmp_path
    for package in ("kkl_gym", "observers", "training"):
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", root)
    (root / "bin").mkdir()
    command = root / "bin" / "kkl-gym"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m training "$@"\n')
    command.chmod(0o755)
    path = os.pathsep.join([str(command.parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}

    def do(*arguments):
        done = subprocess.run(arguments, cwd=root, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{arguments[-1]}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    written = set()
    for label, language, text in blocks():
        if found := NEW.fullmatch(label) or EDIT.fullmatch(label):
            file = root / found["path"]
            assert file.exists() == (found.re is EDIT)
            file.write_text(text if found.re is NEW else edit(file.read_text(), found["where"], found["line"], text))
            written.add(found["path"])
        elif label.endswith(SCRIPT):
            do(sys.executable, "-c", text)
        elif label.startswith(LOOK):
            do("sh", "-e", "-c", text)
        else:
            assert label.startswith(FULL), f"no instruction above\n{text}"
            assert language == "sh"
    for check in (("check",), ("format", "--check")):
        do(sys.executable, "-m", "ruff", *check, *sorted(written))

    look = root / "runs" / "first-look"
    assert {path.name for path in look.iterdir() if path.is_file()} >= {"fitzhugh_nagumo.safetensors", "report.png"}
    assert (look / "agent" / "agent.safetensors").exists()
    checks = """
import numpy as np
import observers
from kkl_gym import ENV_IDS, get_system
from training.agents.agent import Agent
from training.presets import preset
from training.agents.tasks import TASKS
from training.presets import controller

assert list(ENV_IDS)[-1] == "fitzhugh_nagumo" and ENV_IDS["fitzhugh_nagumo"] == "KKLFitzHughNagumo-v0"
system = get_system("fitzhugh_nagumo")
assert np.allclose(system.f(system.target), 0.0, atol=1e-12)
assert np.allclose(controller(system, system.dt)(np.array([system.target])), 0.0)
assert preset(system, "input-aware", "fast").eigenvalues[0] == -0.1
assert observers.load("fitzhugh_nagumo", 0.5, monitor=True).artifact.system == "fitzhugh_nagumo"
agent = Agent.read("runs/first-look/agent/agent.safetensors")
assert agent.observer == "fitzhugh_nagumo" and agent.task == TASKS["fitzhugh_nagumo"]
"""
    do(sys.executable, "-c", checks)


def test_a_first_look_is_the_command_in_full_made_small():
    commands = {LOOK: [], FULL: []}
    for label, language, text in blocks():
        if language == "sh":
            commands[LOOK if label.startswith(LOOK) else FULL].append(text.strip())
    assert len(commands[LOOK]) == len(commands[FULL]) >= 3
    for small, full in zip(commands[LOOK], commands[FULL], strict=True):
        assert small.startswith(f"{full} --") or full.startswith("cp ")


def test_the_table_has_every_field_of_a_profile():
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == [one.name for one in dataclasses.fields(Profile)]
