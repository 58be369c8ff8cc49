"""An agent from stable-baselines3 that acts on the estimate x_hat instead of the full state."""

import gymnasium as gym
import numpy as np
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import kkl_gym


def make_env(env_id: str) -> gym.Env:
    """The environment with its observer inside, an action every 0.05 s, scaled observations, 20 s long."""
    env = kkl_gym.KKLObservation(gym.make(env_id, measurement_noise=0.2))
    env = kkl_gym.ActionRepeat(env, 5)
    scale = np.array(env.unwrapped.system.scale, np.float32)
    space = gym.spaces.Box(env.observation_space.low / scale, env.observation_space.high / scale)
    env = gym.wrappers.TransformObservation(env, lambda obs: obs / scale, space)
    return gym.wrappers.TimeLimit(env, 400)


def main(env_id: str = "KKLVanDerPol-v0", steps: int = 4096, seed: int = 0) -> float:
    """Train PPO for a while and evaluate it; returns its mean episode reward.

    Args:
        env_id: one of the package's environments.
        steps: environment steps to learn from; learning well takes hundreds of thousands.
        seed: of everything random.
    """
    envs = make_vec_env(lambda: make_env(env_id), n_envs=4, seed=seed)
    agent = PPO("MlpPolicy", envs, n_steps=256, batch_size=256, gamma=0.99, seed=seed, device="cpu")
    agent.learn(steps)
    envs.seed(seed + 1000)  # episodes that training has not seen
    reward, spread = evaluate_policy(agent, envs, n_eval_episodes=4)
    print(f"mean episode reward {reward:.1f} ± {spread:.1f} of at most {400 * 5}")
    envs.close()
    return float(reward)


if __name__ == "__main__":
    tyro.cli(main)
