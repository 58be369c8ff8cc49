"""Watch a learned observer find the hidden state of the Lorenz system from one noisy output."""

import gymnasium as gym
import numpy as np
import tyro

import kkl_gym


def main(seconds: float = 10.0, seed: int = 0) -> float:
    """Print state and estimate once a second, and return the relative error at the end.

    Args:
        seconds: length of the run.
        seed: seed of start and noise.
    """
    env = kkl_gym.KKLObservation(gym.make("KKLLorenz-v0", measurement_noise=0.5))
    x_hat, info = env.reset(seed=seed)
    action = np.zeros(1, np.float32)  # no input
    for k in range(round(seconds / 0.01)):
        if k % 100 == 0:
            print(f"t = {k // 100:2d} s   x = {info['x'].round(2)}   x_hat = {x_hat.round(2)}")
        x_hat, _, _, _, info = env.step(action)
    error = float(np.linalg.norm(info["x_hat"] - info["x"]) / np.linalg.norm(info["x"]))
    print(f"relative error after {seconds:g} s: {100 * error:.1f} %")
    return error


if __name__ == "__main__":
    tyro.cli(main)
