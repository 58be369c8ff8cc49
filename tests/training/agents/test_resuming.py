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

from kkl_gym import KKLVectorEnv
from training import checkpoints
from training.agents.agent import Agent
from training.agents.learn import learn
from training.agents.play import play
from training.agents.tasks import ControlTask
from training.cli import main

TASK = ControlTask("van_der_pol", measurement_noise=0.2, duration=0.5)
ROLLOUT = {"ppo": 256 * 32, "sac": 16}
OBS = np.ones((3, 2), np.float32)


@pytest.fixture
def saves(monkeypatch):
    """What checkpoints hold that are due at each rollout's beginning; number ``saves.stop`` is the first to be written.

    Then the training is interrupted.
    """

    class Saves(list):
        stop = None

    saved, save = Saves(), checkpoints.save

    def noted(path, state, **options):
        if len(saved) + 1 < saved.stop:
            saved.append(None)
            return
        save(path, state, **options)
        saved.append(checkpoints.load(path))
        if len(saved) == saved.stop:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints, "SECONDS", -1.0)
    monkeypatch.setattr(checkpoints, "save", noted)
    return saved


@pytest.fixture
def seeds(monkeypatch):
    """Seeds of the episodes that trainings begin with."""
    given, reset = [], KKLVectorEnv.reset

    def noted(self, *, seed=None, options=None):
        if seed is not None:
            given.append(set(seed))
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(KKLVectorEnv, "reset", noted)
    return given


@pytest.mark.parametrize(("algorithm", "rollouts"), [("ppo", 2), ("sac", 130)])
def test_nothing_but_the_episodes_begins_anew(algorithm, rollouts, tmp_path, saves, seeds):
    timesteps = (rollouts + 1) * ROLLOUT[algorithm]

    def go_on(folder, resume=True):
        return learn(TASK, "state", folder, timesteps=timesteps, algorithm=algorithm, resume=resume)

    saves.stop = rollouts + 1
    with pytest.raises(KeyboardInterrupt):
        go_on(tmp_path, resume=False)
    assert not (tmp_path / "agent.safetensors").exists()
    curve = (tmp_path / "progress.csv").read_text()
    shutil.copytree(tmp_path, tmp_path / "copy")

    agent = go_on(tmp_path)
    before, after = saves[rollouts], saves[rollouts + 1]  # the last before the end, and the first of what goes on
    assert before["counters"][0] == rollouts * ROLLOUT[algorithm]
    assert (before.pop("resumed"), after.pop("resumed")) == (0, 1)
    assert before.pop("curve") == after.pop("curve") == curve
    assert before.keys() == after.keys()
    torch.testing.assert_close(after, before, rtol=0, atol=0)  # networks, optimisers, counters, replay buffer
    assert agent.training["timesteps"] == timesteps
    assert agent.training["resumed"] == 1
    first, second = seeds
    assert not first & second

    assert np.array_equal(go_on(tmp_path / "copy")(OBS), agent(OBS))  # random by seed and checkpoint alone
    whole = (tmp_path / "progress.csv").read_text()
    if algorithm == "ppo":
        assert whole.startswith(curve)
        assert pd.read_csv(tmp_path / "progress.csv")["time/total_timesteps"].tolist() == [8192, 16384, 24576]

    done = go_on(tmp_path)  # nothing is left to do
    assert np.array_equal(done(OBS), agent(OBS))
    assert done.training == agent.training
    assert (tmp_path / "progress.csv").read_text() == whole


def test_what_is_resumed_must_be_the_same_training_and_whole(tmp_path):
    agent = learn(TASK, "state", tmp_path, timesteps=1)
    assert "resumed" not in agent.training
    for changed in ({"seed": 1}, {"timesteps": 2}, {"algorithm": "sac"}, {"information": "y"}):
        options = {"information": "state", "timesteps": 1, **changed}
        with pytest.raises(ValueError, match="belongs to another configuration"):
            learn(TASK, options.pop("information"), tmp_path, resume=True, **options)
    path = tmp_path / "agent.checkpoint.pt"
    whole = path.read_bytes()
    for lacking in ("parameters", "curve"):
        path.write_bytes(whole)
        state = torch.load(path, weights_only=True)
        del state[lacking]
        torch.save(state, path)
        with pytest.raises(ValueError, match=rf"agent\.checkpoint\.pt is damaged.* it lacks '{lacking}'"):
            learn(TASK, "state", tmp_path, timesteps=1, resume=True)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(ValueError, match=r"agent\.checkpoint\.pt is damaged"):
        learn(TASK, "state", tmp_path, timesteps=1, resume=True)
    learn(TASK, "state", tmp_path, timesteps=1)  # from the beginning
    assert np.array_equal(Agent.read(tmp_path / "agent.safetensors")(OBS), agent(OBS))


def test_the_command_goes_on(tmp_path, capsys, saves):
    command = ["agent", "train", "van_der_pol", "--information", "y", "--timesteps", "16384", "--out", str(tmp_path)]
    saves.stop = 2
    with pytest.raises(SystemExit):
        main(command)
    assert "kkl-gym: interrupted; --resume goes on from the last checkpoint" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="holds the checkpoint of a training"):
        main(command)
    main([*command, "--resume"])
    assert [state["counters"][0] for state in saves[1:]] == [8192, 8192, 16384]
    path = tmp_path / "agent.safetensors"
    agent, whole = Agent.read(path), path.read_bytes()
    assert play(agent.make(2), agent, steps=3, seed=0).x.shape == (4, 2, 2)
    main([*command, "--resume"])
    assert path.read_bytes() == whole
    with pytest.raises(SystemExit, match="holds an agent already"):
        main(command)
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == [
        "agent.checkpoint.pt",
        "agent.safetensors",
        "log.txt",
        "progress.csv",
    ]


def test_a_full_disk_is_told_by_the_name_of_the_file(tmp_path, monkeypatch):
    def full(self, *arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for owner, method, name in (
        (CSVOutputFormat, "write", "progress.csv"),
        (Path, "write_bytes", "agent.checkpoint.pt"),
    ):
        says = re.escape(f"No space left on device: '{tmp_path / name}'")
        with monkeypatch.context() as patched:
            patched.setattr(owner, method, full)
            with pytest.raises(OSError, match=says):
                learn(TASK, "y", tmp_path, timesteps=1)
    assert os.listdir(tmp_path) == ["progress.csv"]
