"""The phase portrait that ``render_mode="rgb_array"`` shows."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from kkl_gym.system import Box, System

STATE, ESTIMATE, TARGET = "0.2", "C3", "C2"


class Canvas:
    """A phase portrait of two of a system's states: target, true trail, estimates, and the input as a bar.

    What does not move is drawn once and kept as an image, so that a frame takes milliseconds.
    Parameters
    ----------
    system : whose states.
    estimates : whether there are any.
    box : of the states to show, with a margin; None is the training box.

    Raises ImportError with the remedy if matplotlib (the extra ``plots``) is not estimator.
    """

    def __init__(self, system: System, estimates: bool = False, box: Box | None = None) -> None:
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise ImportError('rendering needs matplotlib: pip install "kkl-gym[plots]"') from error
        self.estimates = estimates
        self._states = list(system.portrait)
        self._nx, self._u_max = system.nx, np.array(system.u_max)
        figure = Figure(figsize=(4.8, 4.8), dpi=100, layout="constrained")
        self._canvas: Any = FigureCanvasAgg(figure)
        heights = [24, system.nu] if system.nu else [1]
        ax, *below = figure.subplots(len(heights), height_ratios=heights, squeeze=False)[:, 0]
        names = [system.state_names[i] for i in self._states]
        (left, right), (bottom, top) = ((box or system.X)[i] for i in self._states)
        wide, tall = 0.3 * (right - left), 0.3 * (top - bottom)  # driven or not, motions leave the training box
        ax.set(xlim=(left - wide, right + wide), ylim=(bottom - tall, top + tall), xlabel=names[0], ylabel=names[1])
        ax.set_title(system.name.replace("_", " "))
        (target,) = ax.plot(*(system.target[i] for i in self._states), "+", color=TARGET, markersize=12, label="target")
        (trail,) = ax.plot([], [], color=STATE, lw=1.0, animated=True)
        (guesses,) = ax.plot([], [], color=ESTIMATE, lw=0.7, alpha=0.7, animated=True)
        (state,) = ax.plot([], [], "o", color=STATE, label="state", animated=True)
        (guess,) = ax.plot([], [], "o", color=ESTIMATE, markersize=4, label="estimate", animated=True)
        self._lines = ((trail, state), (guesses, guess))
        ax.legend(handles=[target, state, guess] if estimates else [target, state], loc="upper right")
        self._bars: Any = ()
        for bar_ax in below:
            bar_ax.set(xlim=(-1, 1), xticks=[-1, 0, 1], yticks=[], xlabel="u / u_max")
            self._bars = bar_ax.barh(range(system.nu), np.zeros(system.nu), color="C0", animated=True)
        self._canvas.draw()  # type: ignore[no-untyped-call]
        self._still = self._canvas.copy_from_bbox(figure.bbox)  # type: ignore[no-untyped-call]

    def draw(
        self,
        trail: Iterable[Sequence[float]],
        estimates: Iterable[Sequence[float]] = (),
        u: Sequence[float] | None = None,
    ) -> np.ndarray:
        """The portrait as an RGB image, uint8, (height, width, 3).

        trail, estimates : true and estimated states so far, the latest last; u : the input that acts, or None.
        """
        self._canvas.restore_region(self._still)
        for states, artists in zip((trail, estimates), self._lines, strict=True):
            points = np.array(list(states)).reshape(-1, self._nx)[:, self._states]
            for artist, shown in zip(artists, (points, points[-1:]), strict=True):
                artist.set_data(*shown.T)
                artist.axes.draw_artist(artist)
        shares = np.zeros_like(self._u_max) if u is None else u / self._u_max
        for bar, share in zip(self._bars, shares, strict=True):
            bar.set_width(share)
            bar.axes.draw_artist(bar)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
