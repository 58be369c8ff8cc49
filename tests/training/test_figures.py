"""The style of figures: colours of the themes, unchanged global settings, and saved files."""

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from PIL import Image

from training.figures import CYCLES, ESTIMATE, GROUNDS, TRUTH, drawing, save_moving, style

THEMES = ("light", "dark")


def test_a_theme_holds_within_its_block_alone():
    before = dict(matplotlib.rcParams)
    with style("dark"):
        assert to_hex(TRUTH) == CYCLES["dark"][6]
        with style():
            assert matplotlib.rcParams["figure.facecolor"] == GROUNDS["dark"]
        with style("light"):
            assert to_hex(TRUTH) == CYCLES["light"][6]
        assert to_hex(TRUTH) == CYCLES["dark"][6]
    with style():
        assert matplotlib.rcParams["text.color"] == CYCLES["light"][6]
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("theme", THEMES)
def test_a_drawing_is_written_at_its_end(tmp_path, theme):
    path = tmp_path / "new" / "figure.png"
    with style(theme), drawing(path, 3, 2) as figure:
        figure.subplots().plot([0, 1], color=ESTIMATE, lw=20)
        assert not path.exists()
    picture = np.asarray(Image.open(path).convert("RGB"))
    assert picture.shape == (220, 330, 3)
    assert to_hex(picture[0, 0] / 255) == GROUNDS[theme]
    assert (picture == np.round(255 * np.array(to_rgb(CYCLES[theme][3])))).all(axis=2).any()


@pytest.mark.parametrize("theme", THEMES)
def test_moving_pictures_keep_ground_and_colours(tmp_path, theme):
    """A palette might drop the colour of a thin line in favour of the many blends with the background."""
    ground = np.round(255 * np.array(to_rgb(GROUNDS[theme]))).astype(np.uint8)
    rng = np.random.default_rng(0)
    frames = np.tile(ground, (5, 60, 80, 1))
    frames[:, 30:, 10:70] ^= rng.integers(0, 8, (5, 30, 60, 3), dtype=np.uint8)  # close to the background
    own = np.round(255 * np.array([to_rgb(colour) for colour in CYCLES[theme]])).astype(np.uint8)
    frames[:, 10, 10 : 10 + len(own)] = own
    for k, frame in enumerate(frames):  # one pixel moves
        frame[20, 10 + k] = own[0]
    path = tmp_path / "moving.gif"
    with style(theme):
        save_moving(path, [Image.fromarray(frame) for frame in frames], seconds=1.0)
    with Image.open(path) as found:
        assert (found.n_frames, found.info["loop"]) == (5, 0)
        assert found.info["duration"] == 200
        for k in range(5):
            found.seek(k)
            shown = np.asarray(found.convert("RGB"))
            assert (shown[:10] == ground).all()
            np.testing.assert_array_equal(shown[10, 10 : 10 + len(own)], own)
