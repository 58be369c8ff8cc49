"""Maps that track in C99, compiled, against the same in Python."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest
from compiled_c import WARNINGS, compiled, estimates, needs_cc
from exported_steps import apart, doubles, exported_of, in_doubles, lost_and_inflated
from random_tracking import KINDS, of_floats, signals, tracking

from observers import Expression, KKLObserver
from training.export.c_source import c_files

# Breaks the covariance in the midst of a record.
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
@pytest.mark.parametrize(("precision", "tolerance"), [("float", 1e-5), ("double", 1e-9)])
@pytest.mark.parametrize("options", KINDS)
def test_two_thousand_samples(options, precision, tolerance, tmp_path):
    exported = exported_of(tracking(**options), tmp_path, precision=precision)
    y, u = of_floats(exported.artifact, 2000)
    y[2:9] = y[700:720] = y[300::7, 0] = np.nan  # from the start on, where T_inv has learned less than it is old
    assert apart(exported, estimates(compiled(exported, tmp_path), y, u), y, u) < tolerance
    lost, inflated = lost_and_inflated(exported, y, u)
    assert sum(lost[600:700]) > 1
    assert inflated.any()


@needs_cc
def test_the_compiler_may_be_told_other_levels_of_noise(tmp_path):
    artifact = tracking(outputs=2, process=True, free_inverse=True)
    exported = exported_of(artifact, tmp_path, precision="double", measurement_noise=(0.2, 0.7), process_noise=0.1)
    y, u = signals(artifact, 200)
    for process in (0.02, 0.6):  # of which T_inv is told 0.2 at most, and the Kalman filter any
        told = [f"-DMADE_PROCESS_NOISE={process}", "-DMADE_MEASUREMENT_NOISE_1=0.9", "-DMADE_MEASUREMENT_NOISE_2=7"]
        x_hat = estimates(compiled(exported, tmp_path, *told), y, u)
        other = replace(exported, measurement_noise=(0.9, 2.0), process_noise=process)  # 2 is the largest that is told
        np.testing.assert_allclose(x_hat, in_doubles(other, y, u), rtol=0, atol=1e-9)
        assert abs(x_hat - in_doubles(exported, y, u)).max() > 1e-3


@needs_cc
def test_a_covariance_that_breaks_down_is_lost(tmp_path):
    exported = exported_of(tracking(), tmp_path, precision="double")
    for name, text in c_files(exported).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "broken.c").write_text(BROKEN, encoding="utf-8")
    program, sources = tmp_path / "broken", [tmp_path / "made.c", tmp_path / "broken.c"]
    subprocess.run(["cc", *WARNINGS, *sources, "-lm", "-o", program], check=True)
    printed = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    found = np.array([line.split() for line in printed.splitlines()], dtype=float)
    observer, expected = KKLObserver(exported.artifact, exported.measurement_noise, compiled=False), []
    with doubles():
        observer.reset([0.3])
        for k in range(60):
            if k == 50:
                observer._tracker._P[0, 0, 0] = -1.0
            expected.append(observer.step([0.3], [0.2]))
            if k == 50:
                assert observer._tracker._mean_square[0] == 1.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_outputs_that_are_not_linear_are_refused(tmp_path):
    artifact = tracking()
    curved = replace(artifact, C=None, h=Expression([["+", ["x", 0], ["x", 1]]]))
    with pytest.raises(ValueError, match="not linear, and C takes y = C x alone: export the map that it was made from"):
        c_files(exported_of(curved, tmp_path))


def test_scales_beyond_floats_are_refused(tmp_path):
    artifact = tracking()
    flow = replace(artifact.flow, x_offset=1e39 * artifact.flow.x_offset)
    with pytest.raises(ValueError, match="beyond the range of floats"):
        exported_of(replace(artifact, flow=flow), tmp_path)
