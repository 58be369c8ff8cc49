"""Learn an observer for any Gymnasium environment: play rollouts, learn the hidden signals, wrap the environment.

The policies here are simple. Your own agent may act instead: ``kkl-gym record ENV_ID --policy ppo:agent.zip``.
"""

import itertools
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro

import training
from kkl_gym import KKLObservation
from observers import Artifact
from training.agents.environments import MeasurementNoise
from training.rollouts import make, roll_out
from training.sources.recorded import recorded_errors

AFTER = 20  # number of steps at the start of each rollout, in which errors do not count
GAINS = np.array([0.09, 1.01, 4.53, 0.18, 0.62, 0.68])  # gains of a linear-quadratic regulator for the double pendulum


def swing_up(obs: np.ndarray) -> np.ndarray:
    """Pump energy into Pendulum-v1, and balance it at the top."""
    cos, sin, rate = obs
    if cos > 0.9 and abs(rate) < 3:
        torque = -10 * np.arctan2(sin, cos) - 2 * rate
    else:
        torque = -2 * np.sign((rate**2 / 6 + 5 * (cos - 1)) * rate) if rate else 2.0
    return np.float32([np.clip(torque, -2, 2)])


def balance(obs: np.ndarray) -> int:
    """Balance CartPole-v1."""
    return int(obs @ [0.1, 0.25, 3.0, 0.6] > 0)


def climb(obs: np.ndarray) -> np.ndarray:
    """Push MountainCarContinuous-v0 in its direction of motion."""
    return np.float32([1.0 if obs[1] >= 0 else -1.0])


def balance_both(obs: np.ndarray) -> np.ndarray:
    """Balance InvertedDoublePendulum-v5."""
    angles = np.arctan2(obs[1:3], obs[3:5])
    return np.float32([np.clip(-GAINS @ [obs[0], *angles, *obs[5:8]], -1, 1)])


# For each environment: the measured signals, the hidden signals, and the policy that acts.
CASES: dict[str, tuple[list[int], list[int], Callable]] = {
    "Pendulum-v1": ([0, 1], [2], swing_up),
    "CartPole-v1": ([0, 2], [1, 3], balance),
    "MountainCarContinuous-v0": ([0], [1], climb),
    "InvertedDoublePendulum-v5": ([0, 1, 2, 3, 4], [5, 6, 7], balance_both),
}


def exploring(policy: Callable, env: gym.Env, seed: int) -> Callable:
    """Mix a share of random actions into a policy; the share is drawn every hundred steps: 0, 0.3 or 1."""
    rng, calls = np.random.default_rng(seed), 0
    env.action_space.seed(seed)
    share = 0.0

    def act(obs: np.ndarray) -> object:
        nonlocal calls, share
        if calls % 100 == 0:
            share = rng.choice([0.0, 0.3, 1.0], p=[0.4, 0.4, 0.2])
        calls += 1
        return env.action_space.sample() if rng.random() < share else policy(obs)

    return act


def under_noise(env_id: str, artifact: Artifact | None, noise: float, seed: int, episodes: int = 20) -> float:
    """Run the policy on an observer's estimates, or without one on noise-free signals; return the mean return."""
    measured, _, policy = CASES[env_id]
    returns, apart = list[float](), list[np.ndarray]()
    env: gym.Env = MeasurementNoise(make(env_id), measured, noise)
    if artifact is not None:
        with tempfile.TemporaryDirectory() as folder:
            artifact.save(path := Path(folder) / "observer.safetensors")
            env = KKLObservation(env, path, measurement_noise=noise)
    for episode in range(episodes):
        _, info = env.reset(seed=seed + 20_000 + episode)
        total = 0.0
        for step in itertools.count(1):
            known = info["clean"] if artifact is None else info["x_hat"]
            _, reward, terminated, truncated, info = env.step(policy(known))
            total += float(reward)
            if artifact is not None and step >= AFTER:
                apart.append(info["x_hat"] - info["clean"])
            if terminated or truncated:
                break
        returns.append(total)
    shown = "truth:" if artifact is None else "estimates:" if artifact.motion else "estimates of T_inv alone:"
    print(f"  {shown} {np.mean(returns):.1f}")
    if apart:
        print("    rms errors", ", ".join(f"{error:.3g}" for error in np.sqrt(np.mean(np.square(apart), 0))))
    return float(np.mean(returns))


def main(
    env_id: str = "Pendulum-v1",
    steps: int = 40_000,
    held_out: int = 6_000,
    batches: int = 2_000,
    members: int = 1,
    noise: float = 0.0,
    seed: int = 0,
) -> dict[str, float]:
    """Learn an environment's observer; returns its largest held-out errors and, with noise, the policy's mean returns.

    Args:
        env_id: one of Pendulum-v1, CartPole-v1, MountainCarContinuous-v0 and, with MuJoCo, InvertedDoublePendulum-v5.
        steps: steps to play for the training.
        held_out: steps of the held-out rollouts with exploration, and of those without it.
        batches: training batches of each network.
        members: number of networks, whose outputs are averaged.
        noise: standard deviation of the measurement noise. With noise the observer estimates all signals and
            tracks them. The policy is run three times: on these estimates, on those of T_inv alone, and on the truth.
        seed: seed of all random numbers.
    """
    measured, hidden, policy = CASES[env_id]
    if noise:
        hidden = sorted(measured + hidden)
    with tempfile.TemporaryDirectory() as folder:
        artifact = training.learn(
            env_id,
            measured=measured,
            hidden=hidden,
            policy=exploring(policy, make(env_id), seed),
            steps=steps,
            seed=seed,
            out=folder,
            inverse_steps=batches,
            members=members,
            measurement_noise_max=2 * noise or None,
        )
        env = KKLObservation(gym.make(env_id), Path(folder) / f"{env_id}.safetensors")
    obs, _ = env.reset(seed=seed)
    print(f"{env_id}: the agent sees {obs.size} numbers: the measurements and {len(hidden)} estimates")
    unseen = make(env_id)
    names = {"measured": list(map(str, measured)), "hidden": list(map(str, hidden))}
    found = {}
    for label, acting in (("exploring", exploring(policy, unseen, seed + 1)), ("not exploring", policy)):
        rollouts = roll_out(unseen, acting, steps=held_out, seed=seed + 10_000, **names)
        records = [record for record in rollouts.records() if len(record.t) > AFTER + 1]
        errors = recorded_errors(artifact, records, AFTER * artifact.filter.dt)
        shown = ", ".join(f"{name} {error:.2%}" for name, error in errors.items())
        print(f"held-out rollouts, {label}: rms errors in % of standard deviations, after {AFTER} steps: {shown}")
        found[label] = max(errors.values())
    if noise:
        print(f"noise {noise:g}: mean return of the policy if it acts on")
        for label, observer in (
            ("tracked", artifact),
            ("T_inv alone", replace(artifact, motion=None)),
            ("truth", None),
        ):
            found[label] = under_noise(env_id, observer, noise, seed)
    return found


if __name__ == "__main__":
    tyro.cli(main)
