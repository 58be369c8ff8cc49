import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import training
from kkl_gym import KKLObservation
from observers import Artifact
from training import recorded_preset
from training.records import Signals, check_signals, resampled
from training.rollouts import make, policy_of, roll_out
from training.rollouts.playing import Recorder

TINY = {"inverse_steps": 20, "members": 1, "width": 8, "samples": 5, "windows": 200, "batch": 64}


class Drift(gym.Env):
    """A position in a Dict, driven by the input; info has the speed except at resets. Episodes end beyond 3."""

    observation_space = spaces.Dict({"place": spaces.Box(-9.0, 9.0, (1,)), "goal": spaces.Discrete(2)})
    action_space = spaces.Discrete(3, start=-1)
    dt = 0.1

    def __init__(self, text=False):
        self.text = text

    def _seen(self):
        return {"place": np.float32([self.place]), "goal": 1}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = float(self.np_random.uniform(-1, 1))
        return self._seen(), {}

    def step(self, action):
        self.place += 0.5 * float(action)
        speed = "fast" if self.text else 0.5 * float(action)
        return self._seen(), 0.0, abs(self.place) > 3, False, {"speed": speed}


@pytest.fixture
def drift(register):
    return register("Drift-v0", Drift, max_episode_steps=30)


def played(env, **changes):
    wanted = {"measured": ["place"], "hidden": ["info[speed]"], "steps": 100, "seed": 3} | changes
    return roll_out(env, policy_of(wanted.pop("policy", "random"), env), **wanted)


def test_inputs_lead_from_each_sample_to_the_next(drift):
    rollouts = played(make(drift))
    records = rollouts.records()
    assert sum(len(episode.rewards) for episode in rollouts.episodes) == 100
    assert len({len(record.t) for record in records}) > 1  # episodes of different lengths
    for record, episode in zip(records, rollouts.episodes):
        assert record.signals == Signals("t", ("place",), ("action[0]", "action[1]", "action[2]"), ("info[speed]",))
        push = record.u @ [-0.5, 0.0, 0.5]
        np.testing.assert_allclose(np.diff(record.y[:, 0]), push[:-1], atol=1e-6)
        np.testing.assert_array_equal(record.u[-1], record.u[-2])
        assert np.isnan(record.x[0, 0])  # the info of a reset has no speed
        np.testing.assert_allclose(record.x[1:, 0], push[:-1])
        np.testing.assert_allclose(np.diff(record.t), 0.1)
        assert episode.terminated == (abs(record.y[-1, 0]) > 3)
        assert record.environment == {"id": "Drift-v0", "kwargs": {}}
        np.testing.assert_allclose(resampled(record, 0.1).u[:-1], record.u[:-1], atol=1e-12)


def test_the_same_seed_plays_the_same_until_episodes_or_steps_are_played(drift):
    one, same, other = (played(make(drift), seed=seed).records() for seed in (1, 1, 2))
    assert [record.fingerprint for record in one] == [record.fingerprint for record in same]
    assert one[0].fingerprint != other[0].fingerprint
    counts = []
    rollouts = played(make(drift), hidden=[], episodes=4, steps=None, report=counts.append)
    assert counts == [1, 2, 3, 4] == list(range(1, len(rollouts.episodes) + 1))
    assert rollouts.records()[0].x is None


def test_invalid_signals_and_amounts_are_refused(drift):
    for changes, message in (
        ({"measured": ["far"]}, r"contains 'far', but an observation of Drift-v0 holds goal\[0\], goal\[1\], place;"),
        ({"measured": []}, "name the measured entries of the observation"),
        ({"measured": ["info[speed]"]}, r"episode 0: info\[speed\] is missing after the reset"),
        ({"hidden": ["info[height]"]}, "info has no 'height'"),
        ({"steps": None}, "give the amount to record"),
    ):
        with pytest.raises(ValueError, match=message):
            played(make(drift), **changes)


def test_environments_that_are_refused(drift, register):
    class Picture(gym.Env):
        observation_space, action_space = spaces.Box(0, 255, (8, 8, 3), np.uint8), spaces.MultiBinary(2)

    register("Picture-v0", Picture)
    for env_id, options, message, names in (
        ("None-v0", {}, "cannot make 'None-v0'", {}),
        ("Drift-v0", {"text": True}, r"info\[speed\] is not a number", {}),
        ("Picture-v0", {}, r"is an image.*encoder", {"measured": ["0"], "hidden": ["1"]}),
    ):
        with pytest.raises(ValueError, match=message):
            played(make(env_id, options), **names)


def test_arrays_that_are_written_over_are_kept_as_they_were(register):
    class Reusing(gym.Env):
        observation_space, action_space = spaces.Box(-np.inf, np.inf, (1,)), spaces.Box(-1.0, 1.0, (1,))
        seen, info = np.zeros(1, np.float32), {"twice": np.zeros(1)}

        def reset(self, **_):
            return self.seen, self.info

        def step(self, action):
            for array, change in ((self.seen, 1), (self.info["twice"], 2), (action, -action)):
                array += change
            return self.seen, 0.0, False, False, self.info

    env = make(register("Reusing-v0", Reusing))
    (record,) = roll_out(env, lambda seen: seen / 10, measured=[0], hidden=["info[twice]"], steps=4).records()
    assert (record.y[:, 0].tolist(), record.x[:, 0].tolist()) == ([0, 1, 2, 3, 4], [0, 2, 4, 6, 8])
    np.testing.assert_allclose(record.u[:4, 0], [0, 0.1, 0.2, 0.3], rtol=1e-6)


