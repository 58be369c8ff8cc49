"""Results: files that appear whole or not at all, locks of folders, and descriptions of their contents."""

import hashlib
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import System
from observers.storage import UNFINISHED, replacing

ABANDONED = 3600.0  # seconds after which no process writes to a temporary file any more


def write(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all; makes its folder."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lay out a table in Markdown."""
    lines = [list(header), *map(list, rows)]
    for line in lines:
        if len(line) != len(header):
            raise ValueError(f"the row {line} has {len(line)} cells under the {len(header)} titles {lines[0]}")
    laid = ["".join(f"| {cell} " if cell else "| " for cell in line) + "|" for line in lines]
    return [laid[0], "|---" * len(header) + "|", *laid[1:]]


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Raise OSError before long work if its results could not be written; leaves nothing behind."""
    path = Path(folder)
    existing = next((one for one in (path, *path.parents) if one.exists()), path)
    try:
        tempfile.TemporaryFile(dir=existing, prefix=UNFINISHED).close()
    except OSError as problem:  # which names the temporary file
        raise OSError(problem.errno, problem.strerror, str(folder)) from problem


def clear_unfinished(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files and folders of killed processes that were last written to an hour ago or more."""
    for unfinished in Path(folder).glob(f"{UNFINISHED}*"):
        with suppress(OSError):  # another process may clear away, too, and some belong to another user
            written = [unfinished, *unfinished.rglob("*")]  # the time of a folder is not that of its files
            if time.time() - max(path.lstat().st_mtime for path in written) > ABANDONED:
                if unfinished.is_dir() and not unfinished.is_symlink():
                    shutil.rmtree(unfinished)
                else:
                    unfinished.unlink()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder, and remove what killed ones have left half-written."""
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
    """Lock a job's folder and write what identifies the job; ValueError if the folder holds another."""
    with locked(folder):
        check_identity(folder / "job.json", described, what)
        write(folder / "job.json", json.dumps(described, indent=2) + "\n")
        yield


@contextmanager
def claimed_run(folder: Path, described: Mapping[str, Any], resume: bool) -> Iterator[None]:
    """Lock a training run's folder and write its configuration. A folder without checkpoints is free for any run."""
    with locked(folder):
        if not resume:
            refuse_checkpoints(folder)
        elif _has_checkpoints(folder):
            check_identity(folder / "config.json", described, "a run of another configuration")
        write(folder / "config.json", json.dumps(described, indent=2) + "\n")
        yield


def refuse_checkpoints(folder: Path) -> None:
    """Raise ValueError if a folder holds the checkpoints of a run."""
    if _has_checkpoints(folder):
        raise ValueError(
            f"{folder} holds the checkpoints of a run: go on with it (resume=True, --resume), remove it, or take "
            "another folder (--out)"
        )


def _has_checkpoints(folder: Path) -> bool:
    return any(folder.glob("[!.]*.checkpoint.*"))


def check_identity(path: Path, described: Mapping[str, Any], what: str) -> None:
    """Raise ValueError if a folder's identity file, where there is one, describes something else."""
    if not path.exists():
        return
    here = json.loads(json.dumps(described))
    try:
        there = json.loads(path.read_text())
        changed = [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged, remove it if nothing in its folder is worth keeping: {error}") from None
    if changed:
        differences = "; ".join(f"{name} = {there.get(name)} there, {here.get(name)} here" for name in changed)
        raise ValueError(f"{path.parent} holds {what}: {differences}. Take another --out, or remove it")


def describe(system: System) -> dict[str, Any]:
    """What identifies a system, its equations included: they are sampled at points of the training box."""
    rng = np.random.default_rng(0)
    x = system.draw_starts(rng, 20)
    if system.discrete:
        u = rng.uniform(-1, 1, (system.nu, 20)) * np.array(system.u_max)[:, None]
        moved = components(system.step, x.T, u)
    else:
        moved = [*components(system.f, x.T), *(entry for row in input_matrix(system, x.T) for entry in row)]
    equations = [_rounded(np.broadcast_to(row, 20)).tolist() for row in (*moved, *system.output(x).T)]
    return {
        "system": system.name,
        "parameters": system.parameters,
        "X": system.X,
        "bounds": system.bounds,
        "u_max": system.u_max,
        "equations": hashlib.sha256(json.dumps(equations).encode()).hexdigest()[:16],
    }


def _rounded(values: np.ndarray) -> np.ndarray:
    """Values as they are on every machine: to six decimals, or to more where all are small."""
    size = np.abs(values).max()
    return np.round(values, 6 - min(0, math.floor(math.log10(size))) if 0 < size < np.inf else 6)
