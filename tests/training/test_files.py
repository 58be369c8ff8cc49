import errno
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

import training
from training.files import clear_unfinished, is_kind, require_writable, write


def test_text_is_written_with_its_folder(tmp_path):
    write(tmp_path / "folder" / "a.txt", "text\n")
    assert (tmp_path / "folder" / "a.txt").read_bytes() == b"text\n"


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


def test_a_kind_is_known_by_the_header(tmp_path):
    path = tmp_path / "a.safetensors"
    save_file({"a": np.zeros(2)}, path, metadata={"ours": "{}"})
    assert is_kind(path, "ours")
    assert not is_kind(path, "theirs")
    path.write_bytes(b"no tensors")
    os.mkfifo(tmp_path / "pipe")
    assert not any(is_kind(tmp_path / name, "ours") for name in ("a.safetensors", "none", "pipe", ""))


KILLED = """
import os, signal, sys
from observers import storage

with storage.replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_killed_processes_leave_is_cleared_away(tmp_path):
    path = tmp_path / "a.txt"
    write(path, "whole")
    before = path.read_bytes()
    root = str(Path(training.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], env={**os.environ, "PYTHONPATH": root}, timeout=60)
    assert done.returncode == -9
    assert path.read_bytes() == before
    (left,) = {*path.parent.iterdir()} - {path}
    clear_unfinished(path.parent)
    assert left.exists()  # somebody may be at work on it
    for file in (left, path):
        os.utime(file, (time.time() - 3700.0,) * 2)
    clear_unfinished(path.parent)
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="this system has no links")
def test_what_is_linked_to_stays(tmp_path):
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
