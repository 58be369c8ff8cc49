"""Observers from records of a mass on a spring, for which the optimal observer is known."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from recorded_runs import SIGNALS, SMALL, swing
from rich.console import Console
from scipy.linalg import solve_discrete_are

from observers import Artifact, KKLObserver
from training import RecordedSource, recorded_preset, train
from training.calibration import chi_square, squared_distance
from training.evaluation.report import write_report
from training.lessons import Result
from training.records import Record, resampled
from training.sources.recorded import linear_output, recorded_errors, signal_rate, split

CPU, NOISE, DT = torch.device("cpu"), 0.1, 0.05
A = np.array([[np.cos(DT), np.sin(DT)], [-np.sin(DT), np.cos(DT)]])


def both(seed, n=600):
    """A run with the position as both a measured and a hidden signal."""
    run = swing(seed, n=n)
    return replace(run, x=np.hstack([run.y, run.x]), signals=replace(run.signals, hidden=("position", "speed")))


def trained(records, folder=None, *, resume=False, **changes):
    """Train an observer from records; return the result and the printed text."""
    printed = Console(file=io.StringIO(), width=400)
    source = RecordedSource(records, recorded_preset(records, {**SMALL, "flow_steps": 300, **changes}), "spring")
    return train(source, folder=folder, resume=resume, device=CPU, console=printed), printed.file.getvalue()


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    """A tracking observer, saved and read."""
    path = tmp_path_factory.mktemp("spring") / "spring.safetensors"
    result, printed = trained([both(seed) for seed in range(10)], measurement_noise_max=2 * NOISE)
    assert "the tracker predicts by a learned flow: records have no equations" in printed
    assert "does not track" not in printed
    assert list(result.losses) == ["inverse", "flow"]
    result.artifact.save(path)
    return Artifact.read(path)


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


def test_it_tracks_nearly_as_well_as_the_kalman_filter(tracking):
    """The plant is linear and the flow's error small, so a Kalman filter with this error as noise is optimal."""
    C = np.array([[1.0, 0.0]])
    np.testing.assert_allclose(tracking.C, C, atol=1e-5)
    before, after = (
        np.sqrt(np.mean(estimated(each)[0][200:] ** 2, (0, 1))) for each in (replace(tracking, motion=None), tracking)
    )
    Q = np.diag((tracking.motion.error * tracking.motion.x_scale) ** 2)
    P = solve_discrete_are(A.T, C.T, Q, [[NOISE**2]])
    K = P @ C.T / (C @ P @ C.T + NOISE**2)
    best = np.sqrt(np.diag(P - K @ C @ P))
    assert (after < 0.8 * before).all()
    assert (after < 1.3 * best).all()


@pytest.mark.parametrize("level", [NOISE, 2 * NOISE])
def test_confidence_regions_on_new_records(tracking, level):
    for artifact in (tracking, replace(tracking, motion=None)):
        errors, covariances = estimated(artifact, level=level)
        assert 0.83 < np.mean(squared_distance(errors[:200], covariances[:200]) < chi_square(0.9, 2)) < 0.97


def test_a_tracker_that_is_worse_than_its_T_inv_is_dropped():
    records = [replace(run, x=run.y + 0.7 * run.x) for run in (swing(seed, n=600) for seed in range(6))]
    result, printed = trained(records)
    assert "does not track, as held-out errors would be" in printed
    assert (result.artifact.motion, result.artifact.C) == (None, None)
    assert result.artifact.training["held_out_errors"]["speed"] < 0.2


def test_signals_that_are_not_among_the_hidden_ones_cannot_be_tracked(tmp_path):
    records = [swing(seed, jitter=0.1) for seed in range(6)]
    result, printed = trained(records)
    assert "does not track: position is not a weighted sum of speed" in printed
    artifact = result.artifact
    assert (artifact.motion, artifact.limits, list(result.losses)) == (None, None, ["inverse"])
    assert artifact.inverse.error_covariance is not None
    assert artifact.training["held_out_errors"]["speed"] < 0.2  # estimated as the derivative of a driven position
    artifact.save(tmp_path / "spring.safetensors")
    read = Artifact.read(tmp_path / "spring.safetensors")
    assert read.signals == {"measured": ["position"], "inputs": ["force"], "hidden": ["speed"]}
    new = resampled(swing(100), read.filter.dt)
    x_hat = KKLObserver(read).estimate(new.y, new.u)
    assert np.sqrt(np.mean((x_hat - new.x)[200:] ** 2)) < 0.2 * new.x.std()
    with pytest.raises(ValueError, match=r"estimates speed from position and force, sampled every 0.05 s.*environment"):
        read.check("spring", {}, dt=0.05, ny=1, nu=1)


