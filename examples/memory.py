"""A memory around an environment of others: SAC swings a pendulum up whose rate nobody measures."""

import gymnasium as gym
import tyro
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from kkl_gym import KKLMemory

POSITIONS = [0, 1]  # of Pendulum-v1's observation, cosine and sine of the angle; [2] is the rate


def positions_alone(env: gym.Env) -> gym.Env:
    """The pendulum without its rate, and without a memory."""
    space = gym.spaces.Box(-1.0, 1.0, (2,))
    return gym.wrappers.TransformObservation(env, lambda obs: obs[POSITIONS], space)


def main(steps: int = 6_000, episodes: int = 20, seed: int = 0) -> dict[str, float]:
    """Train SAC with and without a memory; returns the mean returns of the evaluation episodes.

    Args:
        steps: environment steps that each agent learns from; 20,000 are what others take.
        episodes: evaluation episodes, which training has not seen.
        seed: of everything random.
    """
    wrappers = {
        "positions alone": {"wrapper_class": positions_alone},
        "positions and memory": {"wrapper_class": KKLMemory, "wrapper_kwargs": {"measured": POSITIONS}},
    }
    returns = {}
    for name, wrapper in wrappers.items():
        envs = make_vec_env("Pendulum-v1", n_envs=4, seed=seed, **wrapper)
        networks = {"net_arch": [64, 64]}
        agent = SAC(
            "MlpPolicy", envs, learning_rate=2e-3, gradient_steps=2, policy_kwargs=networks, seed=seed, device="cpu"
        )
        agent.learn(steps)
        unseen = make_vec_env("Pendulum-v1", n_envs=4, seed=seed + 1000, **wrapper)
        returns[name], spread = evaluate_policy(agent, unseen, n_eval_episodes=episodes)
        print(f"{name}: mean return {returns[name]:.0f} ± {spread:.0f}", flush=True)
    return returns


if __name__ == "__main__":
    tyro.cli(main)
