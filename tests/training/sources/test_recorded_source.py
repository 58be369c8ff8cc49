import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_runs import SIGNALS, SMALL, swing
from training.recorded.config import recorded_config, signal_rate
from training.recorded.errors import recorded_errors
from training.recorded.fit import train_recorded
from training.recorded.preparing import split

from observers import Artifact, KKLObserver
from training.maps.networks import Network, averaged
from training.records import Record, resampled


def trained(records, folder, **changes):
    config = recorded_config(records, {**SMALL, **changes})
    return train_recorded(records, config, folder, name="spring", device=torch.device("cpu"))


def test_an_observer_from_recorded_states(tmp_path):
    records = [swing(seed, jitter=0.1) for seed in range(6)]
    result = trained(records, tmp_path, untold_noise=0.01)
    assert len(result.held_out) == 1
    assert result.errors.relative["speed"] < 0.2  # held out; the derivative of a driven position
    result.artifact.save(tmp_path / "spring.safetensors")
    artifact = Artifact.read(tmp_path / "spring.safetensors")
    assert artifact.signals == {"measured": ["position"], "inputs": ["force"], "hidden": ["speed"]}
    assert artifact.training["held_out_errors"] == pytest.approx(result.errors.relative)
    new = resampled(swing(100), artifact.filter.dt)
    x_hat = KKLObserver(artifact).estimate(new.y, new.u)
    late = slice(200, None)
    assert np.sqrt(np.mean((x_hat - new.x)[late] ** 2)) < 0.2 * new.x.std()
    with pytest.raises(ValueError, match=r"recorded states: speed from position and force, every 0.05 s.*environment"):
        artifact.check("spring", {}, dt=0.05, ny=1, nu=1)


def test_resuming_makes_the_same_observer(tmp_path):
    records, options = [swing(seed) for seed in range(3)], {"members": 2, "inverse_steps": 20, "held_out": 0.0}
    first = trained(records, tmp_path, **options)
    assert first.held_out == []
    (tmp_path / "inverse-2.checkpoint.pt").unlink()
    with pytest.raises(ValueError, match="holds the checkpoints of a run"):
        trained(records, tmp_path, **options)
    config = recorded_config(records, {**SMALL, **options})
    again = train_recorded(records, config, tmp_path, name="spring", resume=True, device=torch.device("cpu"))
    for a, b in zip(first.artifact.inverse.mlp.weights, again.artifact.inverse.mlp.weights):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match=r"a run of another configuration: .*records = "):
        train_recorded([*records[:2], swing(7)], config, tmp_path, name="spring", resume=True)


def test_estimates_do_not_hang_on_an_arbitrary_zero(tmp_path):
    records, new = [swing(seed) for seed in range(3)], resampled(swing(100), 0.05)
    artifact = trained(records, tmp_path / "a", inverse_steps=20, arbitrary_zero=("position",)).artifact
    here, there = (KKLObserver(artifact).estimate(new.y + offset, new.u) for offset in (0.0, 100.0))
    np.testing.assert_allclose(here, there, atol=1e-3 * new.x.std())
    assert here[-1] != pytest.approx(here[-50])  # it does move
    with pytest.raises(ValueError, match=r"arbitrary_zero names 'angle'; measured are position"):
        trained(records, tmp_path / "b", arbitrary_zero=("angle",))


def test_without_states_or_with_short_records(tmp_path):
    with pytest.raises(ValueError, match=r"no hidden states were recorded; name their columns \(--hidden\)"):
        trained([replace(swing(0), x=None, signals=replace(SIGNALS, hidden=()))], tmp_path)
    with pytest.raises(ValueError, match=r"run0.csv: column time, row 40: .* filter remembers .* faster eigenvalues"):
        trained([swing(0, n=40)], tmp_path)


def test_the_mean_of_networks_is_a_network():
    torch.manual_seed(0)
    networks = [Network(3, 2, width=5, depth=depth, activation="tanh") for depth in (2, 2, 2)]
    inputs = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    expected = np.mean([network.export()(inputs) for network in networks], 0)
    np.testing.assert_allclose(averaged(networks)(inputs), expected, rtol=1e-4, atol=1e-6)


def test_what_is_held_out():
    records = [resampled(swing(seed, n=100)) for seed in range(10)]
    kept, held_out = split(records, 0.3, 0)
    assert (len(kept), len(held_out)) == (7, 3)
    assert {record.name for record in kept + held_out} == {record.name for record in records}
    assert split(records, 0.3, 1)[1] != held_out
    kept, held_out = split(records[:2], 0.3, 0)
    assert [len(record.t) for record in kept + held_out] == [70, 70, 30, 30]
    assert held_out[0].t[0] == records[0].t[70]
    assert split(records, 0.0, 0) == (records, [])


def test_the_rate_of_signals_is_their_angular_frequency():
    t = 0.01 * np.arange(5000)
    record = Record("a", t, np.sin(3 * t)[:, None], x=np.stack([np.cos(3 * t), 5 + np.sin(3 * t)], -1))
    assert signal_rate([record]) == pytest.approx(3.0, rel=1e-2)
    config = recorded_config([record])
    assert config.dt == pytest.approx(0.01)
    assert config.eigenvalues[0] == pytest.approx(-0.45, rel=1e-2)
    assert config.eigenvalues[-1] == pytest.approx(-30, rel=1e-2)
    assert config.measurement_noise_max == pytest.approx(0.1 / 2**0.5, rel=1e-2)
    assert recorded_config([record], {"dt": 0.05, "seed": 3}).eigenvalues[-1] == -10.0
    assert json.dumps(config.eigenvalues)


def test_signals_that_stand_still_in_each_record(tmp_path):
    """They do not slow the filter down, and have no relative error."""
    signals = replace(SIGNALS, measured=("position", "target"), hidden=("speed", "mass"))
    records = []
    for seed in range(6):
        run, ones = swing(seed), np.full((600, 1), 0.1 * (seed + 1))
        records.append(replace(run, y=np.hstack([run.y, ones]), x=np.hstack([run.x, ones]), signals=signals))
    alone = recorded_config([swing(seed) for seed in range(6)], SMALL)
    config = recorded_config(records, SMALL)
    assert config.eigenvalues == alone.eigenvalues
    errors = trained(records, tmp_path).errors.relative
    assert errors["speed"] < 0.3
    assert np.isnan(errors["mass"])
    kept = replace(SIGNALS, measured=("target",), hidden=("mass",))
    still = [replace(record, y=record.y[:, 1:], x=record.x[:, 1:], signals=kept) for record in records]
    with pytest.raises(ValueError, match=r"run0\.csv: no signal moves, nor in any other record"):
        signal_rate(still)


def test_errors_are_relative_and_leave_the_transient_out(tmp_path):
    records = [swing(seed, n=300) for seed in range(2)]
    artifact = trained(records, tmp_path, inverse_steps=20).artifact
    record = resampled(records[0], 0.05)
    x_hat = KKLObserver(artifact).estimate(record.y, record.u)
    expected = np.sqrt(np.mean((x_hat - record.x)[100:] ** 2)) / record.x[100:].std()
    found = recorded_errors(artifact, [record], after=5.0)
    assert found.relative == pytest.approx({"speed": expected})
    assert found.seconds == pytest.approx(10.0)
    assert str(found) == f"speed {expected:.3g} (10 s, after 5 s of transient)"
    assert np.isnan(recorded_errors(artifact, [record], after=100.0).relative["speed"])
