"""PPO or SAC from RLlib on the estimate x_hat, with two env runners; each has a batch of environments and one observer.

It needs `pip install "ray[rllib]" torch tyro` and kkl-gym without extras.
"""

from typing import Any, Literal

import gymnasium as gym
import ray
import tyro
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.tune.registry import register_env

import kkl_gym


def make_envs(config: dict[str, Any]) -> gym.vector.VectorEnv:
    """Make batched environments with their observer inside: episodes of 20 s, an action every 0.05 s.

    RLlib calls this function in each env runner; ``config`` holds only names and numbers. The env runner itself imports
    kkl_gym and reads the observer's file.
    """
    envs = gym.make_vec(
        config["env_id"],
        num_envs=config["num_envs"],
        measurement_noise=0.2,
        max_episode_steps=2000,
        autoreset_mode="Disabled",
    )
    envs = kkl_gym.KKLVectorObservation(envs, config["observer"])  # the observer sees every sample, 0.01 s apart
    return kkl_gym.VectorActionRepeat(envs, 5)  # ended episodes restart in the next step, as RLlib expects


def configuration(algorithm: Literal["ppo", "sac"]) -> AlgorithmConfig:
    """Return the settings of an algorithm."""
    if algorithm == "ppo":
        return PPOConfig().training(
            lr=1e-3, gamma=0.99, train_batch_size_per_learner=4096, minibatch_size=512, num_epochs=5
        )
    return (
        SACConfig()
        .training(
            actor_lr=1e-3,
            critic_lr=1e-3,
            alpha_lr=1e-3,
            gamma=0.98,
            train_batch_size_per_learner=256,
            training_intensity=16.0,  # ratio of samples in training batches to gathered samples
            num_steps_sampled_before_learning_starts=1000,
        )
        .reporting(min_sample_timesteps_per_iteration=1000)
    )


def main(
    algorithm: Literal["ppo", "sac"] = "ppo",
    env_id: str = "KKLVanDerPol-v0",
    observer: str = "van_der_pol",
    steps: int = 20_000,
    num_envs: int = 16,
    runners: int = 2,
    seed: int = 0,
) -> tuple[int, float]:
    """Train for a while; returns the number of actions and the mean return of the last episodes.

    Args:
        algorithm: the algorithm to train.
        env_id: one of the package's environments.
        observer: a shipped map's name, or a .safetensors file that every runner can read.
        steps: number of actions in the training, over all environments.
        num_envs: environments in each runner.
        runners: processes that gather experience.
        seed: seed of all random numbers.
    """
    register_env("estimated", make_envs)
    config = (
        configuration(algorithm)
        .environment("estimated", env_config={"env_id": env_id, "observer": observer})
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=num_envs,
            gym_env_vectorize_mode="vector_entry_point",  # one batched environment instead of num_envs single ones
            env_to_module_connector=lambda *_args, **_options: MeanStdFilter(),
        )
        .debugging(seed=seed)
    )
    taken, reward = 0, float("nan")
    agent = config.build_algo()
    try:
        while taken < steps:
            found = agent.train()["env_runners"]
            taken, reward = int(found["num_env_steps_sampled_lifetime"]), found.get("episode_return_mean", reward)
            print(f"{taken} actions: mean episode reward {reward:.1f} of at most {400 * 5}")
    finally:
        agent.stop()
        ray.shutdown()
    return taken, float(reward)


if __name__ == "__main__":
    tyro.cli(main)
