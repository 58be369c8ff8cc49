"""The on-disk cache of compiled code, shared between processes."""

import os
import subprocess
import sys

SCRIPT = """
import sys
import numpy as np
from observers.machine import kernel, part

def made(factor):
    @part(fastmath=False)
    def scaled(x):
        total = 0.0
        for i in range(len(x)):
            total += factor * x[i] ** i  # a loop, or the compiler would put it into its caller
        return total

    @kernel(fastmath=False)
    def called(x):
        return scaled(x) + scaled(x[::2])

    return called

for factor in map(float, sys.argv[1:]):
    function = made(factor)
    print(function(np.ones(4)), len(function.stats.cache_hits))
"""


def test_kernels_of_several_processes_go_together(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run(*factors):
        command = [sys.executable, tmp_path / "script.py", *factors]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return [tuple(map(float, line.split())) for line in done.stdout.splitlines()]

    assert run("1.0") == [(6.0, 0)]
    assert run("2.0") == [(12.0, 0)]
    assert run("1.0", "2.0", "3.0") == [(6.0, 1), (12.0, 1), (18.0, 0)]

    for path in (tmp_path / "cache").rglob("*.nb[ic]"):  # truncated files, as after a power failure
        path.write_bytes(path.read_bytes()[:20])
    assert run("1.0") == [(6.0, 0)]
    assert run("1.0") == [(6.0, 1)]
