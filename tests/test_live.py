"""``examples/live.py``, drawn on a canvas in memory."""

import linear_system
import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import examples.live as module
from examples.live import Live
from training.commands.options import shown


def live_of(system, observer=None, noise=None):
    figure = Figure(figsize=(12, 7.5))
    FigureCanvasAgg(figure)
    return Live(figure, shown(system, observer)[0], noise, seed=0), figure


def drawn(live, figure):
    """The pixels of the figure with its moving artists, and the text of the score."""
    figure.draw_without_rendering()
    score = live.draw()[-1].get_text()
    for artist in live.artists:
        artist.set_animated(False)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba()).copy(), score


def test_frames_follow_the_motion():
    live, figure = live_of("lorenz", noise=0.1)
    first, _ = drawn(live, figure)
    live.advance(700)
    assert (drawn(live, figure)[0] != first).any()
    x, x_hat, y, score = live.history[-1]
    assert np.abs(x_hat - x).max() < 1
    assert 0 < score < 1
    assert y.shape == (1,)
    assert len(live.history) == 701
    live.press("f")
    live.advance(200)
    assert live.history[-1][3] > 1
    assert drawn(live, figure)[1].endswith("a fault?")
    live.advance(400)
    assert len(live.history) == 1201  # 12 s


def test_keys_and_sliders():
    live, _ = live_of("van_der_pol")
    live.advance(600)
    assert live.env.observer.measurement_noise == live.sensor.level == 0.5
    live.press("down")
    assert live.env.observer.measurement_noise == live.sensor.level == pytest.approx(0.45)
    live.press("right")
    z_u = len(live.env.observer.artifact.filter.A)
    assert not live.env.observer.z[z_u:].any()
    live.advance(1)
    assert live.env.observer.z[z_u:].any()
    faults = []
    for _ in range(4):
        live.press("f")
        faults.append(live.sensor.fault)
        y = live.history[-1][2]
        live.advance(2)
        now = live.history[-1][2]
        assert (now == (0 if faults[-1] == "drop-out" else y)).all() == (faults[-1] in ("drop-out", "freeze"))
    assert faults == ["bias", "drop-out", "freeze", "none"]
    for _ in range(20):
        live.press("up")
    assert live.env.observer.measurement_noise == live.sensor.level == 1.0  # the map's largest level
    live.press("n")
    assert len(live.history) == 1
    live.press("q")
    live.press(None)


class Slow(linear_system.Oscillator):
    name, dt = "slow", 1.0


def test_slow_user_systems_move_at_the_pace_of_shipped_systems(saved):
    own = f"{__file__}:Slow"
    live, figure = live_of(own, saved(system=own, dt=1.0))
    assert (live.clock, live.seconds) == (0.01, 1200.0)
    live.advance(1300)
    assert len(live.history) == 1201
    assert np.isnan(live.history[-1][3])  # its map has no limits
    assert drawn(live, figure)[1] == ""


def test_a_window_needs_a_display():
    matplotlib.use("agg")
    with pytest.raises(ValueError, match="this needs a window, and matplotlib's backend here is 'agg'"):
        module.show(shown("van_der_pol", None)[0], None, seed=0)
