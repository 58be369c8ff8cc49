"""Error bars and flows from records of a plant whose best observer is known: a mass on a spring."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from recorded_runs import SMALL, as_csv, swing
from rich.console import Console
from scipy.linalg import solve_discrete_are

from observers import Artifact, ArtifactError, KKLObserver
from training.commands.data import DataOptions
from training.commands.errorbars import ErrorBars
from training.commands.tracking import Tracking
from training.maps import regions, spread
from training.maps.regions import chi_square, squared_distance
from training.recorded import calibrating
from training.recorded import tracking as tracking_module
from training.recorded.calibrating import parted
from training.recorded.config import recorded_config
from training.recorded.errorbars import learn_recorded_error_bars
from training.recorded.fit import train_recorded
from training.recorded.tracking import increments_of, learn_recorded_tracking, linear_output
from training.records import Record

NOISE, DT = 0.1, 0.05
A = np.array([[np.cos(DT), np.sin(DT)], [-np.sin(DT), np.cos(DT)]])


def both(seed, n=600):
    """A run of which the position is both measured and among what is to be estimated."""
    run = swing(seed, n=n)
    return replace(run, x=np.hstack([run.y, run.x]), signals=replace(run.signals, hidden=("position", "speed")))


@pytest.fixture(scope="module", autouse=True)
def few_levels():
    """At which factors are found."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (calibrating, tracking_module, regions, spread):
            patch.setattr(module, "LEVELS", (0.0, 0.5, 1.0))
        yield


@pytest.fixture(scope="module")
def records():
    return [both(seed) for seed in range(10)]


@pytest.fixture(scope="module")
def plain(records, tmp_path_factory):
    """An observer without error bars."""
    config = recorded_config(records, {**SMALL, "measurement_noise_max": 2 * NOISE})
    folder = tmp_path_factory.mktemp("plain")
    return train_recorded(records, config, folder, name="spring", device=torch.device("cpu")).artifact


@pytest.fixture(scope="module")
def barred(plain, records):
    return learn_recorded_error_bars(plain, records, steps=500)


@pytest.fixture(scope="module")
def tracking(barred, records):
    return learn_recorded_tracking(barred, records, steps=1000)


def estimated(artifact, *, n=40, level=NOISE):
    """Errors (steps, n, 2) on new runs with noise, and the observer's covariances."""
    runs, rng = [both(seed) for seed in range(100, 100 + n)], np.random.default_rng(0)
    x, y, u = (np.stack([getattr(run, name) for run in runs], 1) for name in "xyu")
    y = y + level * rng.standard_normal(y.shape)
    observer = KKLObserver(artifact, level)
    errors, covariances = [observer.reset(y[0]) - x[0]], [observer.covariance]
    for k in range(1, len(x)):
        errors.append(observer.step(y[k], u[k - 1]) - x[k])
        covariances.append(observer.covariance)
    return np.array(errors), np.array(covariances)


def test_regions_hold_what_they_should_on_new_records(barred, tracking):
    for level in (NOISE, 2 * NOISE):
        for artifact, most in ((barred, 0.95), (tracking, 0.97)):  # lenient where errors have long tails
            errors, covariances = estimated(artifact, level=level)
            inside = squared_distance(errors[:200], covariances[:200]) < chi_square(0.9, 2)
            assert 0.85 < np.mean(inside) < most


def test_estimates_stay_as_they_are_with_error_bars(plain, barred):
    run = both(50)
    np.testing.assert_array_equal(KKLObserver(plain).estimate(run.y, run.u), KKLObserver(barred).estimate(run.y, run.u))


def test_it_tracks_nearly_as_well_as_the_kalman_filter(barred, tracking):
    """The plant is linear, and what the flow is off by is small: the Kalman filter with its noise is the best."""
    C = np.array([[1.0, 0.0]])
    np.testing.assert_allclose(tracking.C, C, atol=1e-5)
    before, after = (np.sqrt(np.mean(estimated(each)[0][200:] ** 2, (0, 1))) for each in (barred, tracking))
    Q = np.diag((tracking.flow.error * tracking.flow.x_scale) ** 2)
    P = solve_discrete_are(A.T, C.T, Q, [[NOISE**2]])
    K = P @ C.T / (C @ P @ C.T + NOISE**2)
    best = np.sqrt(np.diag(P - K @ C @ P))
    assert (after < 0.7 * before).all()
    assert (after < 1.3 * best).all()


def test_increments_are_between_samples_that_are_known(plain):
    run = both(3)
    x, y = run.x.copy(), run.y.copy()
    x[10], y[20] = np.nan, np.nan
    found = increments_of(plain, [replace(run, x=x, y=y)], np.random.default_rng(0))
    known = [k for k in range(599) if k not in (9, 10, 19, 20)]  # around a gap of outputs records are cut
    np.testing.assert_array_equal(found.x, run.x[known])
    np.testing.assert_array_equal(found.x + found.change, run.x[known] + np.diff(run.x, axis=0)[known])
    np.testing.assert_array_equal(found.u, run.u[known])


