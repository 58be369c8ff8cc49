"""The four environments with their shipped observers, in one table and one figure."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import kkl_gym
from training.metrics import smape


@dataclass(frozen=True)
class Demo:
    """Run all four environments with their shipped observers; print a table and draw true and estimated states."""

    out: Path = Path("demo")
    """Folder for the figure."""
    noise: float = 0.5
    """Standard deviation of the measurement noise."""
    duration: float = 50.0
    """Length of each run in seconds."""
    seed: int = 0
    """Of starts and noise."""

    def run(self, console: Console) -> Path:
        """Run; returns the figure's path."""
        table = Table(
            "environment",
            "SMAPE in %",
            "after 20 %",
            "µs per step",
            title=f"one run each, measurement noise {self.noise:g}",
        )
        runs = []
        with Progress(console=console, transient=True) as progress:
            for name, env_id in progress.track(kkl_gym.ENV_IDS.items(), description="running"):
                x, x_hat, seconds = episode(env_id, self.noise, self.duration, self.seed)
                full, late = (smape(x[:, None], x_hat[:, None], skip)[0] for skip in (0, len(x) // 5))
                table.add_row(env_id, f"{full:.2f}", f"{late:.2f}", f"{1e6 * seconds / (len(x) - 1):.0f}")
                runs.append((name, x, x_hat))
        console.print(table)
        path = self.out / "estimates.png"
        draw(path, runs, dt=0.01, noise=self.noise)
        console.print(f"wrote {path}: true states in black, estimates in magenta")
        return path


def episode(env_id: str, noise: float, duration: float, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """States and estimates (steps + 1, nx) of one undriven episode, and the seconds that its steps took."""
    steps = round(duration / 0.01)
    env = kkl_gym.KKLObservation(gym.make(env_id, measurement_noise=noise, max_episode_steps=steps))
    _, info = env.reset(seed=seed)
    action = np.zeros(env.action_space.shape or (), np.float32)
    x, x_hat = [info["x"]], [info["x_hat"]]
    started = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, info = env.step(action)
        x.append(info["x"])
        x_hat.append(info["x_hat"])
        if terminated or truncated:
            break
    return np.array(x), np.array(x_hat), time.perf_counter() - started


def draw(path: Path, runs: list[tuple[str, np.ndarray, np.ndarray]], dt: float, noise: float) -> None:
    """True and estimated states over time, a column for each run (like the paper's fig. 2)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = max(x.shape[1] for _, x, _ in runs)
    figure, axes = plt.subplots(
        rows, len(runs), figsize=(4.5 * len(runs), 2.2 * rows), squeeze=False, layout="constrained"
    )
    for column, (name, x, x_hat) in enumerate(runs):
        t = np.arange(len(x)) * dt
        for i in range(rows):
            ax: Any = axes[i, column]
            if i >= x.shape[1]:
                ax.set_visible(False)
                continue
            ax.plot(t, x[:, i], "k", lw=1.2, label="true")
            ax.plot(t, x_hat[:, i], "m--", lw=1.0, label="estimated")
            low, high = x[:, i].min(), x[:, i].max()
            ax.set_ylim(low - 0.25 * (high - low), high + 0.25 * (high - low))  # the first estimates may be far off
            ax.set_ylabel(kkl_gym.SYSTEMS[name].state_names[i])
        axes[0, column].set_title(name.replace("_", " "))
        axes[x.shape[1] - 1, column].set_xlabel("t in s")
    axes[0, 0].legend(loc="upper right")
    figure.suptitle(f"State estimates from the noisy output alone, measurement noise {noise:g} per sample")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
