import dataclasses
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

import observers.artifact
from kkl_gym import SYSTEMS, get_system
from observers import MLP, Artifact, ArtifactError, KKLObserver, load, shipped

KINDS = [
    {},
    {"inputs": False},
    {"noise": False, "age": False},
    {"inputs": False, "noise": False, "age": False},
    {"pair": True},
    {"forward": True},
    {"process": True, "free_inverse": True},
    {"free_inverse": True},
    {"free_inverse": True, "noise": False},
]


def contents(path):
    with safe_open(path, framework="numpy") as opened:
        return {name: opened.get_tensor(name) for name in opened.keys()}, json.loads(opened.metadata()["kkl-gym"])  # noqa: SIM118


def rewrite(path, change):
    """The file again with tensors and metadata changed in place by change(tensors, meta)."""
    tensors, meta = contents(path)
    change(tensors, meta)
    save_file(tensors, path, metadata={"kkl-gym": json.dumps(meta)})


@pytest.fixture
def file(tmp_path, make_artifact):
    path = tmp_path / "map.safetensors"
    make_artifact(forward=True).save(path)
    return path


def raises_naming(path):
    return pytest.raises(ArtifactError, match=re.escape(str(path)))


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("options", KINDS, ids=str)
def test_round_trip(system, options, make_artifact, tmp_path):
    artifact, path = make_artifact(system, **options), tmp_path / "new" / "map.safetensors"
    artifact.save(path)
    again = Artifact.read(path)
    assert (again.system, again.parameters) == (system, get_system(system).parameters)
    assert (again.nx, again.ny, again.nu) == (artifact.nx, artifact.ny, artifact.nu)
    assert (again.training, again.versions) == (artifact.training, artifact.versions)
    assert again.filter.dt == artifact.filter.dt
    for part in ("transition", "early_y", "late_y", "held_u", "equilibrium"):
        assert np.array_equal(getattr(again.filter, part), getattr(artifact.filter, part))
    assert (again.free_inverse is None) == (artifact.free_inverse is None)
    for after, before in ((again.inverse, artifact.inverse), (again.free_inverse, artifact.free_inverse)):
        for part in dataclasses.fields(before) if before else ():
            if part.name != "mlp":
                assert np.array_equal(getattr(after, part.name), getattr(before, part.name))
    assert (again.forward is None) == (artifact.forward is None)
    x = np.random.default_rng(1).normal(size=(5, artifact.nx))
    if artifact.forward:
        assert np.array_equal(again.forward(x), artifact.forward(x))
    y = np.random.default_rng(2).normal(size=(20, 3, artifact.ny))
    assert np.array_equal(KKLObserver(again).estimate(y), KKLObserver(artifact).estimate(y))
    u = np.ones((20, 3, artifact.nu))
    assert np.array_equal(KKLObserver(again).estimate(y, u), KKLObserver(artifact).estimate(y, u))
    before = contents(path)[1]
    again.save(path)
    assert contents(path)[1] == before
    assert np.array_equal(KKLObserver(Artifact.read(path)).estimate(y), KKLObserver(artifact).estimate(y))


def test_saving_twice_gives_the_same_bytes_anyone_may_read(file, make_artifact, tmp_path):
    make_artifact(forward=True).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == file.read_bytes()
    assert file.stat().st_mode & 0o777 == 0o644


def test_forward_map(make_artifact):
    forward = make_artifact(forward=True).forward
    x = np.array([[0.5, -1.0], [2.0, 3.0]])
    z = forward(x)
    assert z.shape == (2, 5)
    assert np.allclose(z, 1.0 + 3.0 * forward.mlp(x / 2.0))
    assert np.allclose(forward(x[0].tolist()), z[0], atol=1e-5)


def test_truncated_files(file):
    whole = file.read_bytes()
    for length in sorted({*range(64), *np.linspace(64, len(whole) - 1, 60).astype(int).tolist(), len(whole) - 1}):
        file.write_bytes(whole[:length])
        with raises_naming(file):
            Artifact.read(file)
    file.write_bytes(whole)
    Artifact.read(file)


def test_trailing_garbage(file):
    file.write_bytes(file.read_bytes() + b"more")
    with raises_naming(file):
        Artifact.read(file)


