"""An agent from stable-baselines3 that acts on the estimate x_hat instead of the full state."""

import gymnasium as gym
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import kkl_gym
from training.agents import SB3VecEnv


def make_envs(env_id: str, num_envs: int) -> SB3VecEnv:
    """Make batched environments with their observer inside: episodes of 20 s, an action every 0.05 s."""
    envs = gym.make_vec(
        env_id, num_envs=num_envs, measurement_noise=0.2, max_episode_steps=2000, autoreset_mode="Disabled"
    )
    envs = kkl_gym.KKLVectorObservation(envs)  # the observer sees every sample, 0.01 s apart
    return SB3VecEnv(kkl_gym.VectorActionRepeat(envs, 5, autoreset_mode="SameStep"))


def main(env_id: str = "KKLVanDerPol-v0", steps: int = 20_480, num_envs: int = 16, seed: int = 0) -> float:
    """Train PPO for a while and evaluate it; returns its mean episode reward.

    Args:
        env_id: one of the package's environments.
        steps: environment steps of the training; a good agent takes a million (a minute or two).
        num_envs: environments in the batch.
        seed: seed of all random numbers.
    """
    envs = VecNormalize(VecMonitor(make_envs(env_id, num_envs)), norm_reward=False)
    envs.seed(seed)
    agent = PPO("MlpPolicy", envs, n_steps=128, batch_size=256, gamma=0.99, seed=seed, device="cpu")
    agent.learn(steps)
    envs.training = False  # keeps the learned scaling
    envs.seed(seed + 1000)  # unseen episodes
    reward, spread = evaluate_policy(agent, envs, n_eval_episodes=num_envs)
    print(f"mean episode reward {reward:.1f} ± {spread:.1f} of at most {400 * 5}")
    envs.close()
    return float(reward)


if __name__ == "__main__":
    tyro.cli(main)
