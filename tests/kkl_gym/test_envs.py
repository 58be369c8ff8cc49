import copy
import json
import math
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from kkl_gym import ENV_IDS, KKLEnv, Lorenz, System, get_system
from kkl_gym.elementary import sin
from kkl_gym.plant import NOISE_BLOCK, output_bounds
from kkl_gym.simulate import SubstepsError, advance

everyone = pytest.mark.parametrize("name", ENV_IDS)
both = pytest.mark.parametrize("observe", ["state", "output"])
ESCAPING = [-44.0, -17.0, 212.0]  # for Rossler


def play(env, steps, seed=None, actions=None, reset=True):
    """Observations, rewards, and the last two of y and x of an episode under seeded actions."""
    rng = np.random.default_rng(0)
    out = []
    if reset:
        obs, info = env.reset(seed=seed)
        out.append([*obs, 0.0, *info["y"], *info["x"]])
    for k in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32) if actions is None else actions[k]
        obs, reward, terminated, truncated, info = env.step(action)
        out.append([*obs, reward, *info["y"], *info["x"]])
        assert not terminated
        assert not truncated
    return np.array(out)


@everyone
@both
def test_checkers_are_content(name, observe):
    env = gym.make(ENV_IDS[name], observe=observe)
    check_env(env.unwrapped, skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    sb3.check_env(env)


@everyone
@both
def test_equal_seeds_give_equal_episodes(name, observe):
    a, b = (gym.make(ENV_IDS[name], observe=observe) for _ in range(2))
    play(b, 10, seed=5)  # whatever came before
    first = play(a, 150, seed=3)  # longer than two blocks of noise
    second = play(a, 20)
    assert np.array_equal(first, play(b, 150, seed=3))
    assert np.array_equal(second, play(b, 20))
    assert (first[0, -2:] != second[0, -2:]).all()
    assert not np.array_equal(first, play(a, 150, seed=4))


@everyone
def test_starts_are_uniform_in_the_training_box(name):
    env = KKLEnv(name)
    env.reset(seed=0)
    low, high = env.system.box()
    x = np.array([env.reset()[1]["x"] for _ in range(2000)])
    assert ((x >= low) & (x <= high)).all()
    u = (x - low) / (high - low)
    assert np.allclose(u.mean(0), 0.5, atol=0.03)
    assert np.allclose(u.std(0), 12**-0.5, atol=0.02)


@pytest.mark.parametrize("own", [False, True])
def test_spec_round_trip(own, script):
    system = {"system": f"{script}:Pendulum", "parameters": {"damping": 0.4}} if own else {"parameters": {"rho": 15.0}}
    env = gym.make(
        "KKLLorenz-v0",
        **system,
        dt=0.02,
        observe="output",
        measurement_noise=0.1,
        process_noise=0.2,
        max_episode_steps=70,
    )
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.system == (get_system(*system.values()) if own else Lorenz(rho=15))
    assert again.spec.max_episode_steps == 70
    assert (again.unwrapped.dt, again.unwrapped.observe) == (0.02, "output")
    assert (again.unwrapped.measurement_noise, again.unwrapped.process_noise) == (0.1, 0.2)
    assert again.observation_space == env.observation_space
    assert np.array_equal(play(env, 20, seed=1), play(again, 20, seed=1))
    assert json.loads(again.spec.to_json()) == json.loads(env.spec.to_json())


@pytest.mark.parametrize(("name", "observe"), [("lorenz", "state"), ("rossler", "output"), ("van_der_pol", "state")])
@settings(deadline=None, max_examples=10, derandomize=True)
@given(data=st.data(), seed=st.integers(0, 2**31))
def test_any_start_and_any_actions(name, observe, data, seed):
    env = KKLEnv(name, observe=observe)
    sizes = {"y": env.system.ny, "x": env.system.nx, "u": env.system.nu}
    x0 = data.draw(st.tuples(*(st.floats(*bounds) for bounds in env.system.bounds)))
    actions = data.draw(st.lists(st.floats(allow_nan=False, allow_infinity=False, width=32), max_size=40))
    obs, info = env.reset(seed=seed, options={"x0": x0})
    assert info["x"].tolist() == list(x0)
    assert obs in env.observation_space
    assert list(info) == ["y", "x", "u", "sample", "escaped"]
    assert (info["escaped"], info["u"].tolist(), info["sample"]) == (False, [0.0] * env.system.nu, 0)
    for action in actions:
        obs, reward, terminated, truncated, info = env.step(np.array([action], np.float32))
        assert obs.dtype == np.float32
        assert np.isfinite(obs).all()
        assert obs in env.observation_space
        assert np.array_equal(obs, info["x" if observe == "state" else "y"].astype(np.float32))
        assert (type(reward), type(terminated), truncated) == (float, bool, False)
        assert 0 <= reward <= 1
        assert info["escaped"] == terminated
        assert {key: (info[key].dtype, info[key].shape) for key in info} == {
            **{key: (np.float64, (size,)) for key, size in sizes.items()},
            "sample": (np.int64, ()),
            "escaped": (np.bool_, ()),
        }
        assert all(np.isfinite(info[key]).all() for key in sizes)
        if terminated:
            break


@everyone
def test_reward_is_one_at_the_target_and_follows_the_formula(name):
    env = KKLEnv(name, process_noise=0)
    system = env.system
    env.reset(options={"x0": system.target})
    _, reward, _, _, info = env.step(np.zeros(1))
    assert reward == pytest.approx(1.0, abs=1e-9)
    env.reset(seed=0)
    for _ in range(5):
        _, reward, _, _, info = env.step(np.ones(1))
        c = np.mean(((info["x"] - system.target) / system.scale) ** 2)
        assert reward == pytest.approx(1 / (1 + 4 * c), rel=1e-12)
        assert reward < 1


def test_results_are_copies():
    env, other = KKLEnv("lorenz"), KKLEnv("lorenz")
    (obs, info), _ = env.reset(seed=0), other.reset(seed=0)
    for _ in range(3):
        for array in (obs, *info.values()):
            array[...] = 7
        (obs, *_, info), (expected, *_, theirs) = env.step(np.ones(1)), other.step(np.ones(1))
        np.testing.assert_equal((obs, info), (expected, theirs))


def test_escape_terminates_with_the_last_state():
    env = KKLEnv("rossler")
    obs, info = env.reset(seed=0, options={"x0": ESCAPING})
    terminated = False
    while not terminated:
        before, last = obs, info
        obs, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert 100 < info["sample"] < 300
    assert (terminated, truncated, info["escaped"].item()) == (True, False, True)
    assert np.array_equal(obs, before)
    assert np.array_equal(info["x"], last["x"])
    assert np.array_equal(info["y"], last["y"])
    assert 0 < reward < 1
    assert not env.reset(seed=0)[1]["escaped"]


def test_an_interval_too_long_to_simulate_is_an_error_of_its_own():
    for dt in (1e5, 1e300):
        with pytest.raises(SubstepsError, match=r"lorenz changes at a rate of 15\.48/s .* take dt <= 1.6e"):
            KKLEnv("lorenz", dt=dt)
    env = KKLEnv("lorenz", dt=1600.0)  # suits the middle of X, but not all states
    env.reset(options={"x0": [1.0, 1.0, 20.0]})
    with pytest.raises(SubstepsError, match="65536 substeps are not enough for dt = 1600 s"):
        env.step(np.zeros(1))


def test_measurement_noise_has_the_stated_deviation():
    env = KKLEnv("van_der_pol", measurement_noise=0.5)
    v = []
    for _ in range(4):
        _, info = env.reset(seed=len(v))
        for _ in range(1000):
            v.append(info["y"][0] - env.system.h(info["x"])[0])
            *_, info = env.step(np.zeros(1))
    assert np.mean(v) == pytest.approx(0.0, abs=0.04)
    assert np.std(v) == pytest.approx(0.5, rel=0.05)
    assert np.mean(np.multiply(v[1:], v[:-1])) == pytest.approx(0.0, abs=0.025)  # white
    assert len(np.unique(np.round(v, 9))) == len(v) > 4 * NOISE_BLOCK  # nor do blocks of it repeat


@pytest.mark.parametrize(("name", "level"), [("lorenz", None), ("rossler", 0.3)])
def test_process_noise_is_bounded_and_uniform(name, level):
    """w recovered from what the noise adds to a short interval; x' = f(x) + w makes x gain w dt + O(dt^2)."""
    dt = 1e-5
    env = KKLEnv(name, dt=dt, process_noise=level)
    system = env.system
    _, info = env.reset(seed=1)
    w = []
    for _ in range(3000):
        still = advance(system, info["x"].tolist(), [0.0], [0.0] * system.nx, dt)
        *_, info = env.step(np.zeros(1))
        w.append((info["x"] - still) / dt)
    bound = np.array(system.scale) * (system.process_noise if level is None else level)
    u = np.array(w) / bound
    assert np.abs(u).max() <= 1 + 1e-3
    assert (np.abs(u).max(0) > 0.99).all()
    assert np.allclose(u.mean(0), 0.0, atol=0.05)
    assert np.allclose(u.std(0), 3**-0.5, rtol=0.05)
    assert np.allclose(np.corrcoef(u.T), np.eye(system.nx), atol=0.08)


def test_start_box():
    box = np.array([(-3.0, 3.0), (-6.5, -6.0)])
    env = gym.make("KKLVanDerPol-v0", start_box=box)
    starts = np.array([env.reset(seed=seed)[1]["x"] for seed in range(50)])
    assert ((starts >= box[:, 0]) & (starts <= box[:, 1])).all()
    assert np.ptp(starts[:, 0]) > 4
    assert (gym.make_vec("KKLVanDerPol-v0", num_envs=50, start_box=box).reset(seed=0)[1]["x"] == starts).all()
    point = gym.make("KKLVanDerPol-v0", start_box=((1, 1), (2, 2)))
    assert point.reset(seed=0)[1]["x"].tolist() == [1, 2]


def test_step_and_render_before_reset():
    env = KKLEnv("lorenz", render_mode="rgb_array")
    for call in (env.render, lambda: env.step(np.zeros(1))):
        with pytest.raises(gym.error.ResetNeeded):
            call()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_a_copy_mid_episode_continues_identically(duplicate, render_mode):
    if render_mode is not None:
        pytest.importorskip("matplotlib")
    env = KKLEnv("rossler", render_mode=render_mode)
    play(env, 30, seed=0)
    env.render()
    twin = duplicate(env)
    assert np.array_equal(play(env, 100, reset=False), play(twin, 100, reset=False))
    assert np.array_equal(env.reset()[0], twin.reset()[0])
    assert render_mode is None or np.array_equal(env.render(), twin.render())


def test_import_is_light_and_registers_once():
    code = (
        "import importlib, sys, gymnasium as gym\n"
        "gym.make('kkl_gym:KKLRossler-v0').reset(seed=0)\n"  # the prefixed id needs no import
        "import kkl_gym, observers\n"
        "heavy = {'torch', 'scipy', 'matplotlib', 'sympy', 'stable_baselines3', 'training'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "before = dict(gym.registry)\n"
        "importlib.reload(kkl_gym)\n"
        "assert gym.registry == before\n"
        "env = gym.make('KKLLorenz-v0'); env.reset(seed=0); env.step(env.action_space.sample())\n"
        "assert not {'torch', 'scipy', 'matplotlib'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("n", [3, 6, 7, 20])
def test_outputs_bounds_hold_all_corners_and_what_lies_between(n):
    class Chain(System):
        name = "chain"
        X, bounds = ((-1, 1),) * n, ((-2, 2),) * n

        def f(self, x):
            return [-xi for xi in x]

        def h(self, x):
            return sum(x) - 3.0 * x[0], sin(x[0])

    low, high = output_bounds(Chain(), 0.0)
    assert high[0] == -low[0] == 2.0 * (n + 1)
    np.testing.assert_allclose((low[1], high[1]), (-1.0, 1.0), atol=1e-3)


def test_spaces():
    space, states = (KKLEnv("rossler", measurement_noise=0.5, observe=o).observation_space for o in ("output", "state"))
    assert (space.low, space.high) == (-73.0, 73.0)  # the bounds, and six times the noise
    assert states.low.tolist() == [-50.0, -70.0, -5.0]


def test_actions_are_scaled_and_clipped_and_without_noise_a_step_is_a_step():
    env = KKLEnv("lorenz", process_noise=0, measurement_noise=0)
    _, info = env.reset(seed=0)
    for action, u in ((0.5, 5.0), (-1, -10.0), (0, 0.0), (3.0, 10.0), (-1e30, -10.0), (math.inf, 10.0)):
        x = advance(env.system, info["x"].tolist(), [u], [0.0] * 3, env.dt)
        *_, info = env.step(np.array([action]))
        assert info["u"] == pytest.approx([u], rel=1e-12)
        assert info["x"].tolist() == list(x)
        assert info["y"].tolist() == list(env.system.h(x))
