import numpy as np
import pytest

from training.records import Record
from training.records.record import Windows
from training.spectrum import Spectrum
from training.trajectories.motions import filter_states

DT = 0.05
RNG = np.random.default_rng(0)
LINEAR = Spectrum((-1.0, -4.0), ((-2.0, 3.0),)).filter(2, DT, 1)


def record(n, **changes):
    columns = {"y": RNG.normal(size=(n, 2)), "u": RNG.normal(size=(n, 1)), "x": np.arange(n)[:, None] + 0.0}
    return Record("a", DT * np.arange(n), **{**columns, **changes})


@pytest.mark.parametrize("age", [0, 1, 7, 29])
def test_a_filter_may_start_at_any_sample(age):
    x = 1000 + np.arange(30)[:, None] + 0.0
    x[3] = np.nan
    records = [record(50), record(30, x=x), record(9, x=None)]
    windows = Windows(records, LINEAR, 1)
    rows = windows.rows(age)
    assert len(rows) == (50 - age) + (30 - age) - (age <= 3)  # samples with a state, from `age` on
    for z, state in zip(windows.restarted(rows, age), windows.x[rows, 0]):
        owner, sample = records[int(state >= 1000)], int(state) % 1000
        y, u = owner.y[sample - age : sample + 1, None], owner.u[sample - age : sample + 1, None]
        np.testing.assert_allclose(z, filter_states(LINEAR, y, u, np.array([age]))[0, 0], rtol=1e-9, atol=1e-12)
