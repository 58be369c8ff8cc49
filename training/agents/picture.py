"""Pictures of closed-loop episodes."""

from pathlib import Path

import numpy as np
from PIL import Image

from kkl_gym import get_system
from kkl_gym.rendering import Canvas
from training.agents.play import Episodes
from training.evaluation.levels import show_level
from training.figures import ESTIMATE, RIVAL, TARGET, TRUTH, drawing, save_moving, style
from training.systems import ControlTask

SHOWN = 5  # episodes in a figure
FRAMES = 150  # of an animation, at most
SECONDS = 10.0  # that it lasts


def draw(task: ControlTask, episodes: Episodes, path: Path) -> None:
    """Draw states, estimates, target and input over time.

    Parameters
    ----------
    task : ControlTask
        What was played.
    episodes : Episodes
        The first few are shown.
    path : Path
        Of the figure.
    """
    system = get_system(task.system)
    shown = min(SHOWN, episodes.x.shape[1])
    t = np.arange(len(episodes.x)) * task.period
    with drawing(path, 2.6 * shown, 1.6 * (system.nx + system.nu)) as figure:
        axes = figure.subplots(system.nx + system.nu, shown, sharex=True, sharey="row", squeeze=False)
        for column in range(shown):
            for i in range(system.nx):
                ax = axes[i, column]
                ax.axhline(system.target[i], color=TARGET, lw=1.0, label="target")
                if episodes.x_hat is not None:
                    ax.plot(t, episodes.x_hat[:, column, i], color=ESTIMATE, lw=0.8, label="estimate")
                ax.plot(t, episodes.x[:, column, i], color=TRUTH, lw=1.0, label="state")
            for j in range(system.nu):
                ax = axes[system.nx + j, column]
                ax.step(t[:-1], episodes.u[:, column, j], where="post", color=RIVAL, lw=0.8)
                ax.set_ylim(-1.1 * system.u_max[j], 1.1 * system.u_max[j])
            axes[-1, column].set_xlabel("t in s")
        for i, name in enumerate((*system.state_names, *(f"u{j + 1}" for j in range(system.nu)))):
            axes[i, 0].set_ylabel(name)
        axes[0, 0].legend(loc="upper right")
        figure.suptitle(f"{system.name.replace('_', ' ')}, measurement noise {show_level(task.measurement_noise)}")


def animate(task: ControlTask, episodes: Episodes, path: Path) -> None:
    """Draw the phase portrait of the first episode, moving.

    Parameters
    ----------
    task : ControlTask
        What was played.
    episodes : Episodes
        The first is shown.
    path : Path
        Of the GIF.
    """
    system = get_system(task.system)
    x = episodes.x[:, 0]
    x_hat = None if episodes.x_hat is None else episodes.x_hat[:, 0]
    shown = np.concatenate([x, [system.target], *([] if x_hat is None else [x_hat])])
    box = tuple(zip(shown.min(0).tolist(), shown.max(0).tolist(), strict=True))
    every = max(1, round(len(x) / FRAMES))
    with style():
        canvas = Canvas(system, x_hat is not None, box)
        frames = [
            Image.fromarray(canvas.draw(x[:k], () if x_hat is None else x_hat[:k], episodes.u[k - 1, 0]))
            for k in range(1, len(x), every)
        ]
    save_moving(path, frames, seconds=SECONDS)
