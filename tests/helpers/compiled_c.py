"""Exported C, compiled and run."""

import shutil
import subprocess

import numpy as np
import pytest

from training.export.c_source import c_files

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, cc")


def written(exported, folder):
    """Write the C files of an observer; return the path of the source."""
    for name, text in c_files(exported).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / f"{exported.name}.c"


def compiled(exported, folder, *options, main=None):
    """Compile an exported observer with its own main file or with `main`; return the path of the program."""
    program, source = folder / "program", written(exported, folder)
    command = ["cc", *WARNINGS, "-O1", *options, source, main or source.with_name(f"{exported.name}_main.c")]
    done = subprocess.run([*command, "-lm", "-o", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def fed(program, text):
    return subprocess.run([program], input=text, capture_output=True, text=True)


def estimates(program, y, u):
    """The estimates that the program prints for a record."""
    rows = np.concatenate([u[:-1], y[1:]], axis=-1).tolist()
    done = fed(program, "\n".join(" ".join(map(repr, row)) for row in [y[0].tolist(), *rows]) + "\n")
    assert (done.returncode, done.stderr) == (0, "")
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