def test_foreign_files(tmp_path):
    path = tmp_path / "foreign.safetensors"
    save_file({"A": np.eye(2)}, path)
    with raises_naming(path):
        Artifact.read(path)
    save_file({"A": np.eye(2)}, path, metadata={"format": "pt"})
    with raises_naming(path):
        Artifact.read(path)
    header = json.dumps({"A": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))  # a type that NumPy lacks
    with raises_naming(path):
        Artifact.read(path)
    path.write_text("this is no map\n" * 100)
    with raises_naming(path):
        Artifact.read(path)


@pytest.mark.parametrize("name", ["missing.safetensors", "no/such/folder/map.safetensors", ""])
def test_missing_files(tmp_path, name):
    with raises_naming(tmp_path / name):
        Artifact.read(tmp_path / name)
    if name:
        with raises_naming(tmp_path / name):
            load(str(tmp_path / name))


@pytest.mark.parametrize(
    "tensor", ["A", "B", "inverse.0.weight", "inverse.2.bias", "inverse.whiten", "forward.x_scale"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_tensors_that_are_not_finite(file, tensor, value):
    rewrite(file, lambda tensors, meta: tensors[tensor].flat.__setitem__(0, value))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert tensor in str(raised.value)


@pytest.mark.parametrize(("process", "number"), [(False, 1), (True, 2)])
def test_maps_that_are_told_of_process_noise_have_a_format_of_their_own(tmp_path, make_artifact, process, number):
    path = tmp_path / "map.safetensors"
    make_artifact(process=process, free_inverse=True).save(path)
    with safe_open(path, framework="numpy") as opened:
        text = opened.metadata()["kkl-gym"]
    assert json.loads(text)["format"] == number
    assert ("process_max" in text) == process
    assert Artifact.read(path).process_noise_max == (0.2 if process else None)


@pytest.mark.parametrize(
    "wrong", [{"process_noise_unit": 0.0}, {"process_noise_unit": np.nan}, {"process_noise_max": -1.0}]
)
def test_impossible_levels_of_process_noise(wrong, make_artifact):
    with pytest.raises(ArtifactError, match="must be positive"):
        dataclasses.replace(make_artifact(process=True).inverse, **wrong)
    with pytest.raises(ArtifactError, match="highest level"):
        dataclasses.replace(make_artifact(process=True).inverse, process_noise_max=np.inf)


def test_maps_of_free_and_driven_motion_are_told_the_same(make_artifact):
    artifact, other = make_artifact(process=True, free_inverse=True), make_artifact(free_inverse=True)
    with pytest.raises(ArtifactError, match="told of process noise"):
        dataclasses.replace(artifact, free_inverse=other.free_inverse)
    with pytest.raises(ArtifactError, match="told of process noise"):
        dataclasses.replace(artifact, free_inverse=dataclasses.replace(artifact.free_inverse, process_noise_max=0.3))


@pytest.mark.parametrize("number", [0, 3, "1", None])
def test_other_formats(file, number):
    rewrite(file, lambda tensors, meta: meta.update(format=number))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert f"format {number!r}" in str(raised.value)


def test_every_missing_metadata_key_and_tensor(file):
    whole = file.read_bytes()
    tensors, meta = contents(file)
    optional = {"holds", "forward"}
    for key in sorted({*meta} - optional):
        file.write_bytes(whole)
        rewrite(file, lambda tensors, meta, key=key: meta.pop(key))
        with raises_naming(file):
            Artifact.read(file)
    for key in ("features", "activation"):
        file.write_bytes(whole)
        rewrite(file, lambda tensors, meta, key=key: meta["inverse"].pop(key))
        with raises_naming(file):
            Artifact.read(file)
    for name in tensors:
        file.write_bytes(whole)
        rewrite(file, lambda tensors, meta, name=name: tensors.pop(name))
        with raises_naming(file):
            Artifact.read(file)


@pytest.mark.parametrize("change", [
    lambda t, m: m.update(dt=-0.01),
    lambda t, m: m.update(dt="0.01"),
    lambda t, m: m.update(inputs=0),
    lambda t, m: m.update(inputs=2),
    lambda t, m: m.update(system="van_der_pol"),
    lambda t, m: m.update(inverse=[]),
    lambda t, m: m["inverse"].update(activation="relu"),
    lambda t, m: m["inverse"].update(features=["z_u", "z_y"]),
    lambda t, m: m["inverse"].update(features=["z_y", "z_u", "measurement_noise", "time"]),
    lambda t, m: m["inverse"].update(features=["z_y", "z_u", "age"]),
    lambda t, m: m["inverse"].update(features=["z_u", "measurement_noise", "age"]),
    lambda t, m: m["inverse"].update(features=[]),
    lambda t, m: m["inverse"].update(invented=1.0),
    lambda t, m: t.update(A=np.eye(5)),
    lambda t, m: t.update(A=-np.eye(4)),
    lambda t, m: t.update({"inverse.z_offset": np.zeros(3)}),
    lambda t, m: t.update({"inverse.noise_gain": np.zeros(3)}),
    lambda t, m: t.update({"inverse.x_offset": np.zeros(3)}),
    lambda t, m: t.update({"inverse.x_scale": np.zeros(3)}),
    lambda t, m: t.update({"inverse.whiten": np.zeros((9, 9))}),
    lambda t, m: t.update({"inverse.1.weight": np.zeros((8, 7), np.float32)}),
    lambda t, m: t.update({"inverse.1.bias": np.zeros((8, 1), np.float32)}),
])  # fmt: skip
def test_contents_that_do_not_fit(file, change):
    rewrite(file, change)
    with raises_naming(file):
        Artifact.read(file)


def test_metadata_that_is_no_object(file):
    tensors, _ = contents(file)
    for text in ("", "{", "[]", "3", "null", '"text"'):
        save_file(tensors, file, metadata={"kkl-gym": text})
        with raises_naming(file):
            Artifact.read(file)


@pytest.mark.parametrize("failing", ["save_file", "os.replace"])
def test_a_failed_save_leaves_the_old_file_and_nothing_else(file, make_artifact, monkeypatch, failing):
    before = file.read_bytes()

    def fail(*arguments, **options):
        if failing == "save_file":
            Path(arguments[1]).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(*((observers.artifact, "save_file") if failing == "save_file" else (os, "replace")), fail)
    with pytest.raises(OSError, match="disk full"):
        make_artifact("van_der_pol", inputs=False).save(file)
    assert file.read_bytes() == before
    assert os.listdir(file.parent) == [file.name]


def test_a_save_that_cannot_be_described_leaves_nothing(tmp_path, make_artifact):
    for value, error in ((object(), TypeError), (np.nan, ValueError)):
        with pytest.raises(error):
            dataclasses.replace(make_artifact(), training={"value": value}).save(tmp_path / "map.safetensors")
    assert not os.listdir(tmp_path)


def test_unknown_names_list_what_ships():
    with pytest.raises(ArtifactError, match=r"unknown observer 'nonsense'; shipped: ") as raised:
        load("nonsense")
    assert all(name in str(raised.value) for name in shipped())
    assert ".safetensors" in str(raised.value)


@pytest.fixture
def shelf(tmp_path, monkeypatch, saved):
    """A package folder whose maps are random ones."""
    (tmp_path / "maps").mkdir()
    for name, system in (
        ("lorenz-v1", "lorenz"),
        ("lorenz-v2", "rossler"),
        ("lorenz-v10", "reverse_duffing"),
        ("lorenz-spinn-v1", "van_der_pol"),
    ):
        shutil.copy(saved(system=system), tmp_path / "maps" / f"{name}.safetensors")
    (tmp_path / "maps" / "README.md").write_text("no map")
    monkeypatch.setattr(observers.artifact, "files", lambda package: tmp_path)


def test_names_of_what_ships(shelf):
    assert shipped() == {
        "lorenz": "lorenz-v10",
        "lorenz-v1": "lorenz-v1",
        "lorenz-v2": "lorenz-v2",
        "lorenz-v10": "lorenz-v10",
        "lorenz-spinn": "lorenz-spinn-v1",
        "lorenz-spinn-v1": "lorenz-spinn-v1",
    }
    assert load("lorenz").artifact.system == "reverse_duffing"
    assert load("lorenz-v2").artifact.system == "rossler"
    assert load("lorenz-spinn").artifact.system == "van_der_pol"
    with pytest.raises(ArtifactError, match=r"lorenz-v10, .*lorenz-spinn-v1"):
        load("lorenz-v3")


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"system": "rossler"}, "'van_der_pol', but the environment has 'rossler'"),
        ({"parameters": {"mu": 2.0}}, r"mu = 3\.0, but the environment has 2\.0"),
        ({"parameters": {}}, r"mu = 3\.0, but the environment has None"),
        ({"parameters": {"mu": 3.0, "extra": 1.0}}, r"extra = None, but the environment has 1\.0"),
        ({"dt": 0.02}, r"dt = 0\.01, but the environment has 0\.02"),
        ({"ny": 2}, "number of outputs 1, but the environment has 2"),
        ({"nu": 2}, "number of inputs 1, but the environment has 2"),
    ],
)
def test_check_names_both_values(changed, match, make_artifact):
    here = {"system": "van_der_pol", "parameters": {"mu": 3.0}, "dt": 0.01, "ny": 1, "nu": 1}
    make_artifact().check(**here)
    make_artifact(inputs=False).check(**here)
    with pytest.raises(ArtifactError, match=match):
        make_artifact().check(**{**here, **changed})


