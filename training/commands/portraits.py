"""The moving picture of ``kkl-gym demo``: phase portraits side by side, and below each what its observer sees."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from training.figures import ESTIMATE, MEASURED, TRUTH, save_moving, style

if TYPE_CHECKING:
    from training.commands.demo import Episode

SECONDS = 12.0  # of motion at the pace of the systems that ship, where it plays as fast as the motion
FRAMES = 144  # at most
TRAIL = 0.35  # of the samples drawn: older points would hide the new ones


def animate(path: Path, motions: Sequence["Episode"]) -> None:
    """Draw states and estimates as they move, a column for each motion."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    side = 2.4 if len(motions) > 1 else 4.8  # one alone must have room for the legend
    frames: list[Image.Image] = []
    with style():
        figure = Figure(figsize=(side * len(motions), side + 0.7), dpi=120)
        canvas: Any = FigureCanvasAgg(figure)
        axes = figure.subplots(2, len(motions), squeeze=False, height_ratios=[4, 1])
        columns = [Column(motion, *pair) for motion, pair in zip(motions, axes.T, strict=True)]
        columns[0].name_lines(figure)
        canvas.draw()
        still = canvas.copy_from_bbox(figure.bbox)
        for share in np.arange(1, FRAMES + 1) / FRAMES:
            canvas.restore_region(still)
            for column in columns:
                column.show(share)
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    save_moving(path, frames, seconds=SECONDS)


class Column:
    """A phase portrait of the beginning of a motion, and the measured outputs below it."""

    def __init__(self, motion: "Episode", portrait: Any, strip: Any) -> None:
        system, shown = motion.system, list(motion.system.portrait)
        self.samples = min(len(motion.x), 1 + round(SECONDS * system.pace / motion.dt))
        self.x, self.x_hat = (states[: self.samples, shown] for states in (motion.x, motion.x_hat))
        self.y, self.t = motion.y[: self.samples], np.arange(self.samples) * motion.dt
        low, high = self.x.min(0), self.x.max(0)
        margin = 0.2 * np.where(high > low, high - low, 1.0)  # the first estimates may be far off
        (left, bottom), (right, top) = low - margin, high + margin
        names = [system.state_names[i] for i in shown]
        portrait.set(xlim=(left, right), ylim=(bottom, top), title=system.name.replace("_", " "), xticks=[], yticks=[])
        portrait.set_xlabel(names[0], labelpad=2)
        portrait.set_ylabel(names[1], labelpad=2)
        strip.set(xlim=(0.0, self.t[-1]), ylim=(self.y.min(), self.y.max()), yticks=[], xticks=[0, int(self.t[-1])])
        strip.set_xlabel("t in s", labelpad=-8)
        strip.set_ylabel("y", labelpad=2)
        self.trails = [
            (
                portrait.plot([], [], style, color=color, lw=width, animated=True)[0],
                portrait.plot([], [], "o", color=color, markersize=size, animated=True)[0],
            )
            for style, color, width, size in (("-", TRUTH, 1.4, 7), ("-", ESTIMATE, 1.2, 4))
        ]
        self.outputs = [strip.plot([], [], color=MEASURED, lw=0.6, animated=True)[0] for _ in self.y.T]

    def name_lines(self, figure: Any) -> None:
        """Put the legend of all columns above them."""
        lines = [*(trail for trail, _ in self.trails), self.outputs[0]]
        figure.legend(lines, ["state", "estimate", "what the observer sees"], loc="outside upper center", ncols=3)

    def show(self, share: float) -> None:
        """Draw a frame."""
        now = max(1, round(share * self.samples))
        first = max(0, now - round(TRAIL * self.samples))
        for (trail, head), states in zip(self.trails, (self.x, self.x_hat), strict=True):
            trail.set_data(*states[first:now].T)
            head.set_data(*states[now - 1 : now].T)
        for line, output in zip(self.outputs, self.y.T, strict=True):
            line.set_data(self.t[:now], output[:now])
        for artist in (*(artist for pair in self.trails for artist in pair), *self.outputs):
            artist.axes.draw_artist(artist)
