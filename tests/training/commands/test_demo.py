"""``kkl-gym demo``."""

from dataclasses import replace
from itertools import pairwise

import gymnasium as gym
import linear_system
import numpy as np
import pytest
from PIL import Image, ImageSequence
from random_artifacts import random_artifact

from kkl_gym import KKLObservation, get_system
from training.cli import main
from training.commands import demo
from training.commands.demo import play
from training.commands.options import model_of, read_policy, shown, system_of

OWN = f"{linear_system.__file__}:Oscillator"


def test_all_that_ship(tmp_path, capsys):
    main(["demo", "--out", ".", "--duration", "1"])
    out = capsys.readouterr().out
    assert "KKLLorenz-v0" in out
    assert "measurement noise 0.5" in out
    assert "SPINN" in out
    assert (tmp_path / "estimates.png").stat().st_size > 10_000


def test_a_user_system(saved, tmp_path, capsys):
    system = f"{linear_system.__file__}:Autonomous"
    observer = saved(system=system, dt=0.02)
    main(["demo", system, "--observer", observer, "--out", ".", "--duration", "1", "--measurement-noise", "0.2"])
    out = capsys.readouterr().out
    assert " autonomous " in out
    assert "SPINN" not in out
    assert (tmp_path / "estimates-autonomous.png").stat().st_size > 10_000


def test_an_observer_of_a_bias(capsys):
    system, artifact = get_system("van_der_pol"), random_artifact(system="lorenz")
    training = artifact.training | {"bias": 1.0, "policy": "controller"}
    artifact = replace(artifact, system=system.name, parameters=system.parameters, training=training)
    artifact.save("biased.safetensors")
    main(["demo", "van_der_pol", "--observer", "biased.safetensors", "--out", ".", "--duration", "1"])
    assert "KKLVanDerPol-v0" in capsys.readouterr().out
    assert system_of(artifact, None) == system
    main(["evaluate", "biased.safetensors", "--plant", "mu=3.3", "--trajectories", "2", "--duration", "1"])
    assert "plant mu=3.3, model mu=3" in " ".join(capsys.readouterr().out.split())
    assert model_of(artifact, system).nx == 3
    policy, x = read_policy(artifact, system, None), np.array([[0.3, -0.2, 0.9]])
    np.testing.assert_array_equal(policy(x), policy(x[:, :2]))
    env = gym.make("KKLVanDerPol-v0")
    with pytest.raises(ValueError, match="this observer estimates a bias too, of which no start is known"):
        KKLObservation(env, "biased.safetensors", known_start=True)
    with pytest.raises(SystemExit, match=r"biased\.safetensors estimates a bias, which agents do not see"):
        main(["agent", "train", "van_der_pol", "--observer", "biased.safetensors", "--timesteps", "400"])


def test_a_moving_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "FRAMES", 4)
    main(["demo", "lorenz", "--gif", "--out", ".", "--duration", "2"])
    assert "wrote estimates-lorenz.gif" in capsys.readouterr().out.replace("\n", "")
    with Image.open(tmp_path / "estimates-lorenz.gif") as gif:
        frames = [np.asarray(frame.convert("L"), int) for frame in ImageSequence.Iterator(gif)]
    assert len(frames) == 4
    assert all(abs(one - other).max() > 50 for one, other in pairwise(frames))


def push(x):
    """A policy with the largest input."""
    return np.ones((len(x), 1))


def test_the_demo_uses_the_policy_of_the_training(tmp_path):
    """The undamped oscillator rests at 0 under its regulator, near u = 0.5 when pushed, and never without a policy."""
    artifact, pushed = random_artifact(system=OWN, dt=0.02), f"{__file__}:push"
    late = {}
    for policy in (None, "controller", pushed):
        trained = artifact.training | ({"policy": policy} if policy else {})
        replace(artifact, training=trained).save("map.safetensors")
        (environment,) = shown(OWN, "map.safetensors")
        late[policy] = play(environment, 2000, 0.1, seed=0, policy=pushed if policy == pushed else None).x[1500:]
    assert np.ptp(late[None], axis=0).min() > 0.5
    assert np.abs(late["controller"]).max() < 0.3
    assert late[pushed].mean(0) == pytest.approx([0.5, 0.0], abs=0.1)
    with pytest.raises(ValueError, match=r"was trained under the policy .*, and must be evaluated"):
        play(environment, 2000, 0.1, seed=0)
