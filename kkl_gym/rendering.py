"""The phase portrait that ``render_mode="rgb_array"`` shows."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from kkl_gym.system import System


class Canvas:
    """A phase portrait of a system's first and last state, with its target and its trail.

    Raises ImportError with the remedy if matplotlib (the extra ``plots``) is not installed.
    """

    def __init__(self, system: System) -> None:
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise ImportError('rendering needs matplotlib: pip install "kkl-gym[plots]"') from error
        self._axes = (0, system.nx - 1)
        figure = Figure(figsize=(4.8, 4.8), dpi=100, layout="constrained")
        self._canvas: Any = FigureCanvasAgg(figure)
        ax = figure.add_subplot()
        names = [system.state_names[i] for i in self._axes]
        (left, right), (bottom, top) = (system.X[i] for i in self._axes)
        wide, tall = 0.3 * (right - left), 0.3 * (top - bottom)  # driven or not, motions leave the training box
        ax.set(xlim=(left - wide, right + wide), ylim=(bottom - tall, top + tall), xlabel=names[0], ylabel=names[1])
        ax.set_title(system.name.replace("_", " "))
        ax.plot(*(system.target[i] for i in self._axes), "+", color="C2", markersize=12, label="target")
        (self._line,) = ax.plot([], [], color="0.4", lw=1.0)
        (self._head,) = ax.plot([], [], "o", color="C0", label="state")
        ax.legend(loc="upper right")

    def draw(self, trail: Iterable[tuple[float, ...]]) -> np.ndarray:
        """The states of ``trail`` as an RGB image, uint8, shape (height, width, 3)."""
        points = np.array(list(trail))[:, self._axes]
        self._line.set_data(*points.T)
        self._head.set_data(*points[-1:].T)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
