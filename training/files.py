"""Atomic writing of files, and folders in which only one process works at a time."""

import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from observers.storage import UNFINISHED, replacing

CHECKPOINTS = "[!.]*.checkpoint.*"  # checkpoints of a run or an agent; names of unfinished files begin with a dot
ABANDONED = 3600.0  # a temporary file counts as abandoned if its last write was more than this many seconds ago


def write(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all, and make its folder."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lay out a table in Markdown."""
    first, *others = ("".join(f"| {cell} " if cell else "| " for cell in line) + "|" for line in (header, *rows))
    return [first, "|---" * len(header) + "|", *others]


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Raise OSError if files cannot be written to a folder; commands call this before long work."""
    path = Path(folder)
    existing = next((one for one in (path, *path.parents) if one.exists()), path)
    try:
        tempfile.TemporaryFile(dir=existing, prefix=UNFINISHED).close()
    except OSError as problem:  # its message names the temporary file, not the folder
        raise OSError(problem.errno, problem.strerror, str(folder)) from problem


def clear_unfinished(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files and folders that killed processes left, if nothing was written to them for an hour."""
    for unfinished in Path(folder).glob(f"{UNFINISHED}*"):
        with suppress(OSError):  # another process may remove files too, and some belong to other users
            written = [unfinished, *unfinished.rglob("*")]  # writing to a file does not change its folder's time
            if time.time() - max(path.lstat().st_mtime for path in written) > ABANDONED:
                if unfinished.is_dir() and not unfinished.is_symlink():
                    shutil.rmtree(unfinished)
                else:
                    unfinished.unlink()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes, and remove the unfinished files of killed processes."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(folder / ".lock", timeout=0).acquire()
    except Timeout:
        raise ValueError(f"another process is at work in {folder}") from None
    with lock:
        clear_unfinished(folder)
        yield


@contextmanager
def claimed_job(folder: Path, described: Mapping[str, Any], what: str) -> Iterator[None]:
    """Lock a job's folder and write the job's identity; raise ValueError if the folder holds another job."""
    with locked(folder):
        check_identity(folder / "job.json", described, what)
        write(folder / "job.json", json.dumps(described, indent=2) + "\n")
        yield


@contextmanager
def claimed_run(folder: Path, described: Mapping[str, Any], resume: bool) -> Iterator[None]:
    """Lock a run's folder and write its configuration; ValueError at checkpoints, with ``resume`` at another run's."""
    with locked(folder):
        if not resume:
            refuse_checkpoints(folder)
        elif any(folder.glob(CHECKPOINTS)):
            check_identity(folder / "config.json", described, "a run of another configuration")
        write(folder / "config.json", json.dumps(described, indent=2) + "\n")
        yield


def refuse_checkpoints(folder: Path) -> None:
    """Raise ValueError if a folder holds the checkpoints of a run."""
    if any(folder.glob(CHECKPOINTS)):
        raise ValueError(
            f"{folder} holds the checkpoints of a run: resume it (resume=True, --resume), remove it, or take "
            "another folder (--out)"
        )


def check_identity(path: Path, described: Mapping[str, Any], what: str) -> None:
    """Raise ValueError if an identity file exists, but is damaged or differs from ``described``."""
    if not path.exists():
        return
    here = json.loads(json.dumps(described))
    try:
        there = json.loads(path.read_text())
        changed = [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged; remove it if nothing in its folder is worth keeping: {error}") from None
    if changed:
        differences = "; ".join(f"{name} = {there.get(name)} there, {here.get(name)} here" for name in changed)
        raise ValueError(f"{path.parent} holds {what}: {differences}. Take another --out, or remove the folder")
