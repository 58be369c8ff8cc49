import numpy as np
import pytest

from training.records import Record, check_dt, jitter, median_step, pieces, resampled, sampling_interval

DT = 0.02
T = 3.0 + DT * np.arange(500)


def record(t, **signals):
    return Record("a", t, **{"y": np.sin(2 * t)[:, None], **signals})


def jittery(seed=0, share=0.2):
    return T + np.random.default_rng(seed).uniform(-share, share, len(T)) * DT


def test_a_uniform_record_is_unchanged():
    u = np.random.default_rng(0).normal(size=(500, 2))
    before = record(T, u=u, x=np.cos(T)[:, None])
    after = resampled(before)
    assert median_step(before) == pytest.approx(DT)
    assert jitter(before) < 1e-9
    for letter in ("t", "y", "u", "x"):
        np.testing.assert_allclose(getattr(after, letter), getattr(before, letter), rtol=0, atol=1e-10)


def test_jitter_is_measured_and_interpolated_away():
    t = jittery()
    found = resampled(record(t, x=np.cos(2 * t)[:, None]), DT)
    assert 0.3 < jitter(record(t)) < 0.4
    assert jitter(record(np.delete(T, [7, 8, 9]))) < 1e-9
    linear = (1.4 * DT) ** 2 / 8 * 4  # bound of the error of linear interpolation: h^2 / 8 max |y''|
    assert abs(found.y[:, 0] - np.sin(2 * found.t)).max() < linear
    assert abs(found.x[:, 0] - np.cos(2 * found.t)).mean() < linear / 20


def test_long_gaps_are_missing_and_short_ones_are_not():
    kept = np.delete(np.arange(500), [100, 101, *range(200, 203)])
    found = resampled(record(T[kept]))
    assert np.flatnonzero(np.isnan(found.y[:, 0])).tolist() == [200, 201, 202]
    y = np.sin(2 * T)[:, None].repeat(2, 1)
    y[[50, 51, 52], 1] = np.nan
    found = resampled(record(T, y=y))
    assert np.argwhere(np.isnan(found.y)).tolist() == [[50, 1], [51, 1], [52, 1]]
    assert [len(piece.t) for piece in pieces([found])] == [50, 447]


def test_inputs_are_held():
    t = np.array([0.0, 0.9, 2.0, 3.0, 4.0])
    u = np.array([0.0, 10.0, 20.0, 0.0, 0.0])[:, None]
    found = resampled(Record("a", t, np.sin(t)[:, None], u), 1.0)
    np.testing.assert_allclose(found.u[:, 0], [1.0, 10.0, 20.0, 0.0, 0.0], atol=1e-12)
    assert found.u[3, 0] == 0.0


def test_states_may_be_missing():
    x = np.cos(T)[:, None].repeat(2, 1)
    x[:250, 0] = np.nan
    y = np.sin(T)[:, None]
    y[100:120] = np.nan
    first, second = pieces([resampled(record(T, x=x, y=y))])
    assert first.x is None
    assert np.isnan(second.x[:, 0]).sum() == 130


def test_a_jump_of_the_time_is_no_gap():
    t = T + 1e9 * (np.arange(len(T)) >= 100)
    with pytest.raises(ValueError, match=r"a: column t, row 101: 1000000005 comes after 4\.98 s; split the record"):
        resampled(record(t))


def test_dt_that_does_not_fit():
    with pytest.raises(ValueError, match=r"a: column y1: too few samples are within 3 dt = 0.003 s"):
        resampled(record(jittery()[1:], y=np.sin(T[1:])[:, None]), 0.001)
    for dt in (0.0, -1.0, 20.0):
        with pytest.raises(ValueError, match="must lie between 0 and its duration"):
            resampled(record(T), dt)
    check_dt([record(T)], DT / 2)
    for dt in (DT / 4, DT * 40):
        with pytest.raises(ValueError, match=r"a: column t: steps of 0.02 s do not fit dt = .* seconds"):
            check_dt([record(T)], dt)


def test_the_sampling_interval_has_no_digits_by_chance():
    assert sampling_interval(record(T)) == sampling_interval(record(T.astype("float32"))) == DT
    assert sampling_interval(record(jittery())) == pytest.approx(DT, rel=0.051)
    assert len(f"{sampling_interval(record(jittery())):g}") <= len("0.020")
    assert sampling_interval(record(np.arange(500) / 610.35)) == pytest.approx(1 / 610.35, rel=1e-10)
