"""The sensor of environments against closed forms, and the samples that the observer gets."""

import copy
import json
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from alike_vectors import compare
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation, RecordEpisodeStatistics, TransformObservation

import kkl_gym
from kkl_gym import KKLEnv, KKLObservation, KKLVectorEnv, KKLVectorObservation, Sensor, System
from kkl_gym.identity import identity
from observers import KKLObserver

ALL = {
    "gain": 1.1,
    "bias": 0.2,
    "coloured_noise": 0.3,
    "time_constant": 0.05,
    "quantum": 0.25,
    "saturation": [-6.0, 6.0],
    "delay": 3,
    "drop_out": 0.2,
    "every": 2,
}


class Drifting(System):
    """Two outputs that move independently."""

    name, X, bounds = "drifting", ((-1, 1), (-1, 1)), ((-100, 100), (-100, 100))
    u_max, G = (1.0,), ((1.0,), (0.0,))

    def f(self, x):
        return 0.0 * x[0] + 1.0, 0.5 - 0.0 * x[1]

    def h(self, x):
        return x[0], 3.0 * x[1]

    def rate(self, x):
        return 1.0


def record(system="van_der_pol", steps=300, n=6, seed=0, **options):
    """Noiseless outputs, samples and observations, (steps + 1, n, ...), for n consecutive seeds."""
    env, clean = KKLVectorEnv(system, n, **options), kkl_gym.get_system(system).output
    obs, info = env.reset(seed=seed)
    found = [(clean(info["x"]), info["y"], obs)]
    for action in np.random.default_rng(1).uniform(-1, 1, (steps, 1)):
        obs, *_, info = env.step(np.tile(action, (n, 1)))
        found.append((clean(info["x"]), info["y"], obs))
    return tuple(map(np.array, zip(*found, strict=True)))


def test_quantum_bias_gain_and_saturation():
    clean, y, _ = record(measurement_noise=0.0, sensor=Sensor(quantum=0.3))
    assert abs(y - clean).max() <= 0.15 + 1e-12
    assert np.allclose(y / 0.3, np.rint(y / 0.3))
    assert np.ptp(y) > 1.0
    clean, y, _ = record(measurement_noise=0.0, sensor={"gain": -2, "bias": 0.5})
    assert np.allclose(y, 0.5 - 2.0 * clean)
    clean, y, obs = record(measurement_noise=0.0, sensor={"saturation": (-1.0, 0.5)}, observe="output")
    assert np.allclose(y, np.clip(clean, -1.0, 0.5))
    assert {obs.min(), obs.max()} == {-1.0, 0.5}


def test_a_delay_shifts_the_record():
    now, late = (record(sensor=Sensor(delay=delay))[1] for delay in (0, 7))
    assert np.array_equal(late[7:], now[:-7])
    assert (late[:7] == now[0]).all()


def test_every_third_step_and_drop_outs():
    _, plain, _ = record()
    _, y, obs = record(sensor=Sensor(every=3), observe="output")
    there = np.arange(len(y)) % 3 == 0
    assert np.array_equal(y[there], plain[there])
    assert np.isnan(y[~there]).all()
    assert np.array_equal(obs[1::3], obs[0:-1:3])  # the last value is held
    assert np.isfinite(obs).all()
    _, y, _ = record(steps=2000, sensor=Sensor(drop_out=0.3))
    lost = np.isnan(y[1:])
    assert not np.isnan(y[0]).any()
    assert lost.mean() == pytest.approx(0.3, abs=4 * (0.3 * 0.7 / lost.size) ** 0.5)
    pairs = lost[1:] & lost[:-1]
    assert pairs.mean() == pytest.approx(0.09, abs=0.012)  # independent


def test_coloured_noise_is_of_first_order():
    sensor = Sensor(coloured_noise=0.4, time_constant=0.2)  # at dt = 0.01 s
    clean, y, _ = record(steps=2000, n=20, measurement_noise=0.0, sensor=sensor)
    noise, decay = y - clean, np.exp(-0.01 / 0.2)
    assert noise.mean() == pytest.approx(0.0, abs=0.04)
    assert noise.var() == pytest.approx(0.16, rel=0.1)
    for lag in (1, 20, 40):
        assert (noise[lag:] * noise[:-lag]).mean() / noise.var() == pytest.approx(decay**lag, abs=0.05)
    fresh = noise[1:] - decay * noise[:-1]
    assert fresh.var() == pytest.approx(0.16 * (1 - decay**2), rel=0.02)


def test_each_output_has_its_own():
    sensor = Sensor(bias=[0.0, 5.0], delay=(0, 4), every=[2, 1], saturation=((-9, 0), (9.0, 7.0)))
    clean, y, _ = record(Drifting(), 50, 2, measurement_noise=0.0, sensor=sensor)
    assert np.allclose(y[::2, :, 0], clean[::2, :, 0])
    assert np.isnan(y[1::2, :, 0]).all()
    assert np.allclose(y[4:, :, 1], np.clip(clean[:-4, :, 1] + 5.0, 0.0, 7.0))


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_rows_are_single_environments(mode):
    make = partial(KKLEnv, "lorenz", sensor=ALL, observe="output", start_box=((-1, 1), (-1, 1), (20, 30)))
    vector = KKLVectorEnv("lorenz", 3, sensor=ALL, observe="output", max_episode_steps=40, autoreset_mode=mode,
                          start_box=((-1, 1), (-1, 1), (20, 30)))  # fmt: skip
    sync = SyncVectorEnv([lambda: gym.wrappers.TimeLimit(make(), 40)] * 3, autoreset_mode=mode)
    actions = np.random.default_rng(0).uniform(-1, 1, (100, 3, 1)).astype(np.float32)
    assert compare(vector, sync, actions, mode, infos=("x", "u", "sample"))


