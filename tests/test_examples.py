"""The examples, and the commands and code of docs/guides/your_system.md."""

import re
import runpy
import shutil
from pathlib import Path
from types import MappingProxyType

import pytest

from examples.research.__main__ import COMMANDS
from training.cli import main

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
WRITTEN, TRAINED, USED, OTHER_PLANTS = (
    (ROOT / "docs" / "guides" / "your_system.md").read_text().partition(f"## {title}")[2].partition("\n## ")[0]
    for title in ("Write it", "Check it", "Use it", "Unstable plants")
)


def example(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]


def test_estimate(capsys):
    assert example("estimate")(seconds=5.0) < 0.1
    assert "x_hat" in capsys.readouterr().out


def test_known_start(capsys):
    found = example("known_start")(runs=20)
    for name, (*errors, sound, biased) in found.items():
        assert errors[2] < 0.05
        assert biased > 3 * sound, name
    assert found["reverse_duffing"][0] < 0.02 * found["reverse_duffing"][3]
    assert "reverse duffing" in capsys.readouterr().out


def test_any_environment(capsys):
    small = {"steps": 3000, "held_out": 500, "batches": 150}
    assert example("any_environment")(**small)["exploring"] < 0.5
    assert "the agent sees 3 numbers" in capsys.readouterr().out


@pytest.mark.slow
def test_any_environment_under_noise(capsys):
    found = example("any_environment")("CartPole-v1", steps=10_000, held_out=500, batches=500, noise=0.05)
    assert found["truth"] == 500
    assert found["tracked"] > found["T_inv alone"] + 20
    assert "rms errors" in capsys.readouterr().out


@pytest.mark.slow
def test_any_environment_agent(capsys):
    small = {"observer_steps": 400, "members": 1, "timesteps": 2048, "every": 1000, "batches": 200}
    found = example("any_environment_agent")(**small)
    assert list(found) == ["from random steps", "refitted", "on the truth first"]
    assert len(set(found.values())) == 3
    assert min(found.values()) > 0
    assert "refitted the observer at step 1024" in capsys.readouterr().out


def test_own_system(tmp_path):
    assert example("own_system")(inverse_steps=100, trajectories=30, out=tmp_path) < 40.0


@pytest.mark.slow
def test_own_task(tmp_path):
    found = example("own_task")(timesteps=8192, inverse_steps=100, trajectories=30, out=tmp_path)
    assert 50 < found["y"] < 2000
    assert 50 < found["x_hat"] < 2000


# Options with which each command for a user's system takes seconds.
SMALL = {
    "diagnose": "",
    "train": "--set trajectories=20 duration=5 samples=20 width=4 batch=64 inverse_steps=9 runs=100",
    "evaluate": "--trajectories 4 --duration 8",
    "agent train": "--timesteps 1",
    "agents": "--information state x_hat --seeds 1 --episodes 2 --timesteps 1 --jobs 1",
    "demo": "--duration 1",
}


def do(line, more=MappingProxyType({})):
    """Run a command line of a page with small sizes; return the command's name."""
    words = line.partition("#")[0].split()
    research = words[:3] == ["python", "-m", "examples.research"]
    assert research or words[0] == "kkl-gym"
    arguments = words[3:] if research else words[1:]
    name = " ".join(arguments[: 1 + (arguments[0] == "agent")])
    commands = {"commands": COMMANDS} if research else {}
    main([*arguments, *SMALL[name].split(), *more.get(name, [])], **commands)
    return name


def test_the_system_on_the_page_is_that_of_the_example():
    (written,) = re.findall(r"```python\n(.*?)```", WRITTEN, re.DOTALL)
    shown = {"__name__": "shown"}
    exec(written, shown)
    own, known = shown["Pendulum"](), runpy.run_path(str(EXAMPLES / "own_system.py"))["Pendulum"]()
    assert own.f((0.3, -0.2)) == known.f((0.3, -0.2))
    for attribute in ("name", "state_names", "parameters", "X", "bounds", "u_max", "G"):
        assert getattr(own, attribute) == getattr(known, attribute), attribute


