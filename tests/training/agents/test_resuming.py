"""Resuming of interrupted trainings of agents."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from training import run
from training.agents.agent import Agent
from training.agents.learning import learn
from training.agents.tasks import HIDDEN_VELOCITIES, control_task

PENDULUM, CART = HIDDEN_VELOCITIES["Pendulum-v1"], HIDDEN_VELOCITIES["CartPole-v1"]
SHORT = control_task("van_der_pol", 0.2, duration=0.5)


@pytest.fixture
def saves(monkeypatch):
    """Collect an agent's checkpoints, one per rollout; after ``saves.stop`` checkpoints, interrupt the training."""

    class Saves(list):
        stop = None

    saved, save = Saves(), run.save_checkpoint

    def noted(path, state, **options):
        save(path, state, **options)
        if path.name != "agent.checkpoint.pt":  # a checkpoint of the observer
            return
        saved.append(run.load_checkpoint(path))
        if len(saved) == saved.stop:
            raise KeyboardInterrupt

    monkeypatch.setattr(run, "CHECKPOINT_SECONDS", -1.0)
    monkeypatch.setattr(run, "save_checkpoint", noted)
    return saved


def same(one, other):
    pairs = zip(one.network.weights, other.network.weights, strict=True)
    return one.task == other.task and all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("task", "information", "options", "stop"),
    [
        (SHORT, "state", {"algorithm": "ppo", "timesteps": 128}, 3),
        (SHORT, "state", {"algorithm": "sac", "timesteps": 60}, 50),
        (CART, "y", {"algorithm": "dqn", "timesteps": 60}, 12),
        (CART, "recurrent", {"timesteps": 128}, 3),
        (CART, "x_hat", {"timesteps": 600, "observer_steps": 400}, 8),  # on hidden signals
        (CART, "x_hat", {"timesteps": 600, "observer_steps": 300, "aggregate": 1}, 14),  # on estimates
        (replace(CART, measurement_noise=0.1), "x_hat", {"timesteps": 600, "observer_steps": 300}, 5),
        (replace(CART, measurement_noise=0.1), "z", {"timesteps": 600, "observer_steps": 500}, 2),  # normalised
    ],
)
def test_all_but_unfinished_episodes_is_resumed(task, information, options, stop, tmp_path, small, saves):
    out = tmp_path / "run"
    saves.stop = stop
    with pytest.raises(KeyboardInterrupt):
        learn(task, information, out, **options)
    assert not (out / "agent.safetensors").exists()
    shutil.copytree(out, tmp_path / "copy")
    agent = learn(task, information, out, resume=True, **options)
    before, after = saves[stop - 1], saves[stop]  # the last before the interruption, and the first after
    assert before["counters"]["num_timesteps"] > 0
    assert (before.pop("resumed"), after.pop("resumed")) == (0, 1)
    assert before.pop("restarts") + 1 == after.pop("restarts")
    moments = [state.pop("moments").get("obs_rms", {"count": 0}) for state in (before, after)]
    assert moments[1]["count"] - moments[0]["count"] in (0, 2)  # the reset adds two observations
    torch.testing.assert_close(after, before, rtol=0, atol=0)  # networks, optimisers, counters, replay buffer, steps
    assert agent.training["resumed"] == 1
    assert agent.training["timesteps"] >= 0.95 * options["timesteps"]  # the rest are rehearsal steps
    again = learn(task, information, tmp_path / "copy", resume=True, **options)
    assert same(again, agent)  # seed and checkpoint determine the result
    assert pd.read_csv(out / "curve.csv").steps.is_monotonic_increasing
    whole = (out / "agent.safetensors").read_bytes()
    assert same(learn(task, information, out, resume=True, **options), agent)  # a finished training is read
    assert (out / "agent.safetensors").read_bytes() == whole


def test_resuming_needs_the_same_training_and_a_valid_checkpoint(tmp_path, small):
    agent = learn(CART, "y", tmp_path)
    assert "resumed" not in agent.training
    for changed in ({"seed": 1}, {"timesteps": 2}, {"algorithm": "dqn"}, {"information": "z"}):
        options = {"information": "y", **changed}
        with pytest.raises(ValueError, match="belongs to another configuration"):
            learn(CART, options.pop("information"), tmp_path, resume=True, **options)
    (tmp_path / "agent.safetensors").unlink()
    path = tmp_path / "agent.checkpoint.pt"
    whole = path.read_bytes()
    for lacking in ("parameters", "curve"):
        path.write_bytes(whole)
        state = torch.load(path, weights_only=True)
        del state[lacking]
        torch.save(state, path)
        with pytest.raises(ValueError, match=rf"agent\.checkpoint\.pt is damaged.* it lacks '{lacking}'"):
            learn(CART, "y", tmp_path, resume=True)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(ValueError, match=r"agent\.checkpoint\.pt is damaged"):
        learn(CART, "y", tmp_path, resume=True)
    learn(CART, "y", tmp_path)  # starts from the beginning
    assert same(Agent.read(tmp_path / "agent.safetensors"), agent)
