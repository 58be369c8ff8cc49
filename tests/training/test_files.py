"""Atomic writing of files, tables, and the folders of runs and jobs."""

import errno
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

import training
from kkl_gym import System, get_system
from training.files import (
    check_identity,
    claimed_job,
    claimed_run,
    clear_unfinished,
    require_writable,
    write,
)
from training.trajectories.equations import describe


def test_a_folder_that_one_may_not_write_to(tmp_path, monkeypatch):
    require_writable(tmp_path / "new" / "folder")
    assert not os.listdir(tmp_path)

    def refuse(self=None, **options):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self or f"{options['dir']}/.part-1"))

    monkeypatch.setattr(Path, "touch", refuse)
    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    with pytest.raises(PermissionError, match=re.escape(f"Permission denied: '{tmp_path / 'a'}'")):
        write(tmp_path / "a", "text")
    with pytest.raises(PermissionError, match=re.escape(f"Permission denied: '{tmp_path}'")):
        require_writable(tmp_path)
    assert not os.listdir(tmp_path)


KILLED = """
import os, signal, sys
from observers import storage

with storage.replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_unfinished_files_of_killed_processes_are_removed(tmp_path):
    path = tmp_path / "new" / "a.txt"
    write(path, "whole")
    before = path.read_bytes()
    root = str(Path(training.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], env={**os.environ, "PYTHONPATH": root}, timeout=60)
    assert done.returncode == -9
    assert path.read_bytes() == before
    (left,) = {*path.parent.iterdir()} - {path}
    clear_unfinished(path.parent)
    assert left.exists()  # a running process may be writing this file
    for file in (left, path):
        os.utime(file, (time.time() - 3700.0,) * 2)
    with claimed_run(path.parent, {}, resume=False):
        assert sorted(os.listdir(path.parent)) == [".lock", path.name, "config.json"]


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="this system has no links")
def test_targets_of_links_are_not_removed(tmp_path):
    kept = tmp_path / "kept" / "file"
    kept.parent.mkdir()
    kept.touch()
    link = tmp_path / ".part-link"
    link.symlink_to(kept.parent, target_is_directory=True)
    for path in (link, kept.parent, kept):
        os.utime(path, (time.time() - 3700.0,) * 2, follow_symlinks=False)
    clear_unfinished(tmp_path)
    assert kept.exists()
    assert not link.is_symlink()


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
    with claimed_run(tmp_path, other, resume=False):  # the other process left no checkpoints
        assert json.loads((tmp_path / "config.json").read_text()) == other


def test_checkpoints_are_not_overwritten(tmp_path):
    with claimed_run(tmp_path, {"width": 8}, resume=False):
        (tmp_path / "inverse.checkpoint.pt").touch()
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


@pytest.mark.parametrize("text", ["", "{", "3", "[]", "[1]"])
def test_identities_that_are_damaged(text, tmp_path):
    path = tmp_path / "job.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"job.json is damaged; remove it"):
        check_identity(path, {"seed": 0}, "another job")


def test_descriptions_of_systems_differ():
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


def test_descriptions_of_small_systems_differ():
    assert describe(Tiny())["equations"] != describe(Tiny(0.06))["equations"]