def test_without_enough_held_out_samples_there_are_no_covariances(tmp_path):
    records = [both(seed, n=300) for seed in range(3)]
    for share, reason in (
        (0.0, "held_out must be positive, got 0"),
        (0.03, "the held-out records have 24 samples"),
    ):
        result, printed = trained(records, held_out=share, inverse_steps=20, flow_steps=20)
        assert "does not track: " in printed
        assert reason in printed
        artifact = result.artifact
        assert (artifact.motion, artifact.inverse.error_covariance) == (None, None)
        assert artifact.C is not None
        source = RecordedSource(records, recorded_preset(records, {"held_out": share}), "speed")
        write_report(tmp_path / "report.png", result, source)  # shows only losses if nothing is held out


@pytest.mark.parametrize("lengths", [[600] * 3, [600, 900]], ids=["alike", "one-longest"])
def test_the_report_draws_no_motion_twice(tracking, monkeypatch, tmp_path, lengths):
    """The report shows the longest held-out motions: two, or one if the others are shorter."""
    drawn, records = [], [both(seed, n=n) for seed, n in enumerate(lengths)]
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: drawn.append(figure))
    source = RecordedSource(records, recorded_preset(records, SMALL), "spring")
    write_report(tmp_path / "report.png", Result(tracking, {"inverse": [(1, 1.0), (2, 0.5)]}, {}), source)
    positions = [ax.lines[0].get_ydata() for ax in drawn[0].axes[1:] if ax.get_ylabel() == "position"]
    for x, record in zip(positions, (records[0], records[-1]) if len(lengths) == 3 else records[1:], strict=True):
        ends = resampled(record, source.dt).x[-len(x) :, 0]
        np.testing.assert_allclose(x, ends)
        assert len(x) >= 0.1 * len(record.t)


def test_resuming_makes_the_same_observer(tmp_path):
    records, options = [both(seed) for seed in range(3)], {"members": 2, "inverse_steps": 20, "flow_steps": 20}
    first, _ = trained(records, tmp_path, **options)
    (tmp_path / "inverse-2.checkpoint.pt").unlink()
    with pytest.raises(ValueError, match="holds the checkpoints of a run"):
        trained(records, tmp_path, **options)
    again, _ = trained(records, tmp_path, resume=True, **options)
    for a, b in zip(first.artifact.inverse.mlp.weights, again.artifact.inverse.mlp.weights, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.artifact.motion.factors.factors, again.artifact.motion.factors.factors)
    with pytest.raises(ValueError, match=r"a run of another configuration: .*records = "):
        trained([*records[:2], both(7)], tmp_path, resume=True, **options)


def test_estimates_do_not_depend_on_an_arbitrary_zero():
    records, new = [both(seed) for seed in range(3)], resampled(swing(100), DT)
    result, printed = trained(records, inverse_steps=20, arbitrary_zero=("position",))
    assert "does not track: a tracker compares position with its prediction" in printed
    here, there = (KKLObserver(result.artifact).estimate(new.y + offset, new.u) for offset in (0.0, 100.0))
    np.testing.assert_allclose(here, there, atol=1e-3 * new.x.std())
    assert here[-1] != pytest.approx(here[-50])  # the estimate is not constant
    with pytest.raises(ValueError, match=r"arbitrary_zero names 'angle', but measured are position"):
        trained(records, arbitrary_zero=("angle",))


def test_increments_are_between_complete_samples():
    run = both(3)
    x, y = run.x.copy(), run.y.copy()
    x[100:200], y[300:400] = np.nan, np.nan
    records = [replace(run, x=x, y=y), both(4)]
    finer = replace(swing(9, n=1200, dt=DT / 2), x=np.zeros((1200, 2)), signals=run.signals)
    source = RecordedSource(records, recorded_preset(records), "a", held_out=[finer])
    assert np.diff(source.held_out[0].t) == pytest.approx(DT)  # resampled to the training's dt
    found, _ = source.increments()
    known = [k for k in range(599) if not (99 <= k < 200 or 299 <= k < 400)]  # a gap in the outputs splits a record
    np.testing.assert_allclose(found.x[: len(known)], run.x[known], atol=1e-9)
    np.testing.assert_allclose(found.change[: len(known)], np.diff(run.x, axis=0)[known], atol=1e-9)
    np.testing.assert_allclose(found.u[: len(known)], run.u[known], atol=1e-9)
    sparse = [replace(each, x=np.where(np.arange(600)[:, None] % 8, np.nan, each.x)) for each in records]
    with pytest.raises(ValueError, match="no consecutive samples have all hidden signals"):
        RecordedSource(sparse, recorded_preset(sparse), "a").tracking()


