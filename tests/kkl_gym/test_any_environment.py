"""Observers trained from rollouts, used as wrappers of their environments."""

from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from alike_vectors import compare
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset, ClipAction, DiscretizeAction, RescaleAction
from rollout_observers import observer_of

from kkl_gym import KKLObservation, KKLVectorObservation
from observers import ArtifactError, KKLObserver

modes = pytest.mark.parametrize("mode", list(AutoresetMode))
PENDULUM = partial(observer_of, "Pendulum-v1", ["obs[0]", "obs[1]"], ["obs[2]", "cos(obs[2])"], ["action[0]"], dt=0.05)
CART_POLE = partial(
    observer_of, "CartPole-v1", ["obs[0]", "obs[2]"], ["obs[1]", "info[other]"], ["action[0]", "action[1]"]
)


@pytest.fixture
def saved(tmp_path):
    def save(artifact):
        path = tmp_path / "observer.safetensors"
        artifact.save(path)
        return str(path)

    return save


@pytest.mark.parametrize("estimate", ["x", "z"])
def test_observations_hold_the_measured_signals_and_the_estimate(saved, estimate):
    artifact, plain = PENDULUM(), gym.make("Pendulum-v1")
    env = KKLObservation(gym.make("Pendulum-v1"), saved(artifact), estimate=estimate)
    raw, _ = plain.reset(seed=5)
    obs, info = env.reset(seed=5)
    expected = KKLObserver(artifact)
    expected.reset(raw[:2])
    env.action_space.seed(0)
    for _ in range(30):
        action = env.action_space.sample()
        raw, *_ = plain.step(action)
        obs, _, _, _, info = env.step(action)
        x_hat = expected.step(raw[:2], action / 2.0)
        shown = x_hat if estimate == "x" else expected.z
        np.testing.assert_allclose(info["x_hat" if estimate == "x" else "z"], shown)
        np.testing.assert_array_equal(info["y"], raw[:2])
        np.testing.assert_allclose(info["x"], [raw[2], np.cos(raw[2])])
        np.testing.assert_allclose(info["u"], action / 2.0)
        clipped = np.clip(np.concatenate([raw[:2], shown]), env.observation_space.low, env.observation_space.high)
        np.testing.assert_allclose(obs, clipped, rtol=1e-6)
    if estimate == "x":
        assert env.observation_space.high.tolist() == [1.0, 1.0, 8.0, 1.0]
    assert obs in env.observation_space


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_is_an_environment_that_is_made_again_from_its_specification(saved):
    env = KKLObservation(gym.make("CartPole-v1"), saved(CART_POLE()))
    check_env(env, skip_render_check=True)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert np.isinf(again.observation_space.high[-1])  # a state that is not in the observation has no bound
    obs, _ = env.reset(seed=1)
    same, _ = again.reset(seed=1)
    np.testing.assert_array_equal(obs, same)


def test_wrong_environments_of_artifacts():
    for wrong in ({"environment": {"id": "Pendulum-v1"}}, {"signals": None}):
        with pytest.raises(ArtifactError, match=r"(a dict 'kwargs'|needs signals)"):
            replace(PENDULUM(), **wrong)


def test_other_environments_are_refused(saved):
    path = saved(PENDULUM())
    for env, message in (
        (gym.make("CartPole-v1"), "made for the environment 'Pendulum-v1', but this is 'CartPole-v1'; an observer is"),
        (gym.make("Pendulum-v1", g=3.0), r"Pendulum-v1 with arguments {}, but this is {'g': 3.0}"),
        (gym.make("Pendulum-v1").unwrapped.__class__(), "has no specification"),
    ):
        with pytest.raises(ValueError, match=message):
            KKLObservation(env, path)
    with pytest.raises(ArtifactError, match="fits only Pendulum-v1"):
        PENDULUM().require_system()
    KKLObservation(gym.make("Pendulum-v1", render_mode="rgb_array", max_episode_steps=7), path)
    with pytest.raises(ArtifactError, match=r"the sampling interval 0\.1, but this is 0\.05"):
        KKLObservation(gym.make("Pendulum-v1"), saved(observer_of("Pendulum-v1", ["obs[0]"], ["obs[2]"], [], dt=0.1)))
    with pytest.raises(ArtifactError, match=r"does not fit: measured contains 'obs\[3\]'"):
        KKLObservation(gym.make("Pendulum-v1"), saved(observer_of("Pendulum-v1", ["obs[3]"], ["obs[2]"], [], dt=0.05)))
    with pytest.raises(ValueError, match="kkl-gym record CartPole-v1 --measured"):
        KKLObservation(gym.make("CartPole-v1"))


