"""Files of results: text that appears whole or not at all, and temporary files that killed processes leave."""

import os
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from safetensors import SafetensorError, safe_open

from observers.storage import UNFINISHED, replacing

ABANDONED = 3600.0  # seconds after which no process writes to a temporary file any more


def write(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all; makes its folder."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


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
        with suppress(OSError):  # another process may clear away, too, and some are not ours to remove
            written = [unfinished, *unfinished.rglob("*")]  # a folder's own time says nothing of what is in its files
            if time.time() - max(path.lstat().st_mtime for path in written) > ABANDONED:
                if unfinished.is_dir() and not unfinished.is_symlink():
                    shutil.rmtree(unfinished)
                else:
                    unfinished.unlink()


def is_kind(path: str | os.PathLike[str], key: str) -> bool:
    """Whether the header of a safetensors file has metadata under a key."""
    try:
        if not Path(path).is_file():  # to read a pipe may never end
            return False
        with safe_open(path, "numpy") as file:
            return key in (file.metadata() or {})
    except (OSError, SafetensorError):
        return False
