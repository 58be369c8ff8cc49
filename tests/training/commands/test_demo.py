"""``kkl-gym demo``."""

import time
from dataclasses import replace
from itertools import pairwise

import linear_system
import numpy as np
import pytest
from PIL import Image, ImageSequence
from random_artifacts import random_artifact

from training.cli import main
from training.commands import portraits
from training.commands.demo import play
from training.commands.options import shown

OWN = f"{linear_system.__file__}:Oscillator"
AUTONOMOUS = f"{linear_system.__file__}:Autonomous"


def test_all_that_ship(tmp_path, capsys):
    main(["demo", "--out", str(tmp_path), "--duration", "1"])
    out = capsys.readouterr().out
    assert "KKLLorenz-v0" in out
    assert "measurement noise 0.5" in out
    assert (tmp_path / "estimates.png").stat().st_size > 10_000


@pytest.mark.parametrize("system", [OWN, AUTONOMOUS])
def test_a_system_of_ones_own(system, saved, tmp_path, capsys):
    observer = saved(system=system, dt=0.02)
    main(
        [
            "demo",
            system,
            "--observer",
            observer,
            "--out",
            str(tmp_path),
            "--duration",
            "1",
            "--measurement-noise",
            "0.2",
        ]
    )
    out = capsys.readouterr().out
    name = system.rpartition(":")[2].lower()
    assert f" {name} " in out
    assert "SPINN" not in out
    assert (tmp_path / f"estimates-{name}.png").stat().st_size > 10_000


def test_a_moving_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(portraits, "FRAMES", 4)
    main(["demo", "lorenz", "--gif", "--out", str(tmp_path), "--duration", "2"])
    assert f"wrote {tmp_path / 'estimates-lorenz.gif'}" in capsys.readouterr().out.replace("\n", "")
    with Image.open(tmp_path / "estimates-lorenz.gif") as gif:
        frames = [np.asarray(frame.convert("L"), int) for frame in ImageSequence.Iterator(gif)]
    assert len(frames) == 4
    assert all(abs(one - other).max() > 50 for one, other in pairwise(frames))


def test_one_that_ships_with_another_observer(tmp_path, capsys):
    main(["demo", "lorenz", "--observer", "lorenz-small", "--out", str(tmp_path), "--duration", "1"])
    assert "observer" in capsys.readouterr().out
    assert (tmp_path / "estimates-lorenz.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--observer", "lorenz"], "name the system that the observer lorenz is for"),
        (["lorenz", "--observer", "rossler"], "the observer was made for the system 'rossler'"),
        (["lorentz"], "unknown system 'lorentz'"),
        ([OWN, "--observer", "nowhere.safetensors"], "nowhere.safetensors"),
    ],
)
@pytest.mark.parametrize("command", ["demo", "speed"])
def test_what_cannot_be_shown(command, arguments, message):
    with pytest.raises(SystemExit, match=message):
        main([command, *arguments])


@pytest.mark.parametrize(("policy", "rest"), [(None, 0.0), ("controller", 0.0), (f"{__file__}:push", 0.5)])
def test_the_policy_of_its_training_acts(policy, rest, tmp_path):
    """An oscillator without damping comes to rest under its regulator, pushed at u = 0.5, alone nowhere."""
    artifact = random_artifact(system=OWN, dt=0.02)
    trained = replace(artifact, training={**artifact.training, "policy": policy} if policy else artifact.training)
    trained.save(tmp_path / "map.safetensors")
    (environment,) = shown(OWN, str(tmp_path / "map.safetensors"))
    named = policy if policy and policy != "controller" else None
    x = play(environment, 2000, 0.1, seed=0, policy=named).x
    late = x[1500:]
    if policy is None:
        assert np.ptp(late, axis=0).min() > 0.5
    elif named:
        assert late.mean(0) == pytest.approx([rest, 0.0], abs=0.1)
        assert np.ptp(x[:500], axis=0).min() > 0.5
        with pytest.raises(ValueError, match=r"was trained under the policy .*, which acts"):
            play(environment, 2000, 0.1, seed=0)
    else:
        assert np.abs(late).max() < 0.3


def push(x):
    """Push as far as the input goes."""
    return np.ones((len(x), 1))


def test_what_a_policy_returns_and_how_long_it_takes(saved):
    """Training takes actions of any type that counts as numbers; the time of a step is not the policy's."""
    (environment,) = shown(OWN, saved(system=OWN, dt=0.02))
    episode = play(environment, 20, 0.1, seed=0, policy=f"{__file__}:slow_switch")
    assert len(episode.x) == 21
    assert episode.seconds < 0.2


def slow_switch(x):
    """On or off, after a while."""
    time.sleep(0.02)
    return x[:, :1] > 0


@pytest.mark.parametrize("policy", [None, f"{__file__}:push"])
def test_spinn_is_shown_where_it_is_told_as_much(policy):
    """Its maps know no inputs."""
    (environment,) = shown("reverse_duffing", None)
    episode = play(environment, 5, 0.1, seed=0, policy=policy)
    assert (episode.spinn is None) == (policy is not None)


def test_a_window_takes_no_policy():
    with pytest.raises(SystemExit, match="leave out --policy beside --live"):
        main(["demo", "lorenz", "--live", "--policy", f"{__file__}:push"])


def test_a_demo_needs_an_observer():
    with pytest.raises(SystemExit, match="no observer ships for 'oscillator': name a file, --observer FILE"):
        main(["demo", OWN])
