"""Trainings of agents that were cut off and go on."""

import errno
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3.common.logger import CSVOutputFormat

from training import checkpoints
from training.agents.agent import Agent
from training.agents.bridge import SB3VecEnv
from training.agents.checkpoint import Checkpoint
from training.agents.learn import learn
from training.agents.play import play
from training.agents.tasks import ControlTask
from training.cli import main

TASK = ControlTask("van_der_pol", measurement_noise=0.2, duration=0.5)
ROLLOUT = {"ppo": 256 * 32, "sac": 16}


def cut_off(monkeypatch, rollouts):
    """Lets the next training be interrupted at the beginning of a rollout, by its number, after its checkpoint."""
    start, begun = Checkpoint._on_rollout_start, []

    def interrupted(self):
        start(self)
        begun.append(self.model.num_timesteps)
        if len(begun) == rollouts + 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoint, "_on_rollout_start", interrupted)
    return begun


@pytest.mark.parametrize(("algorithm", "rollouts"), [("ppo", 2), ("sac", 130)])
def test_nothing_but_the_episodes_begins_anew(algorithm, rollouts, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "SECONDS", -1.0)
    timesteps, path = (rollouts + 1) * ROLLOUT[algorithm], tmp_path / "agent.checkpoint.pt"
    seeds, reset = [], SB3VecEnv.reset

    def keep(self):
        seeds.append(set(self._seeds))
        return reset(self)

    monkeypatch.setattr(SB3VecEnv, "reset", keep)
    begun = cut_off(monkeypatch, rollouts)
    with pytest.raises(KeyboardInterrupt):
        learn(TASK, "state", tmp_path, timesteps=timesteps, algorithm=algorithm)
    monkeypatch.undo()
    monkeypatch.setattr(SB3VecEnv, "reset", keep)
    assert begun[-1] == rollouts * ROLLOUT[algorithm]
    assert not (tmp_path / "agent.safetensors").exists()
    before, curve = checkpoints.load(path), (tmp_path / "progress.csv").read_text()
    shutil.copytree(tmp_path, tmp_path / "copy")

    restored = []
    restore = Checkpoint.restore

    def look(self, model, steps):
        restore(self, model, steps)
        self.model = model
        self.path = tmp_path / "again.pt"
        self._save()
        restored.append(checkpoints.load(self.path))
        self.path = path

    monkeypatch.setattr(Checkpoint, "restore", look)
    agent = learn(TASK, "state", tmp_path, timesteps=timesteps, algorithm=algorithm, resume=True)
    monkeypatch.undo()
    (after,) = restored
    assert (after.pop("resumed"), before.pop("resumed")) == (1, 0)
    assert after.pop("curve") == before.pop("curve") == curve
    assert after.keys() == before.keys()
    torch.testing.assert_close(after, before, rtol=0, atol=0)  # networks, optimisers, counters, replay buffer
    assert before["counters"][0] == begun[-1]
    assert agent.training["timesteps"] == timesteps
    assert agent.training["resumed"] == 1
    first, second = seeds
    assert not first & second

    again = learn(TASK, "state", tmp_path / "copy", timesteps=timesteps, algorithm=algorithm, resume=True)
    obs = np.ones((3, 2), np.float32)
    assert np.array_equal(again(obs), agent(obs))  # what is random depends on seed and checkpoint alone
    whole = (tmp_path / "progress.csv").read_text()
    if algorithm == "ppo":
        assert whole.startswith(curve)
        assert pd.read_csv(tmp_path / "progress.csv")["time/total_timesteps"].tolist() == [8192, 16384, 24576]

    done = learn(
        TASK, "state", tmp_path, timesteps=timesteps, algorithm=algorithm, resume=True
    )  # nothing is left to do
    assert np.array_equal(done(obs), agent(obs))
    assert done.training == agent.training
    assert (tmp_path / "progress.csv").read_text() == whole


def test_what_is_resumed_must_be_the_same_training(tmp_path, monkeypatch):
    agent = learn(TASK, "y", tmp_path, timesteps=1)
    assert "resumed" not in agent.training
    for changed in ({"seed": 1}, {"timesteps": 2}, {"algorithm": "sac"}, {"information": "state"}):
        options = {"information": "y", "timesteps": 1, **changed}
        with pytest.raises(ValueError, match="belongs to another configuration"):
            learn(TASK, options.pop("information"), tmp_path, resume=True, **options)
    path = tmp_path / "agent.checkpoint.pt"
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(ValueError, match=r"agent\.checkpoint\.pt is damaged"):
        learn(TASK, "y", tmp_path, timesteps=1, resume=True)
    learn(TASK, "y", tmp_path, timesteps=1)  # anew
    assert np.array_equal(Agent.read(tmp_path / "agent.safetensors")(np.ones((1, 1))), agent(np.ones((1, 1))))


@pytest.mark.parametrize("lacking", ["parameters", "counters", "resumed", "curve"])
def test_checkpoints_that_lack_something(lacking, tmp_path):
    learn(TASK, "y", tmp_path, timesteps=1)
    path = tmp_path / "agent.checkpoint.pt"
    state = torch.load(path, weights_only=True)
    del state[lacking]
    torch.save(state, path)
    with pytest.raises(
        ValueError, match=f"agent.checkpoint.pt is damaged or of an older version.* it lacks '{lacking}'"
    ):
        learn(TASK, "y", tmp_path, timesteps=1, resume=True)


def test_the_command_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(checkpoints, "SECONDS", -1.0)
    begun = cut_off(monkeypatch, 1)
    command = ["agent", "train", "lorenz", "--information", "y", "--timesteps", "16384", "--out", str(tmp_path)]
    with pytest.raises(SystemExit):
        main(command)
    assert "kkl-gym: interrupted; --resume goes on from the last checkpoint" in capsys.readouterr().err
    assert begun == [0, 8192]
    with pytest.raises(SystemExit, match="holds the checkpoint of a training"):
        main(command)
    main([*command, "--resume"])
    assert begun == [0, 8192, 8192]
    path = tmp_path / "agent.safetensors"
    agent, whole = Agent.read(path), path.read_bytes()
    assert play(agent.make(2), agent, steps=3, seed=0).x.shape == (4, 2, 3)
    main([*command, "--resume"])
    assert path.read_bytes() == whole
    with pytest.raises(SystemExit, match="holds an agent already"):
        main(command)
    assert sorted(Path(tmp_path).glob("[!.]*")) == [
        tmp_path / name for name in ("agent.checkpoint.pt", "agent.safetensors", "log.txt", "progress.csv")
    ]


def test_a_full_disk_is_told_by_the_name_of_the_file(tmp_path, monkeypatch):
    def full(self, *arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(CSVOutputFormat, "write", full)
        with pytest.raises(OSError, match=re.escape(f"No space left on device: '{tmp_path / 'progress.csv'}'")):
            learn(TASK, "y", tmp_path, timesteps=1)
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=re.escape(f"No space left on device: '{tmp_path / 'agent.checkpoint.pt'}'")):
        learn(TASK, "y", tmp_path, timesteps=1)
    assert os.listdir(tmp_path) == ["progress.csv"]
