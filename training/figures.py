"""One style for all figures, light or dark, and functions that write figures and animations."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from kkl_gym.rendering import ESTIMATE as ESTIMATE
from kkl_gym.rendering import TARGET as TARGET
from observers.storage import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image

Theme = Literal["light", "dark"]
RIVAL, ALARM, TRUTH, MEASURED = "C0", "C1", "C6", "C7"  # indices into the theme's colour cycle
# All eight colours can be distinguished with red-green and blue-yellow colour blindness. C0, C2 and C3, with which
# environments render, are blue, green and magenta; outside this style they are blue, green and red.
CYCLES: dict[Theme, tuple[str, ...]] = {
    "light": ("#0072b2", "#e69f00", "#009e73", "#c2187a", "#56b4e9", "#7a4a1e", "#1a1a1a", "#9a9a9a"),
    "dark": ("#4aa3df", "#f0a83c", "#2fbf93", "#ff6db8", "#a6dcff", "#b98a5a", "#eceae4", "#8a909c"),
}
GROUNDS: dict[Theme, str] = {"light": "#ffffff", "dark": "#1e2129"}  # backgrounds, the same as on the website
RULES: dict[Theme, str] = {"light": "#e4e4e4", "dark": "#363b47"}  # grid lines and frames of legends
ALIKE: dict[str, Any] = {  # settings of both themes
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": "medium",
    "figure.constrained_layout.use": True,
    "figure.dpi": 110,
    "figure.titlesize": "medium",
    "grid.linewidth": 0.6,
    "legend.fontsize": "small",
    "lines.linewidth": 1.2,
    "lines.markersize": 4.0,
}
SHADES = (0.15, 0.3, 0.5, 0.75, 1.0)  # shares of each colour, mixed with the background, in an animation's palette


def theme_around() -> Theme:
    """Return the theme of the enclosing :func:`style` block, recognised by its background colour."""
    import matplotlib

    return "dark" if matplotlib.rcParams["figure.facecolor"] == GROUNDS["dark"] else "light"


def style(theme: Theme | None = None) -> AbstractContextManager[None]:
    """Draw in the style of this package inside a ``with`` block, by default in the enclosing block's theme."""
    import matplotlib

    return matplotlib.rc_context(looks(theme or theme_around()))


def looks(theme: Theme = "light") -> dict[Any, Any]:
    """Return the matplotlib settings of this style; notebooks use ``plt.rcParams |= looks()``."""
    from cycler import cycler

    ink = CYCLES[theme][int(TRUTH[1])]
    grounds = dict.fromkeys(("axes.facecolor", "figure.facecolor", "legend.facecolor"), GROUNDS[theme])
    inks = dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "text.color", "xtick.color", "ytick.color"), ink)
    rules = dict.fromkeys(("grid.color", "legend.edgecolor"), RULES[theme])
    return {**ALIKE, **grounds, **inks, **rules, "axes.prop_cycle": cycler(color=CYCLES[theme])}


@contextmanager
def drawing(path: Path, width: float, height: float) -> Iterator["Figure"]:
    """Make a figure in this style, and write it whole or not at all at the end of the ``with`` block."""
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(width, height))
        yield figure
        with replacing(path) as temporary:
            figure.savefig(temporary)


def save_moving(path: Path, frames: "Sequence[Image]", *, seconds: float) -> None:
    """Write a looping GIF, whole or not at all; its frames share one palette, so that unchanged parts take no space."""
    from matplotlib.colors import to_rgb
    from PIL import Image

    theme = theme_around()
    ground, *own = (255 * np.array(to_rgb(each)) for each in (GROUNDS[theme], *CYCLES[theme]))
    palette = [ground, *(ground + share * (colour - ground) for colour in own for share in SHADES)]
    few = Image.new("P", (1, 1))
    few.putpalette(np.round(palette).astype(int).ravel().tolist())
    first, *others = (frame.quantize(palette=few, dither=Image.Dither.NONE) for frame in frames)
    how: dict[str, Any] = {"save_all": True, "duration": round(1000 * seconds / len(frames)), "loop": 0}
    with replacing(path) as temporary:
        first.save(temporary, format="GIF", append_images=others, **how)
