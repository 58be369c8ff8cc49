import dataclasses
import json

import gymnasium as gym
import linear_system
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv

from kkl_gym import ENV_IDS, ActionRepeat, KKLEnv, KKLObservation, KKLVectorEnv, KKLVectorObservation
from observers import Artifact, ArtifactError, KKLObserver, load

checking_wrapped = pytest.mark.filterwarnings(
    "ignore:.*(is different from the unwrapped version|observation space m..imum value is -?infinity)"
)


def actions(steps, nu=1, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, nu)).astype(np.float32)


def wrapped(saved, name, estimate="x", env=None, **options):
    wrappers = ("ignore_input", "measurement_noise", "known_start")
    kept = {key: options.pop(key) for key in wrappers if key in options}
    env = gym.make(ENV_IDS[name], **(env or {}))
    return KKLObservation(env, saved(system=name, **options), estimate=estimate, **kept)


@pytest.mark.parametrize(
    ("name", "estimate", "options"),
    [
        ("lorenz", "x", {}),
        ("van_der_pol", "z", {"env": {"observe": "output"}}),
        ("rossler", "x", {"forward": True, "known_start": True}),
        ("lorenz", "z", {"forward": True, "known_start": True}),
    ],
)
@checking_wrapped
def test_checkers_are_content(name, estimate, options, saved):
    env = wrapped(saved, name, estimate, **options)
    for each in (env, ActionRepeat(env, 4), ActionRepeat(env.env, 4)):
        check_env(each, skip_render_check=True)
    assert env.observation_space.shape == ((env.unwrapped.system.nx,) if estimate == "x" else env.observer.z.shape)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    for each in (env, ActionRepeat(env, 4)):
        sb3.check_env(each)


@pytest.mark.parametrize(("name", "noise", "inputs"), [("lorenz", 0.5, True), ("rossler", 0.0, False)])
def test_estimates_are_timed_as_the_observers(name, noise, inputs, saved, make_artifact):
    """The wrapper's x_hat, from y_k+1 and u_k, equals that of a bare observer with y and u from the infos."""
    env = wrapped(saved, name, env={"measurement_noise": noise}, inputs=inputs, ignore_input=True)
    bare, space = KKLObserver(make_artifact(name, inputs=inputs), noise), env.unwrapped.plant.state_space
    obs, info = env.reset(seed=1)
    infos, x_hat = [info], bare.reset(info["y"])
    for action in actions(60):
        assert np.array_equal(info["x_hat"], x_hat)
        assert np.array_equal(info["z"], bare.z)
        assert np.array_equal(obs, np.clip(x_hat, space.low, space.high).astype(np.float32))
        obs, _, _, _, info = env.step(2 * action)  # the environment clips some inputs
        infos.append(info)
        x_hat = bare.step(info["y"], info["u"] if inputs else None)
    y, found = (np.array([info[key] for info in infos]) for key in ("y", "x_hat"))
    u = np.array([info["u"] for info in infos[1:]]) if inputs else None
    assert np.allclose(bare.estimate(y, u), found, rtol=1e-5, atol=1e-4)
    if inputs:
        assert not np.allclose(bare.estimate(y, np.roll(u, 1, 0)), found, rtol=1e-3)  # shifted by one sample


@pytest.mark.parametrize("estimate", ["x", "z"])
def test_a_known_start_is_used_at_every_reset_and_no_other_state(estimate, saved):
    env = wrapped(saved, "lorenz", estimate, forward=True, known_start=True)
    bare = KKLObserver(env.observer.artifact)
    for options in (None, {"x0": [1.0, -2.0, 20.0]}):
        obs, info = env.reset(seed=1, options=options)
        bare.reset(info["y"], info["x"])
        assert np.array_equal(info["z"], bare.z)
        for action in actions(5):
            shown = info["z"] if estimate == "z" else bare.decode()
            space = env.observation_space
            assert np.array_equal(obs, np.clip(shown, space.low, space.high).astype(np.float32))
            obs, *_, info = env.step(action)
            bare.advance(info["y"], info["u"])
            assert np.array_equal(info["z"], bare.z)


def test_known_starts_need_a_map_with_a_motion_or_T(saved):
    for kind, env in ((KKLObservation, KKLEnv("lorenz")), (KKLVectorObservation, KKLVectorEnv("lorenz", 2))):
        with pytest.raises(ArtifactError, match="'lorenz' cannot start at a known state"):
            kind(env, saved(system="lorenz"), known_start=True)


def test_wrappers_that_show_z_track_only_for_a_monitor_or_a_known_start():
    def tracks(**options):
        env = KKLObservation(KKLEnv("lorenz"), **options)
        env.reset(seed=0)
        return env.observer.tracking

    assert tracks()
    assert not tracks(estimate="z")
    assert tracks(estimate="z", monitor=True)
    assert tracks(estimate="z", known_start=True)


def test_wrappers_do_not_change_the_environment(saved):
    bare, env = gym.make("KKLRossler-v0"), wrapped(saved, "rossler")
    x0, x1 = bare.reset(seed=2)[1]["x"], env.reset(seed=2)[1]["x"]
    assert np.array_equal(x0, x1)
    for action in actions(20):
        *_, r0, _, _, i0 = bare.step(action)
        *_, r1, _, _, i1 = env.step(action)
        assert r0 == r1
        assert {*i1} - {*i0} == {"x_hat", "z"}
        assert all(np.array_equal(i0[key], i1[key]) for key in i0)


