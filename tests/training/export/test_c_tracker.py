"""Exported tracking observers in C99 against KKLObserver."""

from dataclasses import replace

import numpy as np
import pytest
from compiled_c import compiled, estimates, fed, needs_cc
from exported_steps import apart, doubles, operated, stepped, t_inv, tracked
from random_tracking import KINDS

# A main program that makes the covariance invalid during a record.
BROKEN = """
#include <stdio.h>
#include "made.h"
int main(void)
{
    made_observer observer;
    double y[1] = {0.3}, u[1] = {0.2}, x_hat[2];
    made_reset(&observer, y);
    for (int k = 0; k < 60; k++) {
        if (k == 50)
            observer.P[0][0] = -1.0;
        made_step(&observer, y, u, x_hat);
        printf("%.17g %.17g\\n", x_hat[0], x_hat[1]);
    }
    return 0;
}
"""


@needs_cc
@pytest.mark.parametrize(
    ("index", "precision", "tolerance"),
    [*((i, "double", 1e-9) for i in range(len(KINDS))), (1, "float", 1e-5), (5, "float", 1e-5)],
)
def test_a_record(index, precision, tolerance, tmp_path):
    exported, y, u, expected = tracked(index)
    x_hat = estimates(compiled(replace(exported, precision=precision), tmp_path), y, u)
    assert apart(exported, x_hat, expected) < tolerance


@needs_cc
def test_equations_of_all_operations(tmp_path):
    exported, y, u, expected = operated(["atan2", ["u", 0], ["x", 1]])
    assert apart(exported, estimates(compiled(exported, tmp_path), y, u), expected) < 1e-9


@needs_cc
def test_t_inv_replaces_an_invalid_covariance(tmp_path):
    exported, *_ = tracked(0)
    (tmp_path / "broken.c").write_text(BROKEN, encoding="utf-8")
    printed = fed(compiled(exported, tmp_path, main=tmp_path / "broken.c"), "").stdout
    found = np.array([line.split() for line in printed.splitlines()], dtype=float)
    sound, taken = [], []
    with doubles():
        for observer in stepped(exported, np.full((61, 1), 0.3), np.full((61, 1), 0.2)):
            sound.append(observer.decode())
            taken.append(t_inv(observer))
    np.testing.assert_allclose(found[:50], sound[1:51], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[50], taken[51], rtol=0, atol=1e-9)
    assert abs(sound[51] - taken[51]).max() > 0.1
    assert np.isfinite(found).all()
