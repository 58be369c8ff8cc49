"""Agents under several kinds of partial observability, at toy size."""

import numpy as np
import pandas as pd
import pytest
import torch
from commands import research
from gymnasium.spaces import Box
from small_agents import make_small

from examples.research.agents import kinds
from examples.research.agents.partly import Partly
from examples.research.agents.recurrent import LinearRecurrence


def play(steps, **sensor):
    env = Partly("Pendulum-v1", **sensor)
    env.action_space.seed(0)
    rows = [env.reset(seed=0)[0]]
    rows += [env.step(env.action_space.sample())[0] for _ in range(steps)]
    return np.array(rows)[:, :2], np.array(rows)[:, 2:]


def test_sensors_show_late_lost_and_noisy_samples():
    y, x = play(50)
    np.testing.assert_array_equal(y, x[:, :2])
    y, x = play(50, delay=5)
    np.testing.assert_array_equal(y[5:], x[:-5, :2])
    np.testing.assert_array_equal(y[:5], np.repeat(x[:1, :2], 5, axis=0))
    y, x = play(199, drop_out=0.3, hold=False)
    lost = np.isnan(y).any(1)
    assert 0.2 < lost.mean() < 0.4
    held, _ = play(199, drop_out=0.3)
    np.testing.assert_array_equal(held[~lost], x[~lost, :2])
    np.testing.assert_array_equal(held[1:][lost[1:]], held[:-1][lost[1:]])
    y, x = play(199, noise=0.1)
    assert 0.08 < (y - x[:, :2]).std() < 0.12


def test_parameters_vary_from_episode_to_episode():
    env = Partly("CartPole-v1", vary=True)
    drawn = np.array([env.reset(seed=seed)[0][-3:] for seed in range(50)])
    assert len(np.unique(drawn, axis=0)) == 50
    assert 0.5 <= drawn.min() < drawn.max() <= 2.0
    base = env.unwrapped
    assert base.total_mass == base.masspole + base.masscart == pytest.approx(1.0 + 0.1 * drawn[-1, 0], rel=1e-6)
    with pytest.raises(ValueError, match="InvertedDoublePendulum-v5 has no parameters to vary"):
        Partly("InvertedDoublePendulum-v5", vary=True)


def test_a_linear_recurrence_runs_over_the_frames():
    torch.manual_seed(0)
    frames, width, units = 6, 3, 4
    space = Box(-1.0, 1.0, (frames * width,))
    layer = LinearRecurrence(space, frames, units)
    x = torch.randn(2, frames, width)
    h = torch.zeros(2, units, dtype=torch.complex64)
    rate = torch.exp(layer.log_rate)
    for k in range(frames):
        h = torch.exp(torch.complex(-rate, layer.turn)) * h + torch.sqrt(1 - torch.exp(-2 * rate)) * (x[:, k] @ layer.B)
    out = layer(x.flatten(1))
    torch.testing.assert_close(out[:, :width], x[:, -1])
    torch.testing.assert_close(out[:, width:].unflatten(1, (units, 2)), torch.view_as_real(h))


def test_timed_agents_are_compared_and_not_trained_again(tmp_path):
    common = ("kinds", "--environments", "CartPole-v1", "--kinds", "delay", "masked", "--seeds", "1", "--jobs", "1")
    common += ("--seconds", "0.3", "--out", str(tmp_path), "--information")
    research(*common, "state", "lru")
    rows = pd.read_csv(tmp_path / "kinds.csv")
    last = rows.groupby(["kind", "shown"]).last()
    assert set(last.index) == {("masked", "state"), ("masked", "lru"), ("delay", "lru")}
    assert (last.seconds >= 0.3).all()
    assert (last["return"] > 5).all()
    assert all(group.steps.is_monotonic_increasing for _, group in rows.groupby(["kind", "shown"]))
    table = (tmp_path / "table.md").read_text()
    value = f"{last['return']['masked', 'state']:.4g}, 1"
    assert f"| `CartPole-v1`, delay | {value} |" in table  # the sensor does not change the state
    files = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/**/curve.csv")}
    research(*common, "state", "lru")
    assert {path: path.stat().st_mtime_ns for path in files} == files
    with pytest.raises(SystemExit, match="unknown kinds fog; there are masked, noise"):
        research("kinds", "--kinds", "fog", "--out", str(tmp_path))
    with pytest.raises(SystemExit, match=r"of another comparison: seconds = 0\.3 there, 0\.5 here"):
        research(*common, "state", "--seconds", "0.5")


@pytest.mark.parametrize("kind", ["parameters", "delay"])
def test_an_agent_sees_estimates_of_the_present_state(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(kinds, "OBSERVER_STEPS", 2_000)
    monkeypatch.setattr(kinds, "LAST_EPISODES", 2)
    make_small(monkeypatch)
    agent = kinds.TimedAgent("Pendulum-v1", kind, "x_hat", 0, 0.1, tmp_path)
    agent.work()
    assert (pd.read_csv(tmp_path / "curve.csv").steps > 2_000).all()  # includes the steps of the observer's rollouts
    env = agent.make(3, tmp_path / "observer.safetensors")
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        obs, *_, info = env.step(np.zeros((3, 1)))
    estimates = obs if kind == "delay" else obs[:, 2:]
    assert estimates.shape == info["x"].shape
    np.testing.assert_allclose(estimates, info["x_hat"], rtol=1e-5)
    if kind == "parameters":
        np.testing.assert_allclose(obs[:, :2], info["y"], rtol=1e-5)
    z = [kinds.TimedAgent("Pendulum-v1", sensor, "z", 0, 0.1, tmp_path).make(1) for sensor in ("masked", "noise")]
    assert z[0].observation_space.shape == (1, 8) > z[1].observation_space.shape  # weights under noise
