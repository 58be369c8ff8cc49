"""Folders of runs and jobs: a lock on each, and a file with what identifies the results in it."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from kkl_gym.equations import components, input_matrix
from kkl_gym.system import System
from training.files import clear_unfinished, write


def describe(system: System) -> dict[str, Any]:
    """What identifies a system, its equations included: they are sampled at points of the training box."""
    rng = np.random.default_rng(0)
    x = system.draw_starts(rng, 20)
    if system.discrete:
        u = rng.uniform(-1, 1, (system.nu, 20)) * np.array(system.u_max)[:, None]
        moved = components(system.step, x.T, u)
    else:
        moved = [*components(system.f, x.T), *(entry for row in input_matrix(system, x.T) for entry in row)]
    rows = [*moved, *system.output(x).T]
    equations = np.array([_rounded(np.broadcast_to(row, 20)) for row in rows])
    return {
        "system": system.name,
        "parameters": system.parameters,
        "X": system.X,
        "bounds": system.bounds,
        "u_max": system.u_max,
        "equations": hashlib.sha256(json.dumps(equations.tolist()).encode()).hexdigest()[:16],
    }


def _rounded(values: np.ndarray) -> np.ndarray:
    """Values as they are on every machine: to six decimals, or to more where all are small."""
    size = np.abs(values).max()
    return np.round(values, 6 - min(0, math.floor(math.log10(size))) if 0 < size < np.inf else 6)


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


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder, and clear away what killed ones have left half-written."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(f"another process is at work in {folder}") from None
    try:
        clear_unfinished(folder)
        yield
    finally:
        lock.release()


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
