"""Unmodified training programs on this package's environments; `make clients` runs them in their own environment."""

import os
import subprocess
import sys
from hashlib import sha256
from importlib.metadata import version
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from kkl_gym import ENV_IDS, KKLObservation

pytestmark = pytest.mark.clients
ROOT = Path(__file__).parent.parent.parent
ESTIMATED = "registered:VanDerPolEstimated-v0"
ACTIONS = 1000


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    """Put a module that registers our ids where this process and its child processes look for modules."""
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.setenv("PYTHONPATH", f"{ROOT / 'examples'}:{ROOT}:{os.environ.get('PYTHONPATH', '')}")


def output_of(*command, cwd):
    done = subprocess.run([sys.executable, *map(str, command)], cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode:
        raise AssertionError(done.stderr.strip().splitlines()[-1])
    return done.stdout


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize("env_id", ENV_IDS.values())
def test_rl_zoo3(algorithm, env_id, row, tmp_path, monkeypatch):
    """The package's own settings, for one rollout of PPO or a few hundred updates of SAC."""
    if find_spec("rl_zoo3") is None:  # not imported here: importing rl_zoo3 replaces Gymnasium's TimeLimit
        pytest.skip("rl_zoo3 is not installed")
    from stable_baselines3 import PPO, SAC

    from training.agents.sb3_files import from_sb3
    from training.agents.tasks import TASKS

    steps = 8192 if algorithm == "ppo" else 2400
    row("rl-zoo3", version("rl_zoo3"), f"{algorithm} on {env_id}", steps)
    settings = files("training.agents").joinpath("hyperparameters", f"{algorithm}.yml")
    command = f"-m rl_zoo3.train --algo {algorithm} --env {env_id} --gym-packages kkl_gym --eval-freq -1 -f {tmp_path}"
    printed = output_of(*command.split(), "--conf-file", settings, "-n", str(steps), "--device", "cpu", cwd=tmp_path)
    assert "training.agents.OnTask" in printed
    for module in (gym.wrappers, gym.wrappers.common):  # restored after this test
        monkeypatch.setattr(module, "TimeLimit", module.TimeLimit)
    made = PPO if algorithm == "ppo" else SAC
    agent = made.load(tmp_path / algorithm / f"{env_id}_1" / f"{env_id}.zip", device="cpu")
    assert agent.num_timesteps == steps
    name = next(name for name in ENV_IDS if ENV_IDS[name] == env_id)
    path = tmp_path / algorithm / f"{env_id}_1" / f"{env_id}.zip"
    ours = from_sb3(path, TASKS[name])  # raises an error if the agent does not fit the task
    obs = np.random.default_rng(0).normal(size=(20, ours.inputs)).astype(np.float32)
    actions = ours.policy(agent.action_space)(obs)
    np.testing.assert_allclose(actions, agent.predict(obs, deterministic=True)[0], atol=1e-5)


# Gymnasium 1 requires an argument that CleanRL's scripts omit; they fail on Gymnasium's own environments too.
WITH_DEFAULT = """
import runpy, sys
from gymnasium.wrappers import TransformObservation
TransformObservation.__init__.__defaults__ = (None,)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_cleanrl(row, tmp_path):
    """Any script that takes --env-id and --total-timesteps; CleanRL's own scripts have no package for Python 3.11."""
    pytest.importorskip("tensorboard")
    pytest.importorskip("tyro")
    path = os.environ.get("CLEANRL", "")
    if not path:
        row("CleanRL", "", "a single file")
        pytest.skip("no release for Python 3.11 or newer; name a file: make clients CLEANRL=ppo_continuous_action.py")
    its_version, ran = f"sha256 {sha256(Path(path).read_bytes()).hexdigest()[:8]}", Path(path).name
    options = ["--total-timesteps", "4096", "--no-cuda"]
    how = [path]
    try:
        output_of(*how, "--env-id", "Pendulum-v1", "--total-timesteps", "1", "--no-cuda", cwd=tmp_path)
    except AssertionError as error:
        if "TransformObservation" not in str(error):
            row("CleanRL", its_version, ran)
            pytest.skip(f"the file fails on Pendulum-v1 too: {error}")
        how, ran = ["-c", WITH_DEFAULT, path], f"{ran}, given TransformObservation(observation_space=None)"
    row("CleanRL", its_version, ran, 4096)
    assert "SPS" in output_of(*how, "--env-id", ESTIMATED, *options, cwd=tmp_path)


def test_torchrl(row):
    pytest.importorskip("torchrl")
    from torchrl.collectors import Collector
    from torchrl.envs import GymEnv, check_env_specs

    row("TorchRL", version("torchrl"), "GymEnv, auto_register_info_dict, Collector", ACTIONS)
    env = GymEnv(ESTIMATED).auto_register_info_dict()
    check_env_specs(env)
    gathered = 0
    for batch in Collector(env, frames_per_batch=500, total_frames=ACTIONS):
        gathered += batch.numel()
        shown, x_hat = batch["next", "observation"].numpy(), batch["next", "x_hat"].numpy()
        np.testing.assert_allclose(shown, x_hat, atol=1e-5)
    assert gathered == ACTIONS


def test_tianshou(row):
    pytest.importorskip("tianshou")
    from tianshou.highlevel.config import OnPolicyTrainingConfig
    from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType
    from tianshou.highlevel.experiment import ExperimentConfig, PPOExperimentBuilder

    row("Tianshou", version("tianshou"), "PPOExperimentBuilder", 2048)
    training = OnPolicyTrainingConfig(
        max_epochs=1,
        epoch_num_steps=2048,
        num_training_envs=2,
        num_test_envs=1,
        test_step_num_episodes=1,
        collection_step_num_env_steps=1024,
        buffer_size=1024,
    )
    factory = EnvFactoryRegistered(task=ESTIMATED, venv_type=VectorEnvType.DUMMY)
    config = ExperimentConfig(persistence_enabled=False, watch=False)
    result = PPOExperimentBuilder(factory, config, training).build().run()
    assert result.trainer_result.train_step == 2048


def test_minari(row, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    minari = pytest.importorskip("minari")
    row("Minari", version("minari"), "DataCollector(record_infos=True), iterate_episodes, recover_environment", ACTIONS)
    env = minari.DataCollector(gym.make(ESTIMATED), record_infos=True)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(ACTIONS):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    about = {"author": "tests", "author_email": "tests@example.org", "code_permalink": "", "description": "random"}
    made = env.create_dataset("kkl/van_der_pol/random-v0", algorithm_name="random", **about)
    assert made.total_steps == ACTIONS
    episode = next(made.iterate_episodes())
    np.testing.assert_allclose(episode.observations, episode.infos["x_hat"], atol=1e-5)
    assert {"y", "x", "u", "sample", "escaped"} < episode.infos.keys()
    assert made.recover_environment().spec.id == "VanDerPolEstimated-v0"


def test_record_video(row, tmp_path):
    pytest.importorskip("moviepy")
    row("RecordVideo", version("gymnasium"), "200 frames of the portrait, with moviepy", 200)
    env = KKLObservation(gym.make("KKLLorenz-v0", render_mode="rgb_array", max_episode_steps=199))
    env = gym.wrappers.RecordVideo(env, str(tmp_path), disable_logger=True)
    env.reset(seed=0)
    while not any(env.step([0.0])[2:4]):
        pass
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 10_000
    from moviepy import VideoFileClip

    with VideoFileClip(str(video)) as clip:
        assert clip.fps == env.metadata["render_fps"] == 100
        assert clip.n_frames == 200
