"""KKLMemory around a Gymnasium environment: SAC swings up a pendulum whose rate is not measured."""

import gymnasium as gym
import numpy as np
import tyro
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from kkl_gym import KKLMemory


class Positions(gym.ObservationWrapper):
    """Shows cosine and sine of the pendulum's angle, with noise, and hides its rate."""

    def __init__(self, env: gym.Env, noise: float) -> None:
        super().__init__(env)
        self.noise = noise
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Return the measured signals."""
        return (observation[:2] + self.noise * self.np_random.normal(size=2)).astype(np.float32)


def main(steps: int = 10_000, noise: float = 0.0, episodes: int = 20, seed: int = 0) -> dict[str, float]:
    """Train SAC with and without KKLMemory, and return the mean return of each agent's evaluation episodes.

    Args:
        steps: environment steps of each agent's training, which takes half a minute by default.
        noise: standard deviation of the noise added to each measurement.
        episodes: number of evaluation episodes, with other starts than in training.
        seed: seed of all random numbers.
    """
    wrappers = {
        "positions alone": lambda env: Positions(env, noise),
        "positions and memory": lambda env: KKLMemory(Positions(env, noise)),
    }
    returns = {}
    for name, wrapper in wrappers.items():
        envs = make_vec_env("Pendulum-v1", n_envs=4, seed=seed, wrapper_class=wrapper)
        networks = {"net_arch": [64, 64]}
        agent = SAC(
            "MlpPolicy", envs, learning_rate=2e-3, gradient_steps=2, policy_kwargs=networks, seed=seed, device="cpu"
        )
        agent.learn(steps)
        unseen = make_vec_env("Pendulum-v1", n_envs=4, seed=seed + 1000, wrapper_class=wrapper)
        returns[name], spread = evaluate_policy(agent, unseen, n_eval_episodes=episodes)
        print(f"{name}: mean return {returns[name]:.0f} ± {spread:.0f}", flush=True)
    return returns


if __name__ == "__main__":
    tyro.cli(main)
