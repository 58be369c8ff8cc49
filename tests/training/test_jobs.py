"""Who may work in a folder."""

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from kkl_gym import System, get_system
from observers.storage import UNFINISHED
from training.files import check_identity, claimed_job, claimed_run, describe

HOLDER = """
import sys
from pathlib import Path

from training.files import claimed_run

with claimed_run(Path(sys.argv[1]), {"width": 8}, resume=False):
    print("claimed", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held_by_another_process(folder):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    arguments = [sys.executable, "-c", HOLDER, folder]
    with subprocess.Popen(
        arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as holder:
        assert holder.stdout.readline() == "claimed\n"
        yield
        holder.stdin.close()


def test_two_trainings_do_not_share_a_folder(tmp_path):
    other = {"width": 16}
    with held_by_another_process(tmp_path):
        for resume in (False, True):
            with pytest.raises(ValueError, match="another process is at work in"), claimed_run(tmp_path, other, resume):
                raise AssertionError
        assert json.loads((tmp_path / "config.json").read_text()) == {"width": 8}
    with claimed_run(tmp_path, other, resume=False):  # it left no checkpoints
        assert json.loads((tmp_path / "config.json").read_text()) == other


@pytest.mark.parametrize("described", [True, False])
def test_checkpoints_are_not_overwritten_without_being_told(described, tmp_path):
    with claimed_run(tmp_path, {"width": 8}, resume=False):
        (tmp_path / "inverse.checkpoint.pt").touch()
    if not described:
        (tmp_path / "config.json").unlink()
    with pytest.raises(ValueError, match="holds the checkpoints of a run"), claimed_run(tmp_path, {"width": 8}, False):
        raise AssertionError
    with claimed_run(tmp_path, {"width": 8}, resume=True):
        pass
    with (
        pytest.raises(ValueError, match="a run of another configuration: width = 8 there, 9 here"),
        claimed_run(tmp_path, {"width": 9}, resume=True),
    ):
        raise AssertionError


def test_a_job_keeps_its_folder(tmp_path):
    described = {"levels": (0.0, 0.5), "seed": 0}
    for _ in range(2):
        with claimed_job(tmp_path / "job", described, "another job"):
            assert json.loads((tmp_path / "job" / "job.json").read_text()) == {"levels": [0.0, 0.5], "seed": 0}
    with (
        pytest.raises(ValueError, match=r"holds another job: seed = 0 there, None here; width = None there, 3 here"),
        claimed_job(tmp_path / "job", {"levels": (0.0, 0.5), "width": 3}, "another job"),
    ):
        raise AssertionError


def test_who_locks_a_folder_clears_away_what_killed_processes_left(tmp_path):
    half = tmp_path / f"{UNFINISHED}1234-inverse.checkpoint.pt"
    half.write_bytes(b"half")
    with claimed_run(tmp_path, {"width": 8}, resume=False):  # it is no checkpoint
        assert half.exists()
    os.utime(half, (0.0, 0.0))
    with claimed_run(tmp_path, {"width": 8}, resume=False):
        assert not half.exists()


@pytest.mark.parametrize("text", ["", "{", "3", "[]", "[1]"])
def test_identities_that_are_damaged(text, tmp_path):
    path = tmp_path / "job.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"job.json is damaged, remove it"):
        check_identity(path, {"seed": 0}, "another job")


def test_a_system_is_told_from_another():
    lorenz = get_system("lorenz")
    assert describe(lorenz) == describe(get_system("lorenz"))
    other = describe(lorenz.replace({"rho": 30.0}))
    assert {name for name, value in describe(lorenz).items() if value != other[name]} == {"parameters", "equations"}


@dataclass(frozen=True)
class Tiny(System):
    decay: float = 0.03

    name = "tiny"
    X = bounds = ((-2e-6, 2e-6),)

    def f(self, x):
        return (-self.decay * x[0],)

    def h(self, x):
        return (x[0],)


def test_equations_of_small_numbers_are_told_apart():
    assert describe(Tiny())["equations"] != describe(Tiny(0.06))["equations"]