def layers(*sizes):
    rng = np.random.default_rng(3)
    pairs = list(zip(sizes[1:], sizes[:-1], strict=True))
    return [rng.normal(size=p).astype(np.float32) for p in pairs], [
        rng.normal(size=b).astype(np.float32) for b, _ in pairs
    ]


@pytest.mark.parametrize(("activation", "module"), [("tanh", "Tanh"), ("silu", "SiLU")])
@pytest.mark.parametrize("sizes", [(3, 2), (4, 16, 3), (7, 32, 32, 32, 2)])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_mlp_equals_torch(activation, module, sizes, batch):
    torch = pytest.importorskip("torch")
    weights, biases = layers(*sizes)
    steps = []
    for weight, bias in zip(weights, biases, strict=True):
        linear = torch.nn.Linear(*weight.shape[::-1])
        linear.load_state_dict({"weight": torch.from_numpy(weight), "bias": torch.from_numpy(bias)})
        steps += [linear, getattr(torch.nn, module)()]
    x = 3 * np.random.default_rng(4).normal(size=(*batch, sizes[0]))
    kept = x.copy()
    with torch.no_grad():
        expected = torch.nn.Sequential(*steps[:-1])(torch.from_numpy(x).float()).numpy()
    mlp = MLP(weights, biases, activation)
    assert (mlp.inputs, mlp.outputs) == (sizes[0], sizes[-1])
    out = mlp(x)
    assert out.dtype == np.float32
    assert np.allclose(out, expected, rtol=1e-4, atol=1e-4)
    assert np.allclose(mlp(x.astype(np.float32)), out, rtol=1e-6)
    assert np.array_equal(x, kept)