@pytest.mark.slow
def test_the_page_on_your_system(tmp_path, capsys, monkeypatch):
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    own, agent, registered = re.findall(r"```python\n(.*?)```", USED, re.DOTALL)
    done = set()
    for line in "".join(re.findall(r"```sh\n(.*?)```", TRAINED + USED, re.DOTALL)).splitlines():
        done.add(do(line))
    assert done == set(SMALL)
    printed = capsys.readouterr().out
    for written in ("pendulum.safetensors", "table.md", "agent.safetensors", "scores.png"):
        assert written in printed
    path = "runs/pendulum/pendulum.safetensors"
    with pytest.raises(SystemExit, match="--system"):
        main(["evaluate", path])

    made = {}
    for script, env_id in ((own, "kkl_gym/Own-v0"), (registered, "HiddenPendulum-v0")):
        exec(script, made)
        env, envs = made["env"], made["envs"]
        x_hat, info = env.reset(seed=0)
        assert env.spec.id == env_id
        assert env.unwrapped.system.name == "pendulum"
        assert x_hat.shape == info["x"].shape == (2,)
        assert ("x_hat" in info) == (script is own)
        assert envs.reset(seed=0)[0].shape == (8, 2)
        if script is own:
            assert {"x", "y", "u", "x_hat"} <= set(made["info"])
            exec(agent.replace("2_000", "2"), made)
            assert made["agent"].predict(x_hat)[0].shape == (1,)
        assert [make.close() for make in (env, envs)] == [None, None]


@pytest.mark.slow
def test_the_page_on_unstable_plants(tmp_path, capsys, monkeypatch):
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    (commands,) = re.findall(r"```sh\n(.*?)```", OTHER_PLANTS, re.DOTALL)
    for line in commands.splitlines():
        do(line, {"evaluate": ["--measurement-noise", "0"]})
    with pytest.raises(SystemExit, match="--policy"):
        main(["evaluate", "runs/balance/cart_pole.safetensors", "--system", "examples/cart_pole.py:CartPole"])
    assert "wrote runs/balance/cart_pole.safetensors" in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.slow
def test_cart_pole(tmp_path, capsys):
    errors = example("cart_pole")(inverse_steps=1000, trajectories=200, out=tmp_path)
    assert (errors < 0.15).all()
    assert "after 10 s" in capsys.readouterr().out  # the pole has not fallen


@pytest.mark.slow
def test_circle_pendulum(tmp_path):
    errors = example("circle_pendulum")(inverse_steps=300, trajectories=100, out=tmp_path)
    assert (errors < 0.3).all()


@pytest.mark.slow
def test_adaptation(tmp_path, capsys):
    sizes = {"records": 6, "seconds": 12.0, "inverse_steps": 40, "trajectories": 40}
    found = example("adaptation")("van_der_pol", noise=0.1, **sizes, out=tmp_path)
    assert abs(found.parameters["mu"]) < 1.0  # % off; the guess is 9 % off
    assert found.trained < found.adapted < found.shipped
    assert "% off" in capsys.readouterr().out


@pytest.mark.slow
def test_from_csv(tmp_path, capsys):
    sizes = {"seconds": 4.0, "inverse_steps": 400, "trajectories": 60}
    mu, with_estimate, with_state = example("from_csv")(**sizes, out=tmp_path)
    assert abs(mu - 3.3) < 0.4
    assert with_state < with_estimate < 0.3  # without control: 0.38
    assert (tmp_path / "record-0.csv").read_text().startswith("t,u,y\n")
    assert "with x_hat" in capsys.readouterr().out


def test_memory(capsys):
    """The example prints the returns, and all randomness is seeded; a useful training would take longer."""
    sizes = {"steps": 150, "episodes": 2}
    returns = example("memory")(**sizes)
    printed = re.findall(r"(.*): mean return (-\d+) ± ", capsys.readouterr().out)
    assert printed == [(name, f"{value:.0f}") for name, value in returns.items()]
    assert example("memory")(**sizes) == returns
    assert example("memory")(**sizes, seed=1) != returns


def test_sb3_agent():
    reward = example("sb3_agent")(num_envs=2, steps=256)
    assert example("sb3_agent")(num_envs=2, steps=256) == reward  # all randomness is seeded
