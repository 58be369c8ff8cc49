"""``render_mode="human"``: a window that shows the motion in real time, and playing with keys."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.play import PlayableGame
from pushed_systems import TwoInputs

from kkl_gym import ActionRepeat, KKLEnv, KKLObservation

pygame = pytest.importorskip("pygame")
pytest.importorskip("matplotlib")


@pytest.fixture
def shown(monkeypatch):
    """A list that collects the frames which windows show."""
    frames = []
    flip = pygame.display.flip
    monkeypatch.setattr(pygame.display, "flip", lambda: (frames.append(shot()), flip()))
    yield frames
    pygame.display.quit()


def shot():
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def test_it_is_open_from_reset_to_close(shown):
    env = gym.make("KKLVanDerPol-v0", render_mode="human")
    assert not pygame.display.get_init()
    env.reset(seed=0)
    assert pygame.display.get_caption()[0] == "van der pol"
    for _ in range(8):
        env.step(np.ones(1, np.float32))
    assert len(shown) == 5  # every second sample
    assert env.render() is None
    assert len(shown) == 6
    arrays = gym.make("KKLVanDerPol-v0", render_mode="rgb_array")
    arrays.reset(seed=0)
    for _ in range(8):
        arrays.step(np.ones(1, np.float32))
    assert np.array_equal(shown[-1], arrays.render())
    env.close()
    assert not pygame.display.get_init()
    env.reset(seed=0)
    assert len(shown) == 7
    env.close()


@pytest.mark.parametrize("estimate", ["x", "z"])
def test_the_outermost_observer_draws(estimate, shown, saved):
    """The frame contains the estimate of x; an observer of z alone has no estimate to draw."""
    outer = {"observer": saved(age=False), "estimate": estimate}
    windows, arrays = (
        ActionRepeat(KKLObservation(KKLObservation(KKLEnv("van_der_pol", render_mode=mode), saved()), **outer), 4)
        for mode in ("human", "rgb_array")
    )
    for env in (windows, arrays):
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(1, np.float32))
    assert len(shown) == 11
    assert np.array_equal(shown[-1], arrays.render())
    assert np.array_equal(shown[-1], arrays.unwrapped.render()) == (estimate == "z")
    windows.close()


def test_keys_for_people():
    env = gym.make("KKLLorenz-v0", render_mode="rgb_array")
    env.reset(seed=0)
    assert PlayableGame(env).relevant_keys == {ord("a"), ord("d")}
    pygame.display.quit()
    one, two = (
        {"".join(map(chr, pressed)): action.tolist() for pressed, action in each.get_keys_to_action().items()}
        for each in (env.unwrapped, KKLEnv(TwoInputs()))
    )
    assert one == {"a": [-1.0], "d": [1.0]}
    assert len(two) == 8
    assert (two["w"], two["aw"], two["ds"]) == ([0.0, 1.0], [-1.0, 1.0], [1.0, -1.0])


def test_a_window_that_another_environment_closed_opens_again(shown):
    """A process has one window: an evaluation closes the window of the training environment."""
    env, other = (gym.make("KKLVanDerPol-v0", render_mode="human") for _ in range(2))
    env.reset(seed=0)
    other.reset(seed=0)
    other.close()
    before = len(shown)
    env.step(np.zeros(1, np.float32))
    env.step(np.zeros(1, np.float32))
    assert len(shown) == before + 1
    other.close()  # has no effect: the window is now that of `env`
    assert pygame.display.get_init()
    env.close()
    assert not pygame.display.get_init()


def test_without_pygame(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r'pip install "kkl-gym\[human\]"'):
        KKLEnv("lorenz", render_mode="human").reset(seed=0)
