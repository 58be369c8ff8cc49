"""``gym.make("kkl_gym/Own-v0", system=...)``: systems of one's own by an id, in worker processes too."""

import shutil

import gymnasium as gym
import linear_system
import numpy as np
import pytest

import kkl_gym

SCRIPT = linear_system.__file__
SINGLE = f"{SCRIPT}:Oscillator"


def test_one_environment():
    env = gym.make("kkl_gym/Own-v0", system=SINGLE, dt=0.02)
    assert (env.unwrapped.system.name, env.unwrapped.dt) == ("oscillator", 0.02)
    assert env.spec.max_episode_steps == 5000
    direct = kkl_gym.KKLEnv(SINGLE, dt=0.02)
    assert env.reset(seed=0)[0].tolist() == direct.reset(seed=0)[0].tolist()
    assert gym.make(env.spec).reset(seed=0)[0].tolist() == direct.reset(seed=0)[0].tolist()


def test_many_as_one_batch():
    envs = gym.make_vec(kkl_gym.OWN_ID, num_envs=3, system=SINGLE)
    assert isinstance(envs, kkl_gym.KKLVectorEnv)
    assert envs.max_episode_steps == 5000
    assert np.isfinite(envs.reset(seed=0)[0]).all()


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_a_system_must_be_named(make):
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'system'"):
        make(kkl_gym.OWN_ID)
    with pytest.raises(ValueError, match="the system must be the name of one or"):
        make(kkl_gym.OWN_ID, system=None)


@pytest.mark.parametrize(("where", "instance"), [("script", True), ("module", False)])
def test_worker_processes_find_the_class(where, instance, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SCRIPT, tmp_path / "found_from_here.py")
    name = "found_from_here:Oscillator" if where == "module" else "found_from_here.py:Oscillator"
    system = kkl_gym.get_system(name) if instance else name
    envs = gym.make_vec(kkl_gym.OWN_ID, vectorization_mode="async", vector_kwargs={"context": "spawn"}, system=system)
    expected, _ = kkl_gym.KKLEnv(SINGLE).reset(seed=0)
    assert envs.reset(seed=0)[0].tolist() == [expected.tolist()]
    envs.close()