def test_silu_does_not_overflow():
    mlp = MLP([np.eye(2, dtype=np.float32)] * 2, [np.zeros(2, np.float32)] * 2, "silu")
    assert np.array_equal(mlp(np.array([1e30, -1e30])), np.array([1e30, 0.0], np.float32))


def test_mlp_shape_errors():
    weights, biases = layers(3, 4, 2)
    for wrong in (
        (weights, biases[:1]),
        ([], []),
        (weights[::-1], biases[::-1]),
        (weights, [biases[0], biases[0]]),
        (weights, [biases[0][:, None], biases[1]]),
        ([weights[0][0], weights[1]], biases),
        ([weights[0], np.full((2, 4), np.nan)], biases),
        (weights, [biases[0], np.full(2, np.inf)]),
    ):
        with pytest.raises(ValueError, match=r"cannot follow|do not make|not finite"):
            MLP(*wrong, "tanh")
    with pytest.raises(ValueError, match="unknown activation 'relu', expected one of tanh, silu"):
        MLP(weights, biases, "relu")


def test_a_map_of_free_motion_must_fit_the_one_of_driven_motion(make_artifact):
    artifact, autonomous = make_artifact(free_inverse=True), make_artifact(inputs=False)
    other = make_artifact("lorenz", free_inverse=True).free_inverse
    with pytest.raises(ArtifactError, match="must be of z_y, 5 values"):
        dataclasses.replace(artifact, free_inverse=artifact.inverse)
    with pytest.raises(ArtifactError, match="must be of z_y, 5 values, beside one that knows of inputs"):
        dataclasses.replace(autonomous, free_inverse=artifact.free_inverse)
    with pytest.raises(ArtifactError, match="must be of z_y"):
        dataclasses.replace(artifact, free_inverse=other)
    with pytest.raises(ArtifactError, match="differ in states, or in noise"):
        dataclasses.replace(
            artifact, free_inverse=dataclasses.replace(artifact.free_inverse, measurement_noise_max=2.0)
        )