@pytest.mark.parametrize(("estimate", "known_start"), [("x", True), ("z", False)])
def test_spec_round_trip(estimate, known_start, saved):
    env = KKLObservation(
        gym.make("KKLLorenz-v0", measurement_noise=0.2, max_episode_steps=40),
        saved(system="lorenz", forward=True, inputs=False),
        estimate=estimate,
        measurement_noise=0.4,
        known_start=known_start,
        ignore_input=True,
    )
    env = ActionRepeat(env, 5)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(again.spec.to_json()) == json.loads(env.spec.to_json())
    assert again.repeat == 5
    assert again.env.observer.measurement_noise == 0.4
    assert again.observation_space == env.observation_space
    assert np.array_equal(env.reset(seed=1)[0], again.reset(seed=1)[0])
    for action in actions(5):
        assert np.array_equal(env.step(action)[0], again.step(action)[0])


def test_each_output_has_its_level(make_artifact, tmp_path):
    system, path = f"{linear_system.__file__}:TwoOutputs", str(tmp_path / "two.safetensors")
    dataclasses.replace(make_artifact(outputs=2), system="two-outputs", parameters={}).save(path)
    plain = gym.make("kkl_gym:kkl_gym/Own-v0", system=system)
    assert KKLObservation(plain, path).observer.measurement_noise == (0.1, 0.3)  # the level of the environment
    env = KKLObservation(plain, path, measurement_noise=np.array([0.2, 0.4]))
    for again in (env, gym.make(EnvSpec.from_json(env.spec.to_json()))):
        assert again.observer.measurement_noise == (0.2, 0.4)
        again.reset(seed=0)
        again.step(again.action_space.sample())
    many = KKLVectorEnv(system, 3, measurement_noise=(0.2, 0.4))
    assert KKLVectorObservation(many, path).observer.measurement_noise == (0.2, 0.4)
    assert KKLVectorObservation(many, path, measurement_noise=(0.1, 0.4)).observer.measurement_noise == (0.1, 0.4)


def test_the_default_observer_is_the_systems():
    env = KKLObservation(KKLEnv("van_der_pol", measurement_noise=0.7, process_noise=0.02))
    observer, shipped = env.get_wrapper_attr("observer"), load("van_der_pol").artifact
    assert observer.artifact.training == shipped.training
    assert (observer.measurement_noise, observer.process_noise) == (0.7, 0.02)


@pytest.mark.parametrize("level", [None, 0.15])
def test_the_map_gets_the_environments_process_noise(saved, level):
    path = saved(process=True)
    env = KKLObservation(KKLEnv("van_der_pol", process_noise=level), path)
    many = KKLVectorObservation(KKLVectorEnv("van_der_pol", 2, process_noise=level), path)
    right, wrong = (
        KKLObserver(Artifact.read(path), 0.5, process_noise=noise) for noise in (0.05 if level is None else level, 0.01)
    )
    _, info = env.reset(seed=0)
    assert np.array_equal(info["x_hat"], right.reset(info["y"]))
    assert not np.allclose(info["x_hat"], wrong.reset(info["y"]))
    assert np.allclose(many.reset(seed=0)[1]["x_hat"][0], info["x_hat"], atol=1e-6)


def test_vectors_that_differ_in_process_noise(saved):
    path = saved(process=True)
    mixed = SyncVectorEnv([lambda level=level: KKLEnv("van_der_pol", process_noise=level) for level in (0.0, 0.1)])
    with pytest.raises(ValueError, match=r"differ in process_noise, 0\.0 and 0\.1"):
        KKLVectorObservation(mixed, path)
    silent = KKLVectorObservation(mixed, saved())  # a map without this feature
    before = silent.observer.artifact
    assert silent.observer.process_noise == 0.0
    with pytest.raises(ValueError, match="differ in process_noise"):
        silent.replace_observer(path)
    assert silent.observer.artifact is before


def test_action_repeat_sums_rewards(saved):
    slow, fast = ActionRepeat(wrapped(saved, "lorenz"), 7), wrapped(saved, "lorenz")
    slow.reset(seed=0), fast.reset(seed=0)
    for action in actions(5):
        obs, reward, _, _, info = slow.step(action)
        steps = [fast.step(action) for _ in range(7)]
        assert reward == pytest.approx(sum(step[1] for step in steps), rel=1e-12)
        assert type(reward) is float
        assert np.array_equal(obs, steps[-1][0])
        for key in ("x", "y", "u", "x_hat", "z"):  # every sample reached the observer
            assert np.array_equal(info[key], steps[-1][-1][key])


def test_render_shows_the_estimate_and_the_input(saved):
    pytest.importorskip("matplotlib")
    env = wrapped(saved, "van_der_pol", env={"render_mode": "rgb_array"})
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros(1, np.float32))
    still = env.render()
    assert still.shape == (480, 480, 3)
    assert (still != env.unwrapped.render()).any()
    assert (env.render() == still).all()
    env.step(np.ones(1, np.float32))
    assert (env.render()[430:460] != still[430:460]).any()  # the bar that shows the input
