"""Figures and animations of closed-loop episodes of systems."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from kkl_gym import get_system
from kkl_gym.rendering import Canvas
from kkl_gym.system import System
from training.agents.play import Episodes
from training.agents.tasks import Task
from training.evaluation.levels import show_level
from training.figures import ESTIMATE, MEASURED, RIVAL, TARGET, TRUTH, drawing, save_moving, style

FRAMES = 150  # approximate number of frames in an animation
SECONDS = 10.0  # s, length of an animation
WIDTH = 4.6  # width of a column in inches


def draw(task: Task, played: Mapping[str, Episodes], path: Path) -> None:
    """Draw states, estimates, target, outputs and inputs over time, for the first episode of each agent."""
    system = _system(task)
    names = [*system.state_names, *_numbered("y", system.ny), *_numbered("u", system.nu)]
    with drawing(path, WIDTH * len(played), 1.6 * len(names)) as figure:
        axes = figure.subplots(len(names), len(played), sharex=True, sharey="row", squeeze=False)
        for (title, episodes), column in zip(played.items(), axes.T, strict=True):
            x, y, u = (episodes.signals(name)[:, 0] for name in "xyu")
            t = np.arange(len(x)) * task.repeat * task.env_kwargs["dt"]
            for i, ax in enumerate(column[: system.nx]):
                ax.axhline(system.target[i], color=TARGET, lw=1.0, label="target")
                if episodes.x_hat is not None:
                    ax.plot(t, episodes.x_hat[:, 0, i], color=ESTIMATE, lw=0.8, label="estimate")
                ax.plot(t, x[:, i], color=TRUTH, lw=1.0, label="state")
            for j, ax in enumerate(column[system.nx : -system.nu]):
                ax.plot(t, y[:, j], ".", color=MEASURED, ms=2.0, label="measured output")
            for j, ax in enumerate(column[-system.nu :]):
                ax.step(t[:-1], u[:, j], where="post", color=RIVAL, lw=0.8, label="input")
                ax.set_ylim(-1.1 * system.u_max[j], 1.1 * system.u_max[j])
            column[0].set_title(title)
            column[-1].set_xlabel("t in s")
        for i, name in enumerate(names):
            axes[i, 0].set_ylabel(name)
        named = {
            label: handle for ax in axes[:, -1] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
        }
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=min(5, 2 * len(played)))
        figure.suptitle(f"{system.name.replace('_', ' ')}, measurement noise {show_level(task.measurement_noise)}")


def _system(task: Task) -> System:
    assert task.system is not None
    return get_system(task.system)


def _numbered(symbol: str, number: int) -> list[str]:
    """Return names for a number of signals: the symbol alone for one signal, else with numbers, as in y1, y2."""
    return [symbol] if number == 1 else [f"{symbol}{i + 1}" for i in range(number)]


def animate(task: Task, played: Mapping[str, Episodes], path: Path) -> None:
    """Animate the phase portraits of several agents' first episodes, side by side."""
    system = _system(task)
    points = [p[:, 0] for one in played.values() for p in (one.signals("x"), one.x_hat) if p is not None]
    reached = np.concatenate([*points, [system.target]])
    box = tuple(zip(reached.min(0).tolist(), reached.max(0).tolist(), strict=True))
    every = max(1, round(task.steps / FRAMES))
    with style():
        canvases = [(Canvas(system, one.x_hat is not None, box, title=title), one) for title, one in played.items()]
        frames = [
            Image.fromarray(np.hstack([_frame(canvas, one, k) for canvas, one in canvases]))
            for k in range(1, task.steps + 1, every)
        ]
    save_moving(path, frames, seconds=SECONDS)


def _frame(canvas: Canvas, episodes: Episodes, k: int) -> np.ndarray:
    """Draw the frame with the samples before index k."""
    estimates = () if episodes.x_hat is None else episodes.x_hat[:k, 0]
    return canvas.draw(episodes.signals("x")[:k, 0], estimates, episodes.signals("u")[k - 1, 0])
