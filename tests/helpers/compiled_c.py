"""Exported C, compiled and run."""

import shutil
import subprocess

import numpy as np
import pytest

from training.export.c_source import c_files

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, cc")


def written(exported, folder):
    """The path of its source, beside which its other files are."""
    for name, text in c_files(exported).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / f"{exported.name}.c"


def compiled(exported, folder, *options, main=None):
    """The program around an exported observer, its own or another."""
    program, source = folder / "program", written(exported, folder)
    command = ["cc", *WARNINGS, "-O1", *options, source, main or source.with_name(f"{exported.name}_main.c")]
    done = subprocess.run([*command, "-lm", "-o", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


# Steps along a record that it reads, many times over. Prints the microseconds of a step, and the sum of estimates.
TIMED = """
#include <stdio.h>
#include <time.h>
#include "NAME.h"

static NAME_real y[STEPS][OUTPUTS], u[STEPS][INPUTS + 1], x_hat[WIDTH];

int main(void)
{
    NAME_observer observer;
    double value, sum = 0.0;
    for (int k = 0; k < STEPS; k++) {
        for (int i = 0; i < INPUTS && scanf("%lf", &value) == 1; i++)
            u[k][i] = (NAME_real)value;
        for (int i = 0; i < OUTPUTS && scanf("%lf", &value) == 1; i++)
            y[k][i] = (NAME_real)value;
    }
    clock_t began = clock();
    for (int turn = 0; turn < TURNS; turn++) {
        NAME_reset(&observer, y[0]);
        for (int k = 1; k < STEPS; k++) {
            NAME_step(&observer, y[k], GIVEN x_hat);
            sum += x_hat[0];
        }
    }
    printf("%.3g %.9g\\n", 1e6 * (double)(clock() - began) / CLOCKS_PER_SEC / (STEPS - 1) / TURNS, sum / TURNS);
    return 0;
}
"""


def microseconds(exported, folder, y, u, turns=20):
    """The processor time of a step in C, along a record and many times over, and the sum of the first estimates."""
    nu = u.shape[-1]
    sizes = {
        "STEPS": len(y),
        "TURNS": turns,
        "OUTPUTS": y.shape[-1],
        "INPUTS": nu,
        "WIDTH": len(exported.signals["x_hat"]),
    }
    text = TIMED.replace("NAME", exported.name).replace("GIVEN", "u[k]," if nu else "")
    (folder / "timed.c").write_text(text, encoding="utf-8")
    told = [f"-D{name}={size}" for name, size in sizes.items()]
    program = compiled(exported, folder, "-O2", *told, main=folder / "timed.c")
    held = np.concatenate([np.zeros((1, nu)), u[: len(y) - 1]])
    rows = np.concatenate([held, y], axis=-1).tolist()
    done = fed(program, "\n".join(" ".join(map(repr, row)) for row in rows))
    return [float(number) for number in done.stdout.split()]


def fed(program, text):
    return subprocess.run([program], input=text, capture_output=True, text=True)


def estimates(program, y, u):
    """What the program prints for a record."""
    rows = np.concatenate([u[:-1], y[1:]], axis=-1).tolist()
    done = fed(program, "\n".join(" ".join(map(repr, row)) for row in [y[0].tolist(), *rows]) + "\n")
    assert (done.returncode, done.stderr) == (0, "")
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
