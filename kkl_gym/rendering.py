"""Phase portraits: images for ``render_mode="rgb_array"``, and a window for ``render_mode="human"``."""

import math
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from kkl_gym.system import Box, System
from observers.checks import shown

ESTIMATE, TARGET = "C3", "C2"  # in matplotlib's colour cycle; states have the colour of text
TRAIL = 1000  # largest number of samples that a phase portrait shows
FRAMES = 100  # largest number of frames a second in a video; most players show no more
DRAWN = 50  # largest number of frames a second in a window, which runs in real time
ARRAYS, ARRAYS_AND_WINDOWS = ("rgb_array",), ("rgb_array", "human")


def render_metadata(dt: float, modes: Collection[str], render_mode: str | None = None) -> dict[str, Any]:
    """Return the modes and the frame rate, 1 / dt rounded, from 1 to FRAMES; ValueError for an unknown mode."""
    if render_mode is not None and (not isinstance(render_mode, str) or render_mode not in modes):
        raise ValueError(f"render_mode must be None or one of {[*modes]}, got {shown(render_mode)}")
    return {"render_modes": [*modes], "render_fps": max(1, round(min(1.0 / dt, FRAMES)))}


class Trails:
    """The last ``TRAIL`` states of the present episode in each row of a vector environment."""

    def __init__(self, num_envs: int) -> None:
        self.rows: list[deque[list[float]]] = [deque(maxlen=TRAIL) for _ in range(num_envs)]

    def add(self, states: np.ndarray, samples: np.ndarray) -> None:
        """Append the ``states`` (num_envs, nx), one to each row's trail; sample 0 begins a new trail."""
        for trail, state, sample in zip(self.rows, states.tolist(), samples.tolist(), strict=True):
            if sample == 0:
                trail.clear()
            trail.append(state)


class Canvas:
    """A phase portrait of two states of a system, with the target, the estimates, and a bar for each input."""

    def __init__(
        self, system: System, estimates: bool = False, box: Box | None = None, *, title: str | None = None
    ) -> None:
        try:
            from matplotlib import rcParams
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise ImportError('rendering needs matplotlib: pip install "kkl-gym[plots]"') from error
        self.estimates = estimates
        self._states, ink = list(system.portrait), rcParams["text.color"]
        self._nx, self._u_max = system.nx, np.array(system.u_max)
        figure = Figure(figsize=(4.8, 4.8), dpi=100, layout="constrained")
        self._canvas: Any = FigureCanvasAgg(figure)
        heights = [24, system.nu] if system.nu else [1]
        ax, *below = figure.subplots(len(heights), height_ratios=heights, squeeze=False)[:, 0]
        names = [system.state_names[i] for i in self._states]
        (left, right), (bottom, top) = ((box or system.X)[i] for i in self._states)
        wide, tall = 0.3 * (right - left), 0.3 * (top - bottom)  # margin, because motions leave the training box
        ax.set(xlim=(left - wide, right + wide), ylim=(bottom - tall, top + tall), xlabel=names[0], ylabel=names[1])
        ax.set_title(system.name.replace("_", " ") if title is None else title)
        (target,) = ax.plot(*(system.target[i] for i in self._states), "+", color=TARGET, markersize=12, label="target")
        (trail,) = ax.plot([], [], color=ink, lw=1.0, animated=True)
        (guesses,) = ax.plot([], [], color=ESTIMATE, lw=0.7, alpha=0.7, animated=True)
        (state,) = ax.plot([], [], "o", color=ink, label="state", animated=True)
        (guess,) = ax.plot([], [], "o", color=ESTIMATE, markersize=4, label="estimate", animated=True)
        self._lines = ((trail, state), (guesses, guess))
        ax.legend(handles=[target, state, guess] if estimates else [target, state], loc="upper right")
        self._bars: Any = ()
        for bar_ax in below:
            bar_ax.set(xlim=(-1, 1), xticks=[-1, 0, 1], yticks=[], xlabel="u / u_max")
            self._bars = bar_ax.barh(range(system.nu), np.zeros(system.nu), color="C0", animated=True)
        # The background is drawn once and stored as an image, so that a frame takes only milliseconds.
        self._canvas.draw()  # type: ignore[no-untyped-call]
        self._still = self._canvas.copy_from_bbox(figure.bbox)  # type: ignore[no-untyped-call]

    def draw(
        self,
        trail: Iterable[Sequence[float]],
        estimates: Iterable[Sequence[float]] = (),
        u: Sequence[float] | np.ndarray | None = None,
    ) -> np.ndarray:
        """Draw one frame, (height, width, 3), with the states and estimates so far and the last input."""
        self._canvas.restore_region(self._still)
        for states, artists in zip((trail, estimates), self._lines, strict=True):
            points = np.array(list(states)).reshape(-1, self._nx)[:, self._states]
            for artist, drawn in zip(artists, (points, points[-1:]), strict=True):
                artist.set_data(*drawn.T)
                artist.axes.draw_artist(artist)
        shares = np.zeros_like(self._u_max) if u is None else u / self._u_max
        for bar, share in zip(self._bars, shares, strict=True):
            bar.set_width(share)
            bar.axes.draw_artist(bar)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


class Window:
    """A window that shows a motion in real time, at no more than ``DRAWN`` frames a second."""

    def __init__(self, title: str, dt: float) -> None:
        try:
            import pygame
        except ImportError as error:
            raise ImportError('render_mode="human" needs pygame: pip install "kkl-gym[human]"') from error
        self._pygame: Any = pygame
        self._title, self._rate = title, 1.0 / (dt * samples_a_frame(dt))
        self._screen: Any = None
        self._clock = pygame.time.Clock()

    def show(self, frame: np.ndarray) -> None:
        """Wait until a frame (height, width, 3) is due, and show it; the first call opens the window."""
        pygame = self._pygame
        if not self._open():
            pygame.display.init()
            self._screen = pygame.display.set_mode(frame.shape[1::-1])
            pygame.display.set_caption(self._title)
        pygame.surfarray.blit_array(self._screen, frame.swapaxes(0, 1))
        pygame.event.pump()
        self._clock.tick(self._rate)
        pygame.display.flip()

    def close(self) -> None:
        """Close the window."""
        if self._open():
            self._pygame.display.quit()
        self._screen = None

    def _open(self) -> bool:
        """Whether the window is open. A process has only one window, and other code may close or replace it."""
        return self._screen is not None and self._pygame.display.get_surface() is self._screen


def samples_a_frame(dt: float) -> int:
    """Return the number of sampling intervals of ``dt`` seconds between two frames of a window."""
    return max(1, math.ceil(1.0 / (dt * DRAWN) - 1e-9))
