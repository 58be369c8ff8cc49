"""Learn an observer on the states that an agent visits: PPO balances CartPole-v1 on estimates.

Positions are measured. Velocities are hidden, but a simulator shows them in training. The example compares three ways
to train observer and agent in equally many steps. In the first, the observer is learned from random steps. In the
second, it is also refitted while the agent learns. In the third, the agent first learns on the true velocities, and the
observer is learned from the agent's steps.
"""

import tempfile
from collections.abc import Callable
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
ORDER = MEASURED + HIDDEN  # the order of the signals in KKLObservation's observations
AFTER = 20  # number of steps at the start of each episode whose errors do not count


def wrapped(path: Path) -> gym.Env:
    """Make the environment with an observer around it."""
    return KKLObservation(gym.make(ENV_ID), path)


def with_hidden() -> gym.Env:
    """Make the environment with the true velocities in place of estimates."""
    env = gym.make(ENV_ID)
    space = gym.spaces.Box(env.observation_space.low[ORDER], env.observation_space.high[ORDER])
    return gym.wrappers.TransformObservation(env, lambda obs: obs[ORDER], space)


def beginner(make: Callable[[], gym.Env], seed: int) -> PPO:
    """Make an untrained agent."""
    envs = make_vec_env(make, 4, seed=seed)
    return PPO("MlpPolicy", envs, n_steps=256, batch_size=256, learning_rate=1e-3, seed=seed, device="cpu")


def own_episodes(agent: PPO, env: gym.Env, episodes: int, seed: int) -> list[tuple[np.ndarray, ...]]:
    """Play episodes with an agent; returns their outputs, inputs and hidden signals, from info."""
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
    """Return each hidden signal's root mean square error, divided by the signal's standard deviation."""
    observer = KKLObserver(artifact)
    apart = np.concatenate([(observer.estimate(y, u) - x)[AFTER:] for y, u, x in episodes])
    return np.sqrt(np.mean(apart**2, 0)) / np.concatenate([x[AFTER:] for *_, x in episodes]).std(0)


def main(
    observer_steps: int = 5_000,
    members: int = 3,
    timesteps: int = 30_000,
    every: int = 5_000,
    batches: int = 1_000,
    seed: int = 0,
) -> dict[str, float]:
    """Train the agents; returns, for each way of training, the larger of the hidden signals' two relative errors.

    Args:
        observer_steps: steps from which an observer is first learned: random ones, or in the third way an agent's.
        members: number of networks of this first observer; their outputs are averaged.
        timesteps: further steps, in which the agents learn.
        every: steps between refits; also the number of last steps, in which the third agent learns on estimates.
        batches: training batches of each fit.
        seed: seed of all random numbers.
    """
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        learn = partial(
            training.learn,
            ENV_ID,
            measured=MEASURED,
            hidden=HIDDEN,
            steps=observer_steps,
            inverse_steps=batches,
            members=members,
            seed=seed,
        )
        first, path = learn(out=f"{folder}/random"), Path(folder, "random", f"{ENV_ID}.safetensors")

        fixed = beginner(partial(wrapped, path), seed).learn(timesteps)
        found["from random steps"] = report("from random steps", fixed, {"": first}, path, seed)

        refits = training.KKLTrainingCallback(every, inverse_steps=batches, verbose=1)
        refitted = beginner(partial(wrapped, path), seed).learn(timesteps, refits)
        observers = {"first ": first, "newest ": refits.artifact}
        found["refitted"] = report("refitted", refitted, observers, path, seed)

        agent = beginner(with_hidden, seed).learn(timesteps - every)
        path = Path(folder, "agent", f"{ENV_ID}.safetensors")
        after = learn(policy=lambda obs: agent.predict(obs[ORDER])[0], out=path.parent)
        agent.set_env(make_vec_env(partial(wrapped, path), 4, seed=seed))
        agent.learn(every, reset_num_timesteps=False)
        found["on the truth first"] = report("on the truth first", agent, {"": after}, path, seed)
    return found


def report(label: str, agent: PPO, observers: dict[str, Artifact], path: Path, seed: int) -> float:
    """Print how long an agent balances on the last observer's estimates, and the observers' errors."""
    env = wrapped(path)
    env.replace_observer([*observers.values()][-1])
    episodes = own_episodes(agent, env, 20, seed + 10_000)
    print(f"{label}: {np.mean([len(u) for _, u, _ in episodes]):.0f} steps an episode")
    for name, artifact in observers.items():
        error = errors(artifact, episodes)
        print(f"  errors of the {name}observer: {', '.join(f'{value:.2%}' for value in error)}")
    return float(error.max())


if __name__ == "__main__":
    tyro.cli(main)
