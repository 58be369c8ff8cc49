"""The bridge against stable-baselines3's own vector of single environments."""

from functools import partial

import gymnasium as gym
import linear_system
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from kkl_gym import KKLObservation, KKLVectorEnv, KKLVectorObservation
from training.agents import SB3VecEnv

N, STEPS = 3, 10


def vector(path):
    env = KKLVectorEnv("van_der_pol", N, max_episode_steps=STEPS, autoreset_mode="SameStep")
    return KKLVectorObservation(env, path)


def cart(monitored=False):
    env = gym.make("CartPole-v1", max_episode_steps=STEPS)
    return Monitor(env) if monitored else env


def actions(steps):
    return np.random.default_rng(0).uniform(-1, 1, (steps, N, 1)).astype(np.float32)


def test_steps_equal_those_of_stable_baselines3s_own_vector(saved):
    def single():
        return KKLObservation(gym.make("KKLVanDerPol-v0", max_episode_steps=STEPS), saved())

    ours, theirs = SB3VecEnv(vector(saved()), ("y", "u")), DummyVecEnv([single] * N)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for env in (ours, theirs):
        env.seed(4)
    assert np.allclose(ours.reset(), theirs.reset(), atol=1e-5)
    for info, other in zip(ours.reset_infos, theirs.reset_infos, strict=True):
        assert np.allclose(info["y"], other["y"])
    ended = 0
    for action in actions(3 * STEPS):
        obs, reward, done, infos = ours.step(action)
        their_obs, their_reward, their_done, their_infos = theirs.step(action)
        assert np.allclose(obs, their_obs, atol=1e-5)
        assert reward.dtype == their_reward.dtype
        assert np.allclose(reward, their_reward)
        assert (done == their_done).all()
        for row, (mine, other) in enumerate(zip(infos, their_infos, strict=True)):
            assert mine.keys() == (other.keys() if done[row] else {"y", "u"})
            for key in mine.keys() & {"y", "u", "x_hat", "terminal_observation"}:
                assert np.allclose(mine[key], other[key], atol=1e-5)
            if done[row]:
                ended += 1
                assert mine["TimeLimit.truncated"] is other["TimeLimit.truncated"] is True
                assert np.allclose(ours.reset_infos[row]["y"], theirs.reset_infos[row]["y"])
    assert ended == 3 * N


def test_escapes_are_no_time_limits():
    env = SB3VecEnv(KKLVectorEnv("rossler", 2, max_episode_steps=400, autoreset_mode="SameStep"))
    env.set_options({"x0": [-44.0, -17.0, 212.0]})
    env.reset()
    for _ in range(300):
        _, _, done, infos = env.step(np.zeros((2, 1)))
        if done.any():
            break
    info = infos[int(done.argmax())]
    assert info["TimeLimit.truncated"] is False
    assert info["escaped"]
    assert (np.abs(env.reset()) < 25).all()  # options apply to one reset only


def test_any_vector_environment():
    ours = SB3VecEnv(RecordEpisodeStatistics(SyncVectorEnv([cart] * N, autoreset_mode="SameStep")))
    theirs = DummyVecEnv([cart] * N)
    for env in (ours, theirs):
        env.seed(0)
    assert (ours.reset() == theirs.reset()).all()
    for _ in range(2 * STEPS):
        action = np.random.default_rng(0).integers(0, 2, N)
        mine, other = ours.step(action), theirs.step(action)
        for a, b in zip(mine[:3], other[:3], strict=True):
            assert (a == b).all()
        for row in np.flatnonzero(mine[2]):
            assert (mine[3][row]["terminal_observation"] == other[3][row]["terminal_observation"]).all()
    assert ours.get_attr("spec", 1)[0].id == "CartPole-v1"
    assert ours.get_attr("render_mode") == [None] * N
    assert ours.env_method("get_wrapper_attr", "gravity") == [9.8] * N
    with pytest.raises(ValueError, match="in all rows at once"):
        ours.env_method("get_wrapper_attr", "gravity", indices=[0, 2])
    ours.set_attr("gravity", 5.0)
    assert ours.get_attr("gravity") == [5.0] * N
    assert ours.env_is_wrapped(RecordEpisodeStatistics) == [True] * N
    assert ours.env_is_wrapped(KKLVectorObservation) == [False] * N


def test_attributes_of_batched_environments(saved):
    env = SB3VecEnv(vector(saved()))
    assert env.get_attr("estimate") == ["x"] * N
    assert [plant.dt for plant in env.get_attr("plant", [0, 1])] == [0.01, 0.01]
    assert not env.has_attr("nothing")
    env.set_attr("max_episode_steps", 3)
    assert env.get_attr("max_episode_steps", 0) == [3]
    with pytest.raises(ValueError, match="in all rows at once"):
        env.set_attr("max_episode_steps", 3, [0])
    with pytest.raises(AttributeError, match="not separate environments"):
        env.env_method("step", 0)
    env.close()


def test_invalid_environments_and_options_are_refused():
    with pytest.raises(ValueError, match='autoreset_mode="SameStep"'):
        SB3VecEnv(KKLVectorEnv("lorenz", 2, autoreset_mode="NextStep"))
    with pytest.raises(ValueError, match="the action space is empty"):
        SB3VecEnv(KKLVectorEnv(f"{linear_system.__file__}:Autonomous", 2, autoreset_mode="SameStep"))
    env = SB3VecEnv(KKLVectorEnv("van_der_pol", N, autoreset_mode="SameStep"))
    env.set_options([{"x0": [1.0, 1.0]}, {}, {}])
    with pytest.raises(ValueError, match="the same options for all rows"):
        env.reset()
    env.set_options({"x0": np.array([1.0, 1.5])})  # replaces the invalid options
    assert env.reset().tolist() == [[1.0, 1.5]] * N


@pytest.mark.parametrize("inside", [True, False])
def test_nested_infos_arrive_as_stable_baselines3_expects_them(inside):
    """Monitors report a dictionary at the end of an episode."""
    env = SyncVectorEnv([partial(cart, inside)] * N, autoreset_mode="SameStep")
    env, seen = SB3VecEnv(env if inside else RecordEpisodeStatistics(env)), 0
    env.seed(0)
    env.reset()
    for _ in range(2 * STEPS):
        _, _, done, infos = env.step(np.zeros(N, dtype=int))
        for info, ended in zip(infos, done, strict=True):
            assert ("episode" in info) == ended
            seen += ended
            assert not ended or 1 <= info["episode"]["l"] <= STEPS
    assert seen >= N


def test_observations_are_copies_even_where_the_environment_reuses_its_array():
    env = SB3VecEnv(SyncVectorEnv([cart] * N, autoreset_mode="SameStep", copy=False))
    first = env.reset()
    kept = first.copy()
    second, *_ = env.step(np.ones(N, dtype=int))
    assert (first == kept).all()
    env.step(np.ones(N, dtype=int))
    assert (second != env.step(np.ones(N, dtype=int))[0]).any()
