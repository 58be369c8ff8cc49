"""Pictures of closed-loop episodes."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from kkl_gym import get_system
from kkl_gym.rendering import Canvas
from training.agents.play import Episodes
from training.agents.tasks import ControlTask
from training.evaluation.levels import show_level
from training.figures import ESTIMATE, MEASURED, RIVAL, TARGET, TRUTH, drawing, save_moving, style

SHOWN = 5  # episodes in a figure
FRAMES = 150  # of an animation, at most
SECONDS = 10.0  # that it lasts


def draw(task: ControlTask, episodes: Episodes, path: Path) -> None:
    """Draw states, estimates, target, outputs and inputs over time."""
    shown = [("", episodes.row(i)) for i in range(min(SHOWN, episodes.x.shape[1]))]
    _draw(path, task, shown, width=2.6)


def draw_agents(task: ControlTask, played: Mapping[str, Episodes], path: Path) -> None:
    """Draw the first episode of several agents side by side, as :func:`draw` draws several of one."""
    _draw(path, task, [(name, episodes.row(0)) for name, episodes in played.items()], width=4.6)


def _draw(path: Path, task: ControlTask, columns: Sequence[tuple[str, Episodes]], *, width: float) -> None:
    """Draw the one episode of each column, below its title."""
    system = get_system(task.system)
    names = [*system.state_names, *_numbered("y", system.ny), *_numbered("u", system.nu)]
    with drawing(path, width * len(columns), 1.6 * len(names)) as figure:
        axes = figure.subplots(len(names), len(columns), sharex=True, sharey="row", squeeze=False)
        for (title, episode), column in zip(columns, axes.T, strict=True):
            t = np.arange(len(episode.x)) * task.period
            for i, ax in enumerate(column[: system.nx]):
                ax.axhline(system.target[i], color=TARGET, lw=1.0, label="target")
                if episode.x_hat is not None:
                    ax.plot(t, episode.x_hat[:, 0, i], color=ESTIMATE, lw=0.8, label="estimate")
                ax.plot(t, episode.x[:, 0, i], color=TRUTH, lw=1.0, label="state")
            for j, ax in enumerate(column[system.nx : -system.nu]):
                ax.plot(t, episode.y[:, 0, j], ".", color=MEASURED, ms=2.0, label="measured output")
            for j, ax in enumerate(column[-system.nu :]):
                ax.step(t[:-1], episode.u[:, 0, j], where="post", color=RIVAL, lw=0.8, label="input")
                ax.set_ylim(-1.1 * system.u_max[j], 1.1 * system.u_max[j])
            column[0].set_title(title)
            column[-1].set_xlabel("t in s")
        for i, name in enumerate(names):
            axes[i, 0].set_ylabel(name)
        named = {
            label: handle for ax in axes[:, -1] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
        }
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=min(5, 2 * len(columns)))
        figure.suptitle(f"{system.name.replace('_', ' ')}, measurement noise {show_level(task.measurement_noise)}")


def _numbered(symbol: str, number: int) -> list[str]:
    """Names of signals: y where there is one, and y1, y2 and so on."""
    return [symbol] if number == 1 else [f"{symbol}{i + 1}" for i in range(number)]


def animate(task: ControlTask, played: Mapping[str, Episodes], path: Path) -> None:
    """Draw the phase portrait of an agent's first episode, moving, and those of several side by side."""
    system = get_system(task.system)
    shown = {title: episodes.row(0) for title, episodes in played.items()}
    points = [found[:, 0] for one in shown.values() for found in (one.x, one.x_hat) if found is not None]
    reached = np.concatenate([*points, [system.target]])
    box = tuple(zip(reached.min(0).tolist(), reached.max(0).tolist(), strict=True))
    every = max(1, round(task.steps / FRAMES))
    with style():
        canvases = [(Canvas(system, one.x_hat is not None, box, title=title), one) for title, one in shown.items()]
        frames = [
            Image.fromarray(np.hstack([_frame(canvas, one, k) for canvas, one in canvases]))
            for k in range(1, task.steps + 1, every)
        ]
    save_moving(path, frames, seconds=SECONDS)


def _frame(canvas: Canvas, episode: Episodes, k: int) -> np.ndarray:
    """What has happened in one episode before its instant k."""
    estimates = () if episode.x_hat is None else episode.x_hat[:k, 0]
    return canvas.draw(episode.x[:k, 0], estimates, episode.u[k - 1, 0])