@modes
def test_rows_of_a_vector_are_single_environments(saved, mode):
    path, make = saved(CART_POLE()), partial(gym.make, "CartPole-v1", max_episode_steps=17)
    envs = KKLVectorObservation(SyncVectorEnv([make] * 3, autoreset_mode=mode), path)
    rows = SyncVectorEnv([lambda: KKLObservation(make(), path)] * 3, autoreset_mode=mode)
    actions = np.random.default_rng(0).integers(2, size=(60, 3))
    assert len(compare(envs, rows, actions, mode, infos={"final_obs", "y"})) > 3


class Counter(gym.Env):
    """A counter in the observation; ``info`` has its square after steps, not after resets, and never if `silent`."""

    observation_space = gym.spaces.Box(-99.0, 99.0, (2,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, silent=False):
        self.silent = silent

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.float32([0, 10]), {"x": "what the environment calls x"}

    def step(self, action):
        self.count += 1
        info = {} if self.silent else {"square": self.count**2}
        return np.float32([self.count, 10 + self.count]), 0.0, self.count == 5, False, info


@pytest.fixture
def counter():
    gym.register("Counter-v0", entry_point=Counter, disable_env_checker=True)
    yield partial(gym.make, "Counter-v0")
    gym.registry.pop("Counter-v0")


def test_hidden_signals_of_vectors(saved, counter):
    path = saved(observer_of("Counter-v0", ["obs[0]"], ["obs[1]", "info[square]"], ["action[1]"]))
    mode = AutoresetMode.SAME_STEP
    envs = KKLVectorObservation(SyncVectorEnv([counter] * 2, autoreset_mode=mode), path)
    envs.reset(seed=0)
    for k in range(1, 12):
        *_, info = envs.step(np.array([0, 1]))
        count = (k - 1) % 5 + 1
        seen = info["final_info"] if count == 5 else info
        np.testing.assert_array_equal(seen["x"], [[10.0 + count, count**2]] * 2)
        assert seen["_x"].all()
        np.testing.assert_array_equal(seen["u"], [[0.0], [1.0]])
        if count == 5:
            assert not info.get("_x", np.zeros(2)).any()  # the info of a reset has no square


def test_info_has_no_x_where_a_hidden_signal_is_not_available(saved, counter):
    path, plain = saved(PENDULUM()), gym.make("Pendulum-v1")
    two = gym.spaces.Box(-1.0, 1.0, (2,))
    for show, space in ((lambda obs: obs * [1, 1, np.nan], None), (lambda obs: obs[:2], two)):
        env = KKLObservation(gym.wrappers.TransformObservation(plain, show, space), path)
        _, first = env.reset(seed=0)
        *_, info = env.step(np.zeros(1, np.float32))
        assert "x" not in {**first, **info}
    silent = saved(observer_of("Counter-v0", ["obs[0]"], ["info[square]"], [], kwargs={"silent": True}))
    envs = KKLVectorObservation(SyncVectorEnv([partial(counter, silent=True)] * 2), silent)
    envs.reset(seed=0)
    assert "x" not in envs.step(np.array([0, 1]))[-1]


def test_the_observer_is_replaced_at_once(saved, tmp_path):
    artifact, path, inverse = CART_POLE(), saved(CART_POLE()), CART_POLE().inverse
    other = replace(artifact, inverse=replace(inverse, x_offset=inverse.x_offset + 0.5))
    other.save(tmp_path / "other.safetensors")
    envs, same = (KKLVectorObservation(SyncVectorEnv([partial(gym.make, "CartPole-v1")]), path) for _ in range(2))
    env = KKLObservation(gym.make("CartPole-v1"), path)
    for each in (env, same, envs):
        each.reset(seed=1)
    env.replace_observer(other)
    envs.replace_observer(tmp_path / "other.safetensors")
    expected = same.step(np.array([1]))[-1]["x_hat"] + 0.5
    np.testing.assert_allclose(env.step(1)[-1]["x_hat"], expected[0], rtol=1e-5)
    np.testing.assert_allclose(envs.step(np.array([1]))[-1]["x_hat"], expected, rtol=1e-5)


def test_wrappers_that_change_the_meaning_of_actions(saved):
    path = saved(PENDULUM())
    for wrap in (ClipAction, partial(DiscretizeAction, bins=3)):
        with pytest.raises(ArtifactError, match=r"a wrapper between .* takes .*: the observer would misread them"):
            KKLObservation(wrap(gym.make("Pendulum-v1")), path)
    half = np.float32([0.5])
    plain, inside = (KKLObservation(gym.make("Pendulum-v1"), path) for _ in range(2))
    inside = KKLObservation(RescaleAction(gym.make("Pendulum-v1"), np.float32(-1), np.float32(1)), path)
    plain.reset(seed=0), inside.reset(seed=0)
    np.testing.assert_allclose(inside.step(half)[0], plain.step(2 * half)[0], rtol=1e-6)
    ClipAction(plain).step(9 * half)


def test_autoreset_inside_is_refused(saved):
    with pytest.raises(ValueError, match="Autoreset hides where episodes begin: remove it, or make it outermost"):
        KKLObservation(Autoreset(gym.make("Pendulum-v1")), saved(PENDULUM()))


def test_vectors_that_are_refused(saved):
    path = saved(PENDULUM())
    different = SyncVectorEnv([partial(gym.make, "Pendulum-v1", g=g) for g in (9.0, 10.0)])
    with pytest.raises(ValueError, match="the environments differ"):
        KKLVectorObservation(different, path)
    with pytest.raises(ValueError, match="KKLVectorMemory"):
        KKLVectorObservation(gym.make_vec("CartPole-v1", num_envs=2))
    artifact = observer_of("Pendulum-v1", ["info[angle]"], ["obs[2]"], [], dt=0.05)
    with pytest.raises(ValueError, match=r"measures info\[angle\], which vectors do not report"):
        KKLVectorObservation(SyncVectorEnv([partial(gym.make, "Pendulum-v1")] * 2), saved(artifact))


class Losing(gym.ObservationWrapper):
    """Replaces the second entry of every other observation by NaN, beginning with the second observation."""

    lost = True

    def observation(self, observation):
        self.lost = not self.lost
        return np.where([False, self.lost, False], np.float32(np.nan), observation)


@pytest.mark.parametrize("vectors", [False, True])
def test_the_observer_skips_missing_entries_of_an_observation(saved, vectors):
    artifact = PENDULUM()
    if vectors:
        env = KKLVectorObservation(SyncVectorEnv([lambda: Losing(gym.make("Pendulum-v1"))] * 2), saved(artifact))
    else:
        env = KKLObservation(Losing(gym.make("Pendulum-v1")), saved(artifact))
    expected = KKLObserver(artifact)
    obs, info = env.reset(seed=5)
    expected.reset(info["y"])
    for k in range(6):
        before = obs
        obs, *_, info = env.step(np.full(env.action_space.shape, 0.5, np.float32))
        assert np.isnan(info["y"][..., 1]).all() == (k % 2 == 0)
        np.testing.assert_allclose(info["x_hat"], expected.step(info["y"], info["u"]))
        assert np.isfinite(obs).all()
        assert k % 2 or np.array_equal(obs[..., 1], before[..., 1])  # the last value is held
