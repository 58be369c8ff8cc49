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
from training.evaluation.metrics import smape


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
            for env_id in progress.track(kkl_gym.ENV_IDS.values(), description="running"):
                run = episode(env_id, self.noise, self.duration, self.seed)
                full, late = (smape(run.x[:, None], run.x_hat[:, None], skip)[0] for skip in (0, len(run.x) // 5))
                table.add_row(env_id, f"{full:.2f}", f"{late:.2f}", f"{1e6 * run.seconds / (len(run.x) - 1):.0f}")
                runs.append(run)
        console.print(table)
        path = self.out / "estimates.png"
        draw(path, runs, self.noise)
        console.print(f"wrote {path}: true states in black, estimates in magenta, the measured output in grey")
        return path


@dataclass(frozen=True)
class Run:
    """One episode: states and estimates (steps + 1, nx), outputs (steps + 1, ny), and the seconds its steps took."""

    env: kkl_gym.KKLObservation
    x: np.ndarray
    x_hat: np.ndarray
    y: np.ndarray
    seconds: float


def episode(env_id: str, noise: float, duration: float, seed: int) -> Run:
    """Run one undriven episode with the shipped observer."""
    steps = round(duration / 0.01)
    env = kkl_gym.KKLObservation(gym.make(env_id, measurement_noise=noise, max_episode_steps=steps))
    _, info = env.reset(seed=seed)
    infos = [info]
    action = np.zeros(env.action_space.shape or (), np.float32)
    started = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, _, info = env.step(action)
        infos.append(info)
        if terminated:
            break
    seconds = time.perf_counter() - started
    x, x_hat, y = (np.array([info[key] for info in infos]) for key in ("x", "x_hat", "y"))
    return Run(env, x, x_hat, y, seconds)


def draw(path: Path, runs: list[Run], noise: float) -> None:
    """True and estimated states over time, a column for each run (like the paper's fig. 2)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = max(run.x.shape[1] for run in runs)
    size = (4.5 * len(runs), 2.2 * rows)
    figure, axes = plt.subplots(rows, len(runs), figsize=size, squeeze=False, layout="constrained")
    for column, run in enumerate(runs):
        system, C = run.env.unwrapped.system, run.env.observer.artifact.C  # type: ignore[attr-defined]
        t = np.arange(len(run.x)) * run.env.unwrapped.dt  # type: ignore[attr-defined]
        for i in range(rows):
            ax: Any = axes[i, column]
            if i >= system.nx:
                ax.set_visible(False)
                continue
            if C is not None and np.array_equal(C[0], np.eye(system.nx)[i]):
                ax.plot(t, run.y[:, 0], color="0.75", lw=0.6, label="measured")
            ax.plot(t, run.x[:, i], "k", lw=1.2, label="true")
            ax.plot(t, run.x_hat[:, i], "m--", lw=1.0, label="estimated")
            low, high = run.x[:, i].min(), run.x[:, i].max()
            ax.set_ylim(low - 0.25 * (high - low), high + 0.25 * (high - low))  # the first estimates may be far off
            ax.set_ylabel(system.state_names[i])
        axes[0, column].set_title(system.name.replace("_", " "))
        axes[system.nx - 1, column].set_xlabel("t in s")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower left", ncols=len(labels))
    figure.suptitle(f"Hidden states estimated from one noisy output (standard deviation {noise:g} on every sample)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
