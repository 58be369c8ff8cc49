import numpy as np
import pytest

from training.records import Record
from training.sources.windows import windows
from training.spectrum import Spectrum
from training.trajectories.filtering import filter_states

DT = 0.05
RNG = np.random.default_rng(0)
LINEAR = Spectrum((-1.0, -4.0), ((-2.0, 3.0),)).filter(2, DT, 1)


def record(n, **changes):
    t = DT * np.arange(n)
    columns = {"y": RNG.normal(size=(n, 2)), "u": RNG.normal(size=(n, 1)), "x": np.arange(n)[:, None] + 0.0}
    return Record("a", t, **{**columns, **changes})


def test_every_pair_is_that_of_a_filter_that_starts_so_many_samples_before():
    x = 1000 + np.arange(30)[:, None] + 0.0
    x[3] = np.nan
    records, ages = [record(50), record(30, x=x)], np.array([0, 1, 7, 29])
    found = windows(records, LINEAR, ages=ages, n=200)
    assert found.x.shape == (4, 200, 1)
    for i, age in enumerate(ages):
        seen = set()
        for z, state in zip(found.z[i], found.x[i, :, 0]):
            owner, sample = records[int(state >= 1000)], int(state) % 1000
            start, end = sample - age, sample + 1
            y, u = owner.y[start:end, None], owner.u[start:end, None]
            np.testing.assert_allclose(z, filter_states(LINEAR, y, u, np.array([age]))[0, 0], rtol=1e-9, atol=1e-12)
            seen.add(int(state))
        assert 1003 not in seen
        assert len(seen) == (50 - age) + (30 - age) - (age <= 3)  # every sample that is old enough


def test_no_state_is_as_old():
    with pytest.raises(ValueError, match=r"no recorded state is 1.5 s after the start .* record longer runs"):
        windows([record(30)], LINEAR, ages=np.array([0, 30]), n=10)
    with pytest.raises(ValueError, match=r"no recorded state"):
        windows([record(30, x=None)], LINEAR, ages=np.array([0]), n=10)