def test_policies_are_functions_or_agents_of_stable_baselines3(tmp_path, drift):
    sb3 = pytest.importorskip("stable_baselines3")
    (tmp_path / "mine.py").write_text("def right(observation):\n    return 1\n")
    right = policy_of(f"{tmp_path}/mine.py:right", make(drift))
    assert all((np.diff(record.y[:, 0]) > 0.4).all() for record in played(make(drift), policy=right).records())
    env, path = make("CartPole-v1"), tmp_path / "agent.zip"
    assert policy_of(right, env) is right
    sb3.PPO("MlpPolicy", env, device="cpu", n_steps=16, batch_size=16, seed=0).save(path)
    policy = policy_of(f"ppo:{path}", env)
    assert roll_out(env, policy, measured=["0"], hidden=["1"], episodes=1).episodes[0].actions.shape[0] > 3
    for wrong, env_id, message in (
        (f"ppo:{path}", "Pendulum-v1", "Observation spaces do not match"),
        (f"clever:{path}", "CartPole-v1", "'clever' is not an algorithm"),
        ("ppo:none.zip", "CartPole-v1", "there is no file"),
        (3, "CartPole-v1", "a policy is random"),
        ("none.py:right", "CartPole-v1", "cannot load"),
    ):
        with pytest.raises(ValueError, match=message):
            policy_of(wrong, make(env_id))


def test_modes_follow_steps_and_the_length_of_episodes(drift):
    for env, n, slowest, dt in (("Pendulum-v1", 200, 0.2, 0.05), (drift, 8, 1.0, 0.1)):
        names = {"hidden": ["2"], "measured": ["0"]} if n == 200 else {}
        config = recorded_preset(played(make(env), steps=n, **names).records())
        assert config.dt == pytest.approx(dt)
        rates = -np.array(config.eigenvalues) * dt
        assert rates[[0, -1]] == pytest.approx([slowest, 4.0])


def test_records_that_nothing_is_learned_from(drift):
    records = played(make(drift)).records()
    with pytest.raises(ValueError, match=r"goal\[0\], goal\[1\] never changes: leave it out"):
        recorded_preset(played(make(drift), measured=["place", "goal"]).records())
    other = dataclasses.replace(records[0], environment={"id": "Drift-v0", "kwargs": {"text": False}})
    with pytest.raises(ValueError, match=r"with arguments {'text': False}, but .* with arguments {}: an observer"):
        check_signals([records[0], other])


def test_learns_an_observer_that_fits_the_environment(tmp_path):
    artifact = training.learn(
        "Pendulum-v1", measured=[0, 1], hidden=[2], episodes=6, env_kwargs={"g": 9.0}, out=tmp_path, **TINY
    )
    assert artifact.environment == {"id": "Pendulum-v1", "kwargs": {"g": 9.0}}
    assert artifact.training["held_out_errors"]["obs[2]"] > 0
    assert list(artifact.training["records"]) == ["Pendulum-v1"]
    path = tmp_path / "Pendulum-v1.safetensors"
    assert Artifact.read(path).signals["measured"] == ["obs[0]", "obs[1]"]
    env = KKLObservation(gym.make("Pendulum-v1", g=9.0), path)
    assert env.reset(seed=0)[0].shape == (3,)


def test_an_interval_that_is_not_the_environments():
    with pytest.raises(ValueError, match=r"dt = 0\.5 s: CartPole-v1 shows a sample every 1 s; leave dt out"):
        training.learn("CartPole-v1", measured=[0], hidden=[1], steps=60, dt=0.5)


def test_invalid_arguments_are_refused_before_any_step(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "inverse-1.checkpoint.safetensors").touch()
    wanted = {"measured": [0, 1], "hidden": [2], "policy": lambda seen: pytest.fail("played")}
    for changes, message in (
        ({"hidden": []}, "name the hidden signals"),
        ({"inverse_stepz": 3}, "inverse_stepz"),
        ({"width": -1}, "width"),
        ({"out": "used"}, "holds the checkpoints of a run"),
    ):
        with pytest.raises(ValueError, match=message):
            training.learn("Pendulum-v1", **wanted | changes)


def test_rollouts_that_were_handed_out_stay_as_they_are():
    recorder = Recorder(gym.make("CartPole-v1"), measured=["0"], hidden=["1"])
    for _ in range(2):  # a reset alone is not an episode
        recorder.reset(seed=0)
    recorder.step(0)
    found = recorder.rollouts()
    with pytest.raises(RuntimeError, match="reset the environment"):
        recorder.step(0)
    recorder.reset()
    recorder.step(1)
    assert [len(rollouts.episodes) for rollouts in (found, recorder.rollouts())] == [1, 2]
