"""``kkl-gym demo``: the four environments with their shipped observers, in one table and one figure."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import kkl_gym
from kkl_gym.simulate import check_duration
from observers import load
from observers.storage import replacing
from training.evaluation.metrics import smape
from training.progress import progress_bars

DT = 0.01  # s, of the environments


@dataclass(frozen=True)
class Demo:
    """Run all four environments with their shipped observers; print a table and draw true and estimated states.

    The default observer runs inside the environment. SPINN, the paper's, is given the same outputs afterwards.
    """

    out: Path = Path("runs/demo")
    """Folder for the figure."""
    measurement_noise: Annotated[float, tyro.conf.arg(aliases=["--noise"])] = 0.5
    """Standard deviation of the noise on each sample of y."""
    duration: float = 50.0
    """Length of each episode in seconds."""
    seed: int = 0
    """Seed of the starts and the noise."""

    def run(self, console: Console) -> Path:
        """Run.

        Parameters
        ----------
        console : Console
            Where the table is printed.

        Returns
        -------
        Path
            The figure.
        """
        check_duration(self.duration, DT)
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        table = Table(
            "environment",
            "default",
            "late",
            "SPINN",
            "late",
            "µs a step",
            title=f"SMAPE in %, all steps and late (after 20 %), measurement noise {self.measurement_noise:g}",
        )
        episodes = []
        with progress_bars(console) as progress:
            for env_id in progress.track(kkl_gym.ENV_IDS.values(), description="running"):
                episode = play(env_id, self.measurement_noise, duration=self.duration, seed=self.seed)
                steps = len(episode.x) - 1
                errors = [
                    smape(episode.x[:, None], x_hat[:, None], skip)[0]
                    for x_hat in (episode.x_hat, episode.spinn)
                    for skip in (0, (steps + 1) // 5)
                ]
                table.add_row(env_id, *(f"{error:.2f}" for error in errors), f"{1e6 * episode.seconds / steps:.0f}")
                episodes.append(episode)
        console.print(table)
        path = self.out / "estimates.png"
        draw(path, episodes, self.measurement_noise)
        console.print(f"wrote {path}: true states in black, estimates in magenta and blue, the measured output in grey")
        return path


@dataclass(frozen=True)
class Episode:
    """One episode of an environment with an observer.

    Parameters
    ----------
    env : KKLObservation
        Where it was played.
    x, x_hat : ndarray, shape (steps + 1, nx)
        States and their estimates.
    spinn : ndarray, shape (steps + 1, nx)
        What the paper's observer makes of the same outputs.
    y : ndarray, shape (steps + 1, ny)
        Noisy outputs.
    seconds : float
        Time that the steps took.
    """

    env: kkl_gym.KKLObservation
    x: np.ndarray
    x_hat: np.ndarray
    spinn: np.ndarray
    y: np.ndarray
    seconds: float


def play(env_id: str, measurement_noise: float, *, duration: float, seed: int) -> Episode:
    """Play one undriven episode with the shipped observer.

    Parameters
    ----------
    env_id : str
        Of a shipped environment.
    measurement_noise : float
        Standard deviation of the noise on each sample of y.
    duration : float
        Length in seconds.
    seed : int
        Seed of start and noise.

    Returns
    -------
    Episode
        It ends early where the state leaves the system's bounds.
    """
    steps = round(duration / DT)
    env = kkl_gym.KKLObservation(gym.make(env_id, measurement_noise=measurement_noise, max_episode_steps=steps))
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
    name = env.unwrapped.system.name  # type: ignore[attr-defined]
    spinn = load(f"{name}-spinn", measurement_noise).estimate(y)
    return Episode(env, x, x_hat, spinn, y, seconds)


def draw(path: Path, episodes: Sequence[Episode], measurement_noise: float) -> None:
    """Draw true and estimated states over time, a column for each episode (like the paper's fig. 2).

    Parameters
    ----------
    path : Path
        Of the figure; its folder is made.
    episodes : sequence of Episode
        What is shown.
    measurement_noise : float
        Level that the title names.
    """
    from matplotlib.figure import Figure

    rows = max(episode.x.shape[1] for episode in episodes)
    figure = Figure(figsize=(4.5 * len(episodes), 2.2 * rows), layout="constrained")
    axes = figure.subplots(rows, len(episodes), squeeze=False)
    for column, episode in enumerate(episodes):
        system, C = episode.env.unwrapped.system, episode.env.observer.artifact.C  # type: ignore[attr-defined]
        t = np.arange(len(episode.x)) * episode.env.unwrapped.dt  # type: ignore[attr-defined]
        for i in range(rows):
            ax: Any = axes[i, column]
            if i >= system.nx:
                ax.set_visible(False)
                continue
            if C is not None and np.array_equal(C[0], np.eye(system.nx)[i]):
                ax.plot(t, episode.y[:, 0], color="0.75", lw=0.6, label="measured")
            ax.plot(t, episode.x[:, i], "k", lw=1.2, label="true")
            ax.plot(t, episode.x_hat[:, i], "m--", lw=1.0, label="default observer")
            ax.plot(t, episode.spinn[:, i], ":", color="tab:blue", lw=1.2, label="SPINN")
            low, high = episode.x[:, i].min(), episode.x[:, i].max()
            ax.set_ylim(low - 0.25 * (high - low), high + 0.25 * (high - low))  # the first estimates may be far off
            ax.set_ylabel(system.state_names[i])
        axes[0, column].set_title(system.name.replace("_", " "))
        axes[system.nx - 1, column].set_xlabel("t in s")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower left", ncols=len(labels))
    figure.suptitle(
        f"Hidden states estimated from one noisy output (standard deviation {measurement_noise:g} on every sample)"
    )
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
