"""Observers that are refitted on an agent's own episodes."""

import dataclasses
import sys
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from rollout_observers import observer_of
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import training
from kkl_gym import ActionRepeat, KKLObservation, KKLVectorObservation
from observers import Artifact
from training import KKLTrainingCallback
from training.agents import SB3VecEnv
from training.records import Record, Signals
from training.rollouts import callback as module
from training.rollouts.gathering import LONGEST, Gathering

TINY = {"width": 16, "samples": 10, "windows": 500, "batch": 128}
NET = {"net_arch": [8]}
SIGNALS = {
    "Pendulum-v1": ([0, 1], [2]),
    "MountainCarContinuous-v0": ([0], [1]),
    "CartPole-v1": ([0, 2], [1, 3]),
}


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Observers from few random steps and batches, by the environment."""
    found = {}

    def path_of(env_id):
        if env_id not in found:
            measured, hidden = SIGNALS[env_id]
            folder = tmp_path_factory.mktemp("observer")
            training.learn(
                env_id, measured=measured, hidden=hidden, steps=400, members=1, inverse_steps=20, out=folder, **TINY
            )
            found[env_id] = folder / f"{env_id}.safetensors"
        return found[env_id]

    return path_of


def wrapped(env_id, path, **kwargs):
    return KKLObservation(gym.make(env_id, **kwargs), path)


def vector(env_id, path, n=4, of=DummyVecEnv):
    return make_vec_env(partial(wrapped, env_id, str(path)), n, seed=0, vec_env_cls=of)


def ppo(env, steps=64, **policy):
    batch = steps * getattr(env, "num_envs", 1)
    options = {"n_steps": steps, "batch_size": batch, "n_epochs": 1, "device": "cpu"}
    return PPO("MlpPolicy", env, seed=0, policy_kwargs=NET | policy, **options)


def sac(env, **options):
    return SAC("MlpPolicy", env, seed=0, policy_kwargs=dict(NET), device="cpu", gradient_steps=1, **options)


def in_use(env):
    return [observer.artifact for observer in env.get_attr("observer")]


def test_a_refit_lowers_the_error(learned, tmp_path):
    told, path = [], tmp_path / "newer.safetensors"
    env = vector("Pendulum-v1", learned("Pendulum-v1"))
    first = in_use(env)[0]
    refits = KKLTrainingCallback(1000, first=800, path=path, on_refit=told.append, inverse_steps=200, width=32)
    refits.init_callback(model := ppo(VecNormalize(env, norm_reward=False)))
    assert refits.artifact is first
    model.learn(2100, refits)
    assert in_use(env) == [refits.artifact] * 4
    assert [refit.steps for refit in told] == [1024, 2048]
    assert told[0].taken
    last = [refit for refit in told if refit.taken][-1]  # a second refit may be no better, and is then left alone
    assert last.error < 0.4 * told[0].before
    assert told[-1].artifact is last.artifact is refits.artifact
    assert refits.artifact.training["held_out_errors"]["obs[2]"] == pytest.approx(last.error)
    assert refits.artifact.training["eigenvalues"] == tuple(first.training["eigenvalues"])
    assert Artifact.read(path).training["held_out_errors"] == refits.artifact.training["held_out_errors"]


def test_environments_in_processes_of_their_own(learned, asked):
    env = vector("Pendulum-v1", learned("Pendulum-v1"), n=1, of=SubprocVecEnv)
    try:
        asked.artifact = dataclasses.replace(in_use(env)[0], versions={"of": "the refit"})
        ppo(env, 100).learn(400, KKLTrainingCallback(300))
        assert in_use(env)[0].versions == {"of": "the refit"}
    finally:
        env.close()
    assert [len(record.t) for record in asked.found[0]] == [201]  # the second is held out


@pytest.mark.parametrize("env_id", ["MountainCarContinuous-v0", "CartPole-v1"])
def test_other_algorithms_and_discrete_actions(learned, env_id, capsys):
    env = vector(env_id, learned(env_id), n=1 if env_id[0] == "M" else 2)
    refits = KKLTrainingCallback(600, verbose=1, inverse_steps=100)
    if env_id == "CartPole-v1":
        ppo(env).learn(1400, refits)
    else:
        sac(env, train_freq=200).learn(1300, refits)
    assert in_use(env) == [refits.artifact] * env.num_envs
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert "refitted the observer at step 6" in lines[0]


class Spy(gym.Env):
    """It shows what acted on it. Episodes end after seven steps."""

    observation_space = spaces.Box(-99.0, 99.0, (2,))
    action_space = spaces.Box(np.float32([-1.0]), np.float32([3.0]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.float32([self.np_random.uniform(50, 60), -50]), {}

    def step(self, action):
        self.steps += 1
        return np.float32([self.steps, action[0]]), 0.0, self.steps == 7, False, {}


@pytest.fixture
def spy(tmp_path):
    gym.register("Spy-v0", entry_point=Spy, disable_env_checker=True)
    recorded = {"pipeline": "recorded", "eigenvalues": [-1.0, -2.0, -4.0], "dt": 1.0, "measurement_noise_max": 0.1}
    artifact = observer_of("Spy-v0", ["obs[0]"], ["obs[1]"], ["action[0]"])
    artifact = dataclasses.replace(artifact, training={**recorded, "eigenvalues": [-0.3, -1.0, -3.0], "held_out": 0.5})
    artifact.save(tmp_path / "spy.safetensors")
    yield tmp_path / "spy.safetensors"
    gym.registry.pop("Spy-v0")


@pytest.fixture
def asked(monkeypatch):
    """Records that observers would be fitted to, by the refit; none is fitted."""
    found = []

    def train(records, config, folder, *, name):
        torch.manual_seed(0)
        found.append(list(records))
        return SimpleNamespace(artifact=train.artifact)

    monkeypatch.setattr(module, "train_recorded", train)
    monkeypatch.setattr(module, "settling_time", lambda linear: 5.0)
    train.found = found
    return train


def check_spied(records):
    """Inputs lead from sample to sample: what acted is what the next sample shows."""
    for record in records:
        np.testing.assert_allclose(record.u[:-1, 0], (record.x[1:, 0] - 1.0) / 2.0, atol=1e-6)
        assert (record.y[0, 0] >= 50) == (record.x[0, 0] == -50)
        assert (record.y[1:, 0] < 50).all()
        assert np.diff(record.y[1:, 0]).tolist() == [1.0] * (len(record.t) - 2)


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "sac with noise"])
def test_actions_are_those_that_acted(spy, asked, algorithm):
    env = vector("Spy-v0", spy, n=2 if algorithm == "ppo" else 1)
    asked.artifact = in_use(env)[0]
    noise = NormalActionNoise(np.zeros(1), np.ones(1)) if algorithm == "sac with noise" else None
    model = (
        ppo(VecNormalize(env), 50, log_std_init=1.5)
        if algorithm == "ppo"
        else sac(env, learning_starts=20, action_noise=noise, train_freq=50)
    )
    model.learn(250, KKLTrainingCallback(100))
    assert len(asked.found) == 2
    records = asked.found[-1]
    check_spied(records)
    assert len(records) == pytest.approx(0.5 * 200 / 7, abs=4)
    assert sum(record.y[0, 0] >= 50 for record in records) >= len(records) - 3  # they begin with their resets
    u = np.concatenate([record.u for record in records])
    assert u.min() < -0.5
    assert u.max() > 0.5
    if algorithm == "ppo":  # cut at the bounds
        assert abs(u).max() == 1.0


def test_vectors_of_gymnasium(spy, asked):
    envs = gym.make_vec(
        "Spy-v0", 3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    )
    envs = KKLVectorObservation(envs, spy)
    new = asked.artifact = dataclasses.replace(envs.observer.artifact, measurement_noise=0.0)
    refits = KKLTrainingCallback(100)
    ppo(SB3VecEnv(envs, info_keys=("y", "u", "x", "sample")), 50).learn(200, refits)
    check_spied(asked.found[0])
    assert {record.y[0, 0] for record in asked.found[0]} <= {1.0, 50.0}  # resets are not passed on
    assert envs.observer.artifact == refits.artifact
    assert refits.artifact.filter is new.filter
    with pytest.raises(ValueError, match=r"has no 'y', 'u', 'x', 'sample'.*info_keys"):
        ppo(SB3VecEnv(envs), 50).learn(200, KKLTrainingCallback(100))
    with pytest.raises(ValueError, match=r"observers of kkl_gym\.KKLObservation, and the environment has none"):
        ppo(SB3VecEnv(envs.env), 50).learn(200, KKLTrainingCallback(100))


def test_a_training_that_goes_on(spy, asked):
    env = vector("Spy-v0", spy, n=1)
    asked.artifact = in_use(env)[0]
    refits = KKLTrainingCallback(100)
    model = ppo(env, 50)
    for _ in range(5):  # in the middle of an episode
        model.learn(50, refits, reset_num_timesteps=False)
    check_spied(asked.found[-1])
    assert len(asked.found) == 2


def test_a_rehearsal_is_played_as_the_agent_will_act(spy, asked, monkeypatch):
    env = VecNormalize(vector("Spy-v0", spy, n=2))
    asked.artifact, told = in_use(env)[0], []
    model = ppo(env, 50, log_std_init=1.5)
    refits = KKLTrainingCallback(100, keep=30, rehearsal=30, on_refit=told.append)
    predict, acted = model.predict, []

    def noted(*given, **options):
        actions, state = predict(*given, **options)
        acted.extend(np.clip(actions, -1.0, 3.0))
        return actions, state

    monkeypatch.setattr(model, "predict", noted)
    for _ in range(2):  # the second begins in new episodes
        seen = env.obs_rms.count
        model.learn(200, refits, reset_num_timesteps=False)
        assert env.obs_rms.count == seen + 202  # with those of the reset, and none of the rehearsal
        assert env.training
        records = [record for record in asked.found[-1] if record.y[0, 0] >= 50]
        check_spied(records)
        played = [round(float(u), 5) for u in np.ravel(acted)]
        assert {round(float(u), 5) for record in records for u in record.u[:-1, 0] * 2 + 1} <= {*played}
    assert [refit.steps for refit in told] == [100, 230, 330, 460]
    assert len(acted) == 60


def test_episodes_from_before_are_fitted_to_as_well(spy, asked):
    env = vector("Spy-v0", spy, n=1)
    asked.artifact = in_use(env)[0]
    ppo(env, 50).learn(100, KKLTrainingCallback(50, held_out=0.0))
    before = [dataclasses.replace(record, name=f"before {i}") for i, record in enumerate(asked.found[0])]
    given, lengths = asked.found, [len(record.t) - 1 for record in before]
    given.clear()
    ppo(env, 50).learn(100, KKLTrainingCallback(50, records=before))
    assert [record.name for record in given[0] if "before" in record.name] == [record.name for record in before]
    assert len(given[0]) > len(before)
    given.clear()
    told = []
    refits = KKLTrainingCallback(50, records=before, keep=sum(lengths) + 75, on_refit=told.append)
    ppo(env, 50).learn(150, refits)  # of those from before the oldest are forgotten
    assert 0 < sum("before" in record.name for record in given[-1]) < len(before)
    assert given[-1][0].name != before[0].name
    assert [refit.steps for refit in told] == [50, 100]  # without those from before


def test_what_comes_from_before_is_brought_to_the_observers_form(spy):
    artifact = Artifact.read(spy)
    before = Record(
        "slow",
        2.0 * np.arange(400.0),
        np.stack([np.arange(400.0)], -1),
        np.zeros((400, 1)),
        np.stack([np.arange(400.0)], -1),
        Signals("seconds", ("obs[0]",), ("action[0]",), ("obs[1]",)),
        environment=artifact.environment,
    )
    train, held_out = Gathering(artifact, keep=10**6, held_out=0.5, before=[before]).records()
    assert not held_out
    assert [len(piece.t) for piece in train] == [LONGEST + 1, LONGEST + 1, LONGEST + 1, 799 - 3 * LONGEST]
    np.testing.assert_allclose(np.concatenate([piece.y[:-1, 0] for piece in train]), np.arange(0, 399, 0.5))
    without = observer_of("Spy-v0", ["obs[0]"], ["obs[1]"], [])
    (piece, *_), _ = Gathering(without, keep=10**6, held_out=0.5, before=[before]).records()
    assert piece.u is None
    assert piece.signals.inputs == ()


@pytest.mark.parametrize(("memory", "times"), [(7.0, 2), (8.0, 0)])
def test_a_refit_is_judged_by_the_agents_own_episodes(spy, asked, monkeypatch, memory, times):
    """While none that is held out is long enough, records from before are no reason for a refit."""
    env = vector("Spy-v0", spy, n=1)
    asked.artifact = in_use(env)[0]
    record = Record(
        "long",
        np.arange(100.0),
        np.zeros((100, 1)),
        np.zeros((100, 1)),
        np.zeros((100, 1)),
        Signals("t", ("obs[0]",), ("action[0]",), ("obs[1]",)),
        environment=asked.artifact.environment,
    )
    monkeypatch.setattr(module, "settling_time", lambda linear: memory)
    ppo(env, 50).learn(150, KKLTrainingCallback(50, records=[record]))
    assert len(asked.found) == times


def test_episodes_from_before_must_be_of_the_plant(spy, asked):
    env = vector("Spy-v0", spy, n=1)
    asked.artifact = in_use(env)[0]
    ppo(env, 50).learn(100, KKLTrainingCallback(50, held_out=0.0))
    record = asked.found[0][0]
    signals = dataclasses.replace(record.signals, measured=("obs[1]",), hidden=("obs[0]",))
    for bad, says in [
        (dataclasses.replace(record, signals=signals), r"measured are obs\[1\], but the observer's obs\[0\]"),
        (dataclasses.replace(record, x=None), "no hidden states"),
        (dataclasses.replace(record, environment={**record.environment, "id": "Other-v0"}), "Other-v0"),
    ]:
        with pytest.raises(ValueError, match=says):
            ppo(env, 50).learn(100, KKLTrainingCallback(50, records=[bad]))
    fast = dataclasses.replace(record, t=1e-3 * record.t)
    with pytest.raises(ValueError, match="do not fit dt = 1 s"):
        ppo(env, 50).learn(100, KKLTrainingCallback(50, records=[fast]))


@pytest.mark.parametrize("bad", [None, "minari:a/b-v0", 3, [1], ["a"], {"a": 1}])
def test_records_are_records(bad):
    with pytest.raises(ValueError, match=r"records must be a list of training\.records\.Record, got"):
        KKLTrainingCallback(records=bad)


def test_the_agent_keeps_its_random_numbers(spy, asked):
    env = vector("Spy-v0", spy, n=1)
    asked.artifact = in_use(env)[0]
    states = []
    refits = KKLTrainingCallback(100, on_refit=lambda refit: states.append(torch.get_rng_state()))
    refit = refits._refit
    refits._refit = lambda *records: states.append(torch.get_rng_state()) or refit(*records)
    ppo(env, 50).learn(150, refits)
    before, after = states
    assert torch.equal(before, after)


def test_a_worse_observer_is_not_taken(learned, asked):
    env = vector("Pendulum-v1", learned("Pendulum-v1"), n=1)
    old, told = in_use(env)[0], []
    asked.artifact = dataclasses.replace(
        old, inverse=dataclasses.replace(old.inverse, x_offset=old.inverse.x_offset + 99.0)
    )
    refits = KKLTrainingCallback(600, on_refit=told.append)
    ppo(env, 100).learn(900, refits)
    assert not told[0].taken
    assert told[0].error == told[0].before
    assert "error still" in str(told[0])
    assert in_use(env) == [refits.artifact] == [old]


def test_episodes_that_are_shorter_than_the_memory(spy, asked, monkeypatch):
    env = vector("Spy-v0", spy, n=1)
    asked.artifact = in_use(env)[0]
    monkeypatch.setattr(module, "settling_time", lambda linear: 7.5)
    ppo(env, 50).learn(250, KKLTrainingCallback(100))
    assert not asked.found


def hiding(path):
    env = gym.make("Pendulum-v1")
    return KKLObservation(
        gym.wrappers.TransformObservation(env, lambda obs: obs[:2], spaces.Box(-1.0, 1.0, (2,))), path
    )


def test_environments_that_are_refused(learned, tmp_path):
    path = learned("Pendulum-v1")
    plain = dataclasses.replace(Artifact.read(path), training={})
    plain.save(tmp_path / "plain.safetensors")
    noise = DummyVecEnv([partial(KKLObservation, gym.make("Pendulum-v1"), path, measurement_noise=0.05)])
    other = dataclasses.replace(plain, signals=plain.signals | {"hidden": ["sin(obs[2])"]})
    other.save(tmp_path / "other.safetensors")
    two = DummyVecEnv([partial(wrapped, "Pendulum-v1", path)] * 2)
    two.envs[1] = wrapped("Pendulum-v1", tmp_path / "other.safetensors")
    for env, settings, told in (
        (gym.make("Pendulum-v1"), {}, r"the environment has none: put KKLObservation"),
        (KKLObservation(gym.make("KKLVanDerPol-v0")), {}, "was not learned from rollouts"),
        (wrapped("Pendulum-v1", tmp_path / "plain.safetensors"), {}, "was not learned from rollouts"),
        (hiding(path), {}, r"environment 0 has no 'x': KKLObservation tells the true obs\[2\] as 'x'"),
        (ActionRepeat(wrapped("Pendulum-v1", path), 2), {}, "showed sample 4 after 2: put wrappers that skip"),
        (noise, {"measurement_noise_max": 0.01}, r"measurement_noise_max = 0\.01 is less than the noise 0\.05"),
        (two, {}, "has signals"),
        (wrapped("Pendulum-v1", path), {"width": -1}, "width"),
    ):
        with pytest.raises(ValueError, match=told):
            ppo(env, 10).learn(20, KKLTrainingCallback(100, **settings))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"every": 0}, "every must be"),
        ({"every": 10.5}, "every must be"),
        ({"first": 0}, "first must be"),
        ({"keep": None}, "keep must be"),
        ({"path": "observer.zip"}, "path must end in"),
        ({"path": 3}, "path must end in"),
        ({"on_refit": 3}, "on_refit must be a function"),
        ({"eigenvalues": (-1.0,), "dt": 0.1}, "eigenvalues, dt cannot change"),
        ({"neurons": 3}, "there is no setting neurons; there are measurement_noise_max"),
    ],
)
def test_arguments_that_make_no_sense(arguments, told):
    with pytest.raises(ValueError, match=told):
        KKLTrainingCallback(**arguments)


def sample(k, **changes):
    return {"y": np.array([float(k)]), "u": np.array([0.1 * k]), "x": np.array([-float(k)]), "sample": k} | changes


def test_episodes_are_cut_and_the_oldest_are_forgotten(spy):
    gathering = Gathering(Artifact.read(spy), keep=2 * LONGEST, held_out=0.0)
    gathering.begin(0, {"y": np.zeros(1)})
    for k in range(1, 3 * LONGEST + 3):
        gathering.add(0, sample(k))
    records, held_out = gathering.records()
    assert gathering.steps == 3 * LONGEST + 2
    assert not held_out
    assert [len(record.t) - 1 for record in records] == [LONGEST, 2]  # a third would be more than are kept
    assert records[0].y[0, 0] == 2 * LONGEST  # the next piece begins with the last sample
    assert records[1].y[0, 0] == 3 * LONGEST == records[0].y[-1, 0]
    np.testing.assert_allclose(records[0].u[:-1, 0], 0.1 * records[0].y[1:, 0])
    gathering.add(0, sample(3 * LONGEST + 3))
    assert len(gathering.records()[0][-1].t) == 2


def test_pieces_have_their_role_for_good(spy):
    gathering = Gathering(Artifact.read(spy), keep=10_000, held_out=0.2)
    roles = {}
    for episode in range(20):
        gathering.begin(0, sample(0))
        gathering.add(0, sample(1))
        gathering.add(0, sample(2))
        for held, records in enumerate(gathering.records()):
            for record in records:
                assert roles.setdefault(record.name, held) == held
        assert len(roles) == episode + 1
    assert sum(roles.values()) == 4
    assert roles["Spy-v0, piece 1"] == 1


def test_needs_stable_baselines3(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("stable_baselines3")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "training.rollouts.callback")
    with pytest.raises(ModuleNotFoundError, match=r'KKLTrainingCallback needs pip install "kkl-gym\[agents\]"'):
        training.KKLTrainingCallback  # noqa: B018
