"""Data where the agent goes: an observer from few random steps, refitted while PPO learns to balance CartPole-v1.

Positions are measured, velocities hidden. The same agent is trained with and without the refits.
"""

import tempfile
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import training
from kkl_gym import KKLObservation
from observers import Artifact, KKLObserver

ENV_ID, MEASURED, HIDDEN = "CartPole-v1", [0, 2], [1, 3]
AFTER = 20  # steps, of which errors are left out


def wrapped(path: Path) -> gym.Env:
    """The environment with an observer."""
    return KKLObservation(gym.make(ENV_ID), path)


def own_episodes(agent: PPO, env: gym.Env, episodes: int, seed: int) -> list[tuple[np.ndarray, ...]]:
    """Outputs, inputs and hidden signals of an agent's episodes, as info says them."""
    played = []
    for episode in range(episodes):
        obs, info = env.reset(seed=seed + episode)
        y, u, x, over = [info["y"]], [], [info["x"]], False
        while not over:
            obs, _, terminated, truncated, info = env.step(agent.predict(obs, deterministic=True)[0])
            over = terminated or truncated
            y, u, x = [*y, info["y"]], [*u, info["u"]], [*x, info["x"]]
        played.append((np.array(y), np.array(u), np.array(x)))
    return played


def errors(artifact: Artifact, episodes: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """Root mean square errors over standard deviations, of each hidden signal."""
    observer = KKLObserver(artifact)
    apart = np.concatenate([(observer.estimate(y, u) - x)[AFTER:] for y, u, x in episodes])
    return np.sqrt(np.mean(apart**2, 0)) / np.concatenate([x[AFTER:] for *_, x in episodes]).std(0)


def main(
    random_steps: int = 5_000,
    members: int = 3,
    timesteps: int = 30_000,
    every: int = 5_000,
    batches: int = 1_000,
    seed: int = 0,
) -> dict[str, float]:
    """Train the agents; returns the larger error of the two hidden signals on the agent's own episodes.

    Args:
        random_steps: from which the first observer is learned.
        members: networks of the first observer, which are averaged.
        timesteps: of the agents.
        every: steps from refit to refit.
        batches: of each fit.
        seed: of everything random.
    """
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        first = training.learn(
            ENV_ID,
            measured=MEASURED,
            hidden=HIDDEN,
            steps=random_steps,
            inverse_steps=batches,
            members=members,
            seed=seed,
            out=folder,
        )
        path = Path(folder) / f"{ENV_ID}.safetensors"
        for label, refits in (
            ("without refits", None),
            ("with refits", training.KKLTrainingCallback(every, inverse_steps=batches, verbose=1)),
        ):
            envs = make_vec_env(partial(wrapped, path), 4, seed=seed)
            agent = PPO("MlpPolicy", envs, n_steps=256, batch_size=256, learning_rate=1e-3, seed=seed, device="cpu")
            agent.learn(timesteps, refits)
            env = wrapped(path)
            if refits is not None:
                env.replace_observer(refits.artifact)
            episodes = own_episodes(agent, env, 20, seed + 10_000)
            print(f"{label}: {np.mean([len(u) for _, u, _ in episodes]):.0f} steps an episode")
            for name, artifact in (("first", first), ("newest", env.observer.artifact)):
                error = errors(artifact, episodes)
                print(f"  errors of the {name} observer: {', '.join(f'{value:.2%}' for value in error)}")
            found[label] = float(error.max())
    return found


if __name__ == "__main__":
    tyro.cli(main)