def test_outputs_are_sums_of_states_or_an_error(records):
    rng, run = np.random.default_rng(0), records[0]
    for noise, off in ((0.01, 2e-3), (0.3, 0.05)):
        noisy = replace(run, y=run.y + noise * rng.standard_normal(run.y.shape))
        noisy.y[5] = 1e3 if noise == 0.3 else noisy.y[5]  # one sample is wrong
        C, least = linear_output([noisy])
        np.testing.assert_allclose(C, [[1.0, 0.0]], atol=off)
        assert least == pytest.approx(noise, rel=0.1)
    for other in (run.y**2, run.y + 3.0, rng.standard_normal(run.y.shape)):
        with pytest.raises(ValueError, match=r"position cannot be told as a sum of position, speed"):
            linear_output([replace(run, y=other)])
    early = np.arange(600)[:, None] < 300
    apart = replace(run, x=np.where(early, run.x, np.nan), y=np.where(early, np.nan, run.y))
    with pytest.raises(ValueError, match=r"no sample has all measured and all hidden signals"):
        linear_output([apart])


def test_records_are_those_of_the_training(plain, records):
    """What was held out hangs on the order, and only that says how large errors are."""
    expected, found = (parted(plain, order, None) for order in (records, records[::-1]))
    for one, other in zip(expected, found, strict=True):
        assert [record.name for record in one] == [record.name for record in other]
    with pytest.raises(ValueError, match=r"run7.csv, run8.csv, run9.csv is missing.*name the records of the training"):
        parted(plain, records[:7], None)
    with pytest.raises(ValueError, match=r"run11.csv was not there"):
        parted(plain, [*records, both(11)], None)
    with pytest.raises(ValueError, match=r"run0.csv has changed"):
        parted(plain, [replace(records[0], y=2 * records[0].y), *records[1:]], None)
    with pytest.raises(ValueError, match=r"steps of 50 s do not fit dt = 0.05 s; is the time in seconds"):
        parted(plain, [replace(record, t=1000 * record.t) for record in records], None)


def test_what_is_refused(plain, barred, tracking, records, tmp_path):
    with pytest.raises(ArtifactError, match=r"holds no error bars; kkl-gym errorbars NAME_OR_FILE --data FILE"):
        learn_recorded_tracking(plain, records)
    with pytest.raises(ArtifactError, match=r"holds no flow; kkl-gym tracking NAME_OR_FILE --data FILE"):
        plain.require_flow()
    with pytest.raises(ValueError, match=r"hidden are speed, but the observer's position, speed"):
        learn_recorded_tracking(barred, [swing(0)])
    with pytest.raises(ValueError, match=r"no hidden states were recorded"):
        learn_recorded_tracking(barred, [Record("a.csv", np.arange(5.0), np.zeros((5, 1)))])
    greedy = replace(plain, training={**plain.training, "held_out": 0.0})
    with pytest.raises(ValueError, match=r"no record was held out.*held-out 0.2"):
        learn_recorded_error_bars(greedy, records)
    with pytest.raises(ValueError, match=r"19 samples with states to begin at, too few"):
        learn_recorded_error_bars(plain, records[:1], [both(7, n=20)], steps=1)
    for teach, start in ((learn_recorded_error_bars, plain), (learn_recorded_tracking, barred)):
        for name in ("steps", "seed"):
            with pytest.raises(ValueError, match=f"{name} must be"):
                teach(start, records, **{name: -1})
    zeroed = replace(barred, training={**barred.training, "arbitrary_zero": ("position",)})
    with pytest.raises(ValueError, match=r"compares position with what it expects.*without arbitrary_zero"):
        learn_recorded_tracking(zeroed, records)
    with pytest.raises(ValueError, match="was not learned from recorded states"):
        learn_recorded_error_bars(replace(plain, training={}), records)


def test_commands(plain, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = DataOptions(tuple(Path(as_csv(tmp_path / f"run{seed}.csv", swing(seed))) for seed in range(10)))
    plain.save(tmp_path / "spring.safetensors")
    quiet = Console(quiet=True)
    with pytest.raises(ValueError, match=r"learned from recorded states, and nothing can be simulated.*--data"):
        ErrorBars("spring.safetensors").run(quiet)
    with pytest.raises(ValueError, match=r"--trajectories: of no use for the observer 'spring' from recorded states"):
        ErrorBars("spring.safetensors", trajectories=500, records=data).run(quiet)
    with pytest.raises(ValueError, match=r"van_der_pol is simulated: leave --data and its columns out"):
        Tracking("van_der_pol", records=data).run(quiet)
    ErrorBars("spring.safetensors", steps=20, records=data).run(quiet)
    found = Tracking("runs/errorbars/spring.safetensors", steps=20, records=data).run(quiet)
    np.testing.assert_allclose(found.C, [[1.0, 0.0]], atol=1e-5)
    assert Artifact.read(tmp_path / "runs/tracking/spring.safetensors").flow is not None
