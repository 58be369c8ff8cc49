"""The Silverbox example: the model of the input between samples, and the whole example where the data are available."""

import os
import runpy
from pathlib import Path

import numpy as np
import pytest

from kkl_gym.simulate import simulate

DATA = "KKL_GYM_SILVERBOX"  # path of SNLS80mV.csv, which is not in the repository
MODULE = runpy.run_path(str(Path(__file__).parent.parent / "examples" / "silverbox.py"))


def test_three_samples_act_as_a_smooth_input():
    Silverbox, part, dt, fine = MODULE["Silverbox"], MODULE["part"], MODULE["DT"], 16

    def u(t):
        return 0.03 * sum(np.sin(2 * np.pi * f * t + f) for f in (7.0, 13.0, 19.0, 31.0))

    held = Silverbox(damping=40.0, stiffness=1.8e5, cube=7e5, gain=1.9e5)
    middles = (np.arange(400 * fine) + 0.5) * dt / fine
    x = simulate(held, np.zeros((1, 2)), len(middles), dt / fine, u=np.repeat(u(middles)[:, None, None], 3, -1))[::fine]
    times = dt * np.arange(-1, 402)
    record = part(np.stack([u(times), np.zeros_like(times)], -1), 1, 402)

    def error(**weights):
        model = held.replace(weights)
        return np.std(simulate(model, x[0], 400, dt, u=record.u[:-1, None])[:, 0, 0] - x[:, 0, 0])

    smooth = error(before=-1 / 6, after=1 / 3)
    assert smooth < 0.01 * np.std(x[:, 0, 0])
    assert error() > 20 * smooth
    assert error(after=0.5) > 2 * smooth  # linear interpolation


def test_a_file_of_another_length_is_refused(tmp_path):
    file = tmp_path / "SNLS80mV.csv"
    file.write_text("V1,V2,\n0.1,0.2,\n")
    for path in (file, tmp_path):
        with pytest.raises(ValueError, match=r"SNLS80mV\.csv has 1 samples, but the Silverbox has 131072"):
            MODULE["read"](path)


@pytest.mark.skipif(DATA not in os.environ, reason=f"{DATA} is not set to the path of SNLS80mV.csv")
def test_ahead_of_published_errors_on_the_measured_data(tmp_path, capsys):
    errors = MODULE["main"](Path(os.environ[DATA]), out=tmp_path)
    assert (np.array(errors) < MODULE["PUBLISHED"]["NARX (SysIdentPy)"]).all()
    assert "extrapolation" in capsys.readouterr().out  # a narrow terminal wraps the line before this word
    assert (tmp_path / "silverbox.png").stat().st_size > 10_000