def test_outputs_are_sums_of_states_or_an_error():
    rng, run = np.random.default_rng(0), both(0)
    for noise, off in ((0.01, 2e-3), (0.3, 0.05)):
        noisy = replace(run, y=run.y + noise * rng.standard_normal(run.y.shape))
        noisy.y[5] = 1e3 if noise == 0.3 else noisy.y[5]  # one outlier
        C, least = linear_output([noisy])
        np.testing.assert_allclose(C, [[1.0, 0.0]], atol=off)
        assert least == pytest.approx(noise, rel=0.1)
    for other in (run.y + 3.0, rng.standard_normal(run.y.shape)):
        with pytest.raises(ValueError, match=r"position is not a weighted sum of position, speed"):
            linear_output([replace(run, y=other)])
    early = np.arange(600)[:, None] < 300
    apart = replace(run, x=np.where(early, run.x, np.nan), y=np.where(early, np.nan, run.y))
    with pytest.raises(ValueError, match=r"no sample has all measured and all hidden signals"):
        linear_output([apart])


def test_records_that_no_observer_can_be_learned_from():
    with pytest.raises(ValueError, match=r"no hidden states were recorded; name their columns \(--hidden\)"):
        trained([replace(swing(0), x=None, signals=replace(SIGNALS, hidden=()))])
    with pytest.raises(ValueError, match=r"no recorded state is .* after the start of its record.* faster eigenvalues"):
        trained([swing(0, n=40)])


def test_split_into_training_and_held_out_records():
    records = [resampled(swing(seed, n=100)) for seed in range(10)]
    kept, held_out = split(records, 0.3, 0)
    assert (len(kept), {record.name for record in kept + held_out}) == (7, {record.name for record in records})
    assert split(records, 0.3, 1)[1] != held_out
    kept, held_out = split(records[:2], 0.3, 0)
    assert [len(record.t) for record in kept + held_out] == [70, 70, 30, 30]
    assert held_out[0].t[0] == records[0].t[70]
    assert split(records, 0.0, 0) == (records, [])
    short = records[0].part(slice(3))
    kept, held_out = split([short, records[1]], 0.3, 0)
    assert (kept[0], [record.name for record in held_out]) == (short, [records[1].name])


def test_the_rate_of_signals_is_their_angular_frequency():
    t = 0.01 * np.arange(5000)
    record = Record("a", t, np.sin(3 * t)[:, None], x=np.stack([np.cos(3 * t), 5 + np.sin(3 * t)], -1))
    assert signal_rate([record]) == pytest.approx(3.0, rel=1e-2)
    config = recorded_preset([record])
    assert config.dt == pytest.approx(0.01)
    assert config.eigenvalues[0] == pytest.approx(-0.45, rel=1e-2)
    assert config.eigenvalues[-1] == pytest.approx(-30, rel=1e-2)
    assert config.measurement_noise_max == pytest.approx(0.1 / 2**0.5, rel=1e-2)
    assert recorded_preset([record], {"dt": 0.05, "seed": 3}).eigenvalues[-1] == -10.0


def test_signals_that_stand_still_in_each_record():
    """Constant signals do not change the filter's eigenvalues, and have no relative error."""
    signals = replace(SIGNALS, measured=("position", "target"), hidden=("speed", "mass"))
    records = []
    for seed in range(6):
        run, ones = swing(seed), np.full((600, 1), 0.1 * (seed + 1))
        records.append(replace(run, y=np.hstack([run.y, ones]), x=np.hstack([run.x, ones]), signals=signals))
    alone = recorded_preset([swing(seed) for seed in range(6)], SMALL)
    assert recorded_preset(records, SMALL).eigenvalues == alone.eigenvalues
    found = trained(records)[0].artifact.training["held_out_errors"]
    assert found["speed"] < 0.3
    assert set(found) == {"speed"}
    kept = replace(SIGNALS, measured=("target",), hidden=("mass",))
    still = [replace(record, y=record.y[:, 1:], x=record.x[:, 1:], signals=kept) for record in records]
    with pytest.raises(ValueError, match=r"run0\.csv: no signal moves in this or any other record"):
        signal_rate(still)


def test_errors_are_relative_and_leave_the_transient_out(tracking):
    record = resampled(both(0, n=300), DT)
    x_hat = KKLObserver(tracking, 0.0).estimate(record.y, record.u)
    expected = np.sqrt(np.mean((x_hat - record.x)[100:] ** 2, 0)) / record.x[100:].std(0)
    found = recorded_errors(tracking, [record], after=5.0)
    assert found == pytest.approx(dict(zip(("position", "speed"), expected)))
    assert np.isnan(recorded_errors(tracking, [record], after=100.0)["speed"])
