"""Minari data sets: a round trip, and data sets of other programs."""

import json

import gymnasium as gym
import pytest

from observers import Artifact
from training.cli import main
from training.records import Signals, read_records
from training.records.episodes import is_dataset, read_dataset, write_dataset
from training.rollouts import make, policy_of, roll_out

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")


@pytest.fixture(autouse=True)
def datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


NAME = "cart/random-v0"


def rollouts(name=NAME, env_id="CartPole-v1", **changes):
    wanted = {"measured": ["0", "cos(2)"], "hidden": ["1"], "steps": 60} | changes
    env = make(env_id)
    return roll_out(env, policy_of("random", env), name=name, **wanted)


def rewrite(folder, change):
    """Change the metadata of a data set in place by ``change``."""
    path = folder / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))


def test_round_trip_of_data_sets(datasets):
    warnings, found = [], rollouts()
    folder = write_dataset(found, policy="random")
    assert folder == datasets / "cart" / "random-v0"
    assert [path.name for path in folder.parent.iterdir() if path.name.startswith(".")] == []
    expected = [record.fingerprint for record in found.records()]
    for name in ("minari:cart/random-v0", folder):
        assert is_dataset(name)
        records = read_records([name], warn=warnings.append)
        assert [record.fingerprint for record in records] == expected
        assert records[0].environment == {"id": "CartPole-v1", "kwargs": {}}
    assert warnings == []
    other = read_records([folder], signals=Signals(measured=("obs[2]",), hidden=("3",)))
    assert other[0].signals.hidden == ("obs[3]",)
    dataset = minari.load_dataset("cart/random-v0")
    assert [len(episode) for episode in dataset] == [len(episode.rewards) for episode in found.episodes]
    assert dataset.recover_environment().spec.id == "CartPole-v1"


def test_dicts_and_infos_are_kept(register):
    class Keyed(gym.Env):
        observation_space = gym.spaces.Dict({"a": gym.spaces.Box(-1, 1, (2,)), "b": gym.spaces.Box(-1, 1, (1,))})
        action_space = gym.spaces.Tuple([gym.spaces.Discrete(2), gym.spaces.Box(-1, 1, (1,))])

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.observation_space.sample(), {"speed": self.np_random.normal(size=2)}

        def step(self, action):
            return self.observation_space.sample(), 0.0, False, False, {"speed": self.np_random.normal(size=2)}

    keyed = register("Keyed-v0", Keyed)
    found = rollouts(env_id=keyed, measured=["a"], hidden=["b", "info[speed][1]"], steps=20)
    write_dataset(found, policy="random")
    assert found.spec.entry_point is Keyed
    read = read_dataset("minari:cart/random-v0", print).records()
    assert read[0].signals.inputs == ("action[0]", "action[1]", "action[2]")
    assert [record.fingerprint for record in read] == [record.fingerprint for record in found.records()]


def test_invalid_data_sets_are_refused():
    with pytest.raises(ValueError, match="minari:none/none-v0 cannot be read"):
        read_records(["minari:none/none-v0"])
    folder = write_dataset(rollouts(), policy="random")
    with pytest.raises(ValueError, match="needs a name such as"):
        write_dataset(rollouts("no name"), policy="random")
    with pytest.raises(ValueError, match="no column of time"):
        read_records([folder], signals=Signals(time="t"))
    for own in (None, {"dt": -1}, {"measured": "01"}):
        rewrite(folder, lambda metadata, own=own: metadata.update(kkl_gym=own))
        with pytest.raises(ValueError, match="cart/random-v0 cannot be read as a Minari data set"):
            read_dataset(f"minari:{NAME}", print)
    (folder / "data" / "main_data.hdf5").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="cannot be read as a Minari data set"):
        read_records([folder])
    rewrite(folder, lambda metadata: metadata.pop("action_space"))
    with pytest.raises(ValueError, match="its spaces are missing"):  # the file's environment is not created
        read_records([folder])


def test_data_sets_of_other_programs():
    folder, heard = write_dataset(rollouts(), policy="random"), []
    rewrite(folder, lambda metadata: [metadata.pop(key) for key in ("kkl_gym", "env_spec")])
    read = read_dataset(folder, heard.append)
    assert (read.dt, read.environment, len(heard)) == (1.0, None, 1)
    assert "has no sampling interval: a step counts as 1 s" in heard[0]
    with pytest.raises(ValueError, match="name the measured entries of the observation"):
        read.records()
    minari.load_dataset(NAME).storage.update_metadata({"kkl_gym": {"dt": 0.02}})
    assert read_dataset(folder, pytest.fail).dt == 0.02


def test_record_and_train(tmp_path, capsys):
    record = ["record", "Pendulum-v1", "--measured", "0,1", "--hidden", "2", "--episodes", "6", "--env-kwargs", "g=9"]
    main(record)
    printed = " ".join(capsys.readouterr().out.split())
    assert "6 episodes of 200 to 200 steps of 0.05 s" in printed
    assert "kkl-gym train NAME --data minari:pendulum-v1/random-v0" in printed
    for wrong, message in ((record, "there is a data set"), ([*record, "--env-kwargs", "g"], None)):
        with pytest.raises(SystemExit, match=message):
            main(wrong)
    train = "train swing --data minari:pendulum-v1/random-v0 --set inverse_steps=9 members=1 width=4 samples=4"
    main([*train.split(), "windows=99", "batch=64", "--out", str(tmp_path / "run")])
    artifact = Artifact.read(tmp_path / "run" / "swing.safetensors")
    assert artifact.environment == {"id": "Pendulum-v1", "kwargs": {"g": 9}}