def test_motions_and_white_noise_of_a_seed_are_those_without():
    clean, plain, _ = record()
    for sensor in (Sensor(), Sensor(**ALL)):
        same, y, _ = record(sensor=sensor)
        assert np.array_equal(clean, same)
        assert np.array_equal(plain, y) == (sensor == Sensor())


def test_equal_seeds_copies_and_specifications():
    env = gym.make("KKLLorenz-v0", sensor=Sensor(**ALL))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.sensor == env.unwrapped.sensor == Sensor(**ALL)
    for one in (env, again):
        one.reset(seed=3)
    for _ in range(300):
        a, b = (one.step([0.3])[4]["y"] for one in (env, again))
        assert np.array_equal(a, b, equal_nan=True)
    twins = copy.deepcopy(again), pickle.loads(pickle.dumps(again.unwrapped))
    a, b = ([twin.step([0.3])[4]["y"] for _ in range(300)] for twin in twins)
    assert np.array_equal(a, b, equal_nan=True)
    assert identity(env)["kwargs"]["sensor"] == json.loads(json.dumps(ALL))


@pytest.mark.parametrize(("gym_id", "own"), [("KKLLorenz-v0", {}), (kkl_gym.OWN_ID, {"system": Drifting()})])
def test_checkers_are_content(gym_id, own):
    env = gym.make(gym_id, sensor=ALL | {"drop_out": 0.9}, observe="output", **own)
    check_env(env.unwrapped, skip_render_check=True)
    envs = gym.make_vec(gym_id, num_envs=2, sensor=ALL, **own)
    envs.reset(seed=0)
    assert envs.unwrapped.sensor == Sensor(**ALL)


@pytest.mark.parametrize("kind", ["single", "vector"])
def test_the_observer_gets_the_samples_of_the_sensor(kind, saved, make_artifact):
    if kind == "single":
        env = KKLObservation(KKLEnv("van_der_pol", sensor=ALL), saved())
    else:
        env = KKLVectorObservation(KKLVectorEnv("van_der_pol", 3, sensor=ALL), saved())
    observer = KKLObserver(make_artifact("van_der_pol"), 0.5)
    _, info = env.reset(seed=0)
    expected = observer.reset(info["y"])
    gaps = 0
    for k in range(60):
        _, *_, info = env.step(np.full_like(info["u"], np.sin(0.1 * k)))
        gaps += np.isnan(info["y"]).sum()
        expected = observer.step(None if np.isnan(info["y"]).all() else info["y"], info["u"])
        np.testing.assert_allclose(info["x_hat"], expected, rtol=1e-9, atol=1e-9)
    assert gaps > 20


CHANGING = [
    partial(TransformObservation, func=lambda obs: obs + np.float32(0.1), observation_space=None),
    partial(FrameStackObservation, stack_size=2),
    gym.wrappers.NormalizeObservation,
]


class DroppingInPlace(gym.Wrapper):
    """Overwrites observations in place from the third step on."""

    def step(self, action):
        obs, *rest, info = self.env.step(action)
        if info["sample"] == 3:
            obs[0] = 0.0
        return obs, *rest, info


@pytest.mark.parametrize("change", CHANGING)
def test_a_wrapper_inside_that_changes_observations_raises(change, saved):
    inner = change(gym.make("KKLVanDerPol-v0"))
    with pytest.raises(ValueError, match=f"{type(inner).__name__}.*changes observations.*sensor=kkl_gym.Sensor"):
        KKLObservation(RecordEpisodeStatistics(inner), saved()).reset(seed=0)
    outer = change(KKLObservation(gym.make("KKLVanDerPol-v0"), saved()))
    outer.reset(seed=0)
    sync = SyncVectorEnv([lambda: change(gym.make("KKLVanDerPol-v0"))] * 2)
    with pytest.raises(ValueError, match="changes observations"):
        KKLVectorObservation(sync, saved()).reset(seed=0)


def test_a_change_on_the_way_is_noticed_and_other_wrappers_are_not(saved):
    env = KKLObservation(DroppingInPlace(gym.make("KKLVanDerPol-v0")), saved())
    env.reset(seed=0)
    for _ in range(2):
        env.step([0.0])
    with pytest.raises(ValueError, match=r"DroppingInPlace.*changes observations"):
        env.step([0.0])
    quiet = gym.wrappers.TransformReward(RecordEpisodeStatistics(gym.make("KKLVanDerPol-v0")), lambda r: 2.0 * r)
    for inner in (quiet, KKLObservation(quiet, saved(), estimate="z")):  # also around another observer
        env = KKLObservation(inner, saved())
        env.reset(seed=0)
        env.step([0.0])
