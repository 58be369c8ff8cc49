import dataclasses
import json
import os
import re
import shutil

import numpy as np
import pytest
from random_tracking import tracking
from safetensors import safe_open
from safetensors.numpy import save_file

import observers.names
from kkl_gym import SYSTEMS, get_system
from observers import Artifact, ArtifactError, KKLObserver, Limits, load, shipped
from observers.names import resolve

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
    {"outputs": 2},
    {"outputs": 3, "process": True, "free_inverse": True},
    {"estimated": True, "process": True, "free_inverse": True},
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
    assert again.parameter_ranges == artifact.parameter_ranges
    assert again.estimated_parameters == artifact.estimated_parameters
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


def test_saving_twice_gives_the_same_bytes(file, make_artifact, tmp_path):
    make_artifact(forward=True).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == file.read_bytes()


@pytest.mark.parametrize("name", sorted(set(shipped().values())))
def test_shipped_files_are_written_again_as_they_are(name, tmp_path):
    """The formats are what they were: every array, key and digit."""
    Artifact.read(resolve(name)).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == resolve(name).read_bytes()


def test_files_from_before_reverse_duffing_had_parameters(make_artifact, tmp_path):
    path = tmp_path / "old.safetensors"
    dataclasses.replace(make_artifact("reverse_duffing"), parameters={}).save(path)
    assert contents(path)[1]["system"]["parameters"] == {}
    old, its = Artifact.read(path), {"dt": 0.01, "ny": 1, "nu": 1}
    old.check("reverse_duffing", get_system("reverse_duffing").parameters, **its)
    with pytest.raises(ArtifactError, match=r"made for the parameter b = 1\.0, but the environment has 1\.1"):
        old.check("reverse_duffing", {"a": 1.0, "b": 1.1}, **its)
    dataclasses.replace(make_artifact("lorenz"), parameters={}).save(path)
    assert Artifact.read(path).parameters == {}


@pytest.mark.parametrize("bend", [None, 0.5])
def test_files_hold_how_errors_of_a_flow_grow(bend, tmp_path):
    artifact = tracking(bend=bend)
    artifact.save(tmp_path / "map.safetensors")
    found = Artifact.read(tmp_path / "map.safetensors").flow.bend
    assert found is None if bend is None else np.array_equal(found, [0.5, 1.0])


def test_flows_from_before_they_were_polynomials(tmp_path):
    artifact = tracking()
    linear = dataclasses.replace(artifact.flow, polynomial=artifact.flow.polynomial[:, : 1 + artifact.nx + artifact.nu])
    path = tmp_path / "before.safetensors"
    dataclasses.replace(artifact, flow=linear).save(path)

    def as_before(tensors, meta):
        polynomial = tensors.pop("flow.polynomial")
        tensors["flow.bias"], tensors["flow.linear"] = polynomial[:, 0].copy(), polynomial[:, 1:].copy()

    rewrite(path, as_before)
    np.testing.assert_array_equal(Artifact.read(path).flow.polynomial, linear.polynomial)


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


UNITS = ["measurement_noise_unit", "process_noise_unit", "age_unit"]
ENDS = ["measurement_noise_max", "process_noise_max", "age_max"]
WRONG = [0.0, -1.0, np.nan, np.inf, None, "abc", True, [1.0], 10**400]


@pytest.mark.parametrize("wrong", WRONG, ids=lambda value: repr(value)[:9])
@pytest.mark.parametrize("name", [*UNITS, *ENDS])
def test_impossible_units_and_ends_of_what_is_told(name, wrong, make_artifact):
    with pytest.raises(ArtifactError, match=f"{name} must be a positive, finite number.*{re.escape(repr(wrong)[:9])}"):
        dataclasses.replace(make_artifact(process=True).inverse, **{name: wrong})


@pytest.mark.parametrize("name", [*UNITS, *ENDS])
def test_units_and_ends_of_what_is_not_told(name, make_artifact):
    inverse = make_artifact(noise=False, age=False).inverse
    for wrong in (-1.0, np.nan, None, "abc", True, *([0.0, np.inf] if name in UNITS else [])):
        with pytest.raises(ArtifactError, match=f"{name} must be a"):
            dataclasses.replace(inverse, **{name: wrong})
    if name in ENDS:
        for right in (0.0, 2, np.float64(3.0), np.inf):
            dataclasses.replace(inverse, **{name: right})


KEYS = ["noise_unit", "noise_max", "process_unit", "process_max", "age_unit", "age_max"]


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("part", ["inverse", "free"])
def test_files_whose_units_and_ends_are_wrong_or_missing(key, part, tmp_path, make_artifact):
    """What a map is told changes its estimates: nothing stands in for what a file does not say."""
    path, feature = tmp_path / "map.safetensors", {"n": "measurement_noise", "p": "process_noise", "a": "age"}[key[0]]
    artifact = make_artifact(process=True, free_inverse=True)
    aged = (*artifact.free_inverse.features, "age")
    free = dataclasses.replace(
        artifact.free_inverse, features=aged, age_max=2.0, whiten=artifact.free_inverse.whiten[:-1],
        noise_gain=artifact.free_inverse.noise_gain[:-1],
    )  # fmt: skip
    dataclasses.replace(artifact, free_inverse=free).save(path)
    whole = path.read_bytes()
    Artifact.read(path)
    for wrong in WRONG:
        path.write_bytes(whole)
        rewrite(path, lambda tensors, meta, wrong=wrong: meta[part].update({key: wrong}))
        with raises_naming(path) as raised:
            Artifact.read(path)
        assert feature in str(raised.value)
    path.write_bytes(whole)
    rewrite(path, lambda tensors, meta: meta[part].pop(key))
    with raises_naming(path) as raised:
        Artifact.read(path)
    assert f"its map {part} is told {feature}, but lacks {key!r}" in str(raised.value)


@pytest.mark.parametrize("parameters", [{"mu": value} for value in WRONG[2:]] + [None, [], 3.0, "mu"])
def test_parameters_are_finite_numbers(file, parameters):
    rewrite(file, lambda tensors, meta: meta["system"].update(parameters=parameters))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert "parameter" in str(raised.value)


@pytest.mark.parametrize("inputs", [-1, 65, 10**9, 1.0, True, "1", None])
def test_the_number_of_inputs_is_a_small_whole_one(file, inputs):
    rewrite(file, lambda tensors, meta: meta.update(inputs=inputs))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert f"number of inputs must be an integer from 0 to 64, got {inputs!r}" in str(raised.value)


@pytest.mark.parametrize(
    ("nz", "ny", "inputs"), [(3000, 1, 1), (1025, 1, 0), (513, 1, 1), (16, 1, 64), (5, 1025, 1), (5, 10**6, 64)]
)
def test_filters_beyond_all_measure_are_refused_before_their_matrices_are_made(nz, ny, inputs, file, monkeypatch):
    def grow(tensors, meta):
        tensors["A"], tensors["B"] = -np.eye(nz), np.ones((nz, ny))
        meta["inputs"] = inputs

    rewrite(file, grow)
    for name in ("eig", "cond", "inv"):
        monkeypatch.setattr(np.linalg, name, lambda *arguments: pytest.fail("decomposed"))
    monkeypatch.setattr(np, "kron", lambda *arguments: pytest.fail("memory taken"))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert f"got nz = {nz}, nu = {inputs} and {ny} outputs" in str(raised.value)


@pytest.mark.parametrize("shape", [(0, 0), (0, 1), (1, 0)])
def test_filters_of_nothing(shape, file):
    rewrite(file, lambda tensors, meta: tensors.update(A=-np.eye(shape[0]), B=np.ones(shape)))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert "got nz = " in str(raised.value)


def test_maps_that_estimate_nothing(file):
    def empty(tensors, meta):
        tensors["inverse.2.weight"], tensors["inverse.2.bias"] = tensors["inverse.2.weight"][:0], np.zeros(0)
        tensors["inverse.x_offset"] = tensors["inverse.x_scale"] = np.zeros(0)

    rewrite(file, empty)
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert "must estimate one state at least" in str(raised.value)


@pytest.mark.parametrize("dt", [0.0, -0.01, True, "0.01", None, 10**400, np.inf, np.nan, [0.01]])
def test_the_sampling_interval_is_a_positive_number(file, dt):
    rewrite(file, lambda tensors, meta: meta.update(dt=dt))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert "dt must be a positive, finite number" in str(raised.value)


LIMITS = Limits(
    np.array([0.0, 1.0]), np.ones((2, 1)), np.zeros((2, 1)), np.ones((2, 1)),
    window=0.5, warm_up=5.0, false_alarms=0.01, duration=50.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "wrong"),
    [(name, wrong) for name in ("window", "warm_up", "false_alarms", "duration") for wrong in [-1.0, *WRONG[2:]]]
    + [("window", 0), ("warm_up", 50.0), ("false_alarms", 1.0), ("false_alarms", 0), ("duration", 4.0)],
    ids=lambda value: repr(value)[:12],
)
def test_limits_in_files_are_in_range(name, wrong, tmp_path, make_artifact):
    path = tmp_path / "map.safetensors"
    dataclasses.replace(make_artifact(), C=np.array([[1.0, 0.0]]), limits=LIMITS).save(path)
    assert Artifact.read(path).limits.window == 0.5
    rewrite(path, lambda tensors, meta: meta["limits"].update({name: wrong}))
    with raises_naming(path) as raised:
        Artifact.read(path)
    assert name in str(raised.value)


@pytest.mark.parametrize("dtype", [bool, np.int64, np.uint8])
def test_weights_are_floats(file, dtype):
    rewrite(file, lambda tensors, meta: tensors.update({"inverse.0.weight": tensors["inverse.0.weight"].astype(dtype)}))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert "its tensor inverse.0.weight is of type" in str(raised.value)


@pytest.mark.parametrize("depth", [900, 100_000])
def test_metadata_nested_without_end(file, depth):
    tensors, meta = contents(file)
    meta["system"]["parameters"] = {"mu": "deep"}
    text = json.dumps(meta).replace('"deep"', "[" * depth + "]" * depth)
    save_file(tensors, file, metadata={"kkl-gym": text})
    with raises_naming(file):
        Artifact.read(file)


def test_files_whose_filter_takes_signals_for_something_else(file):
    rewrite(file, lambda tensors, meta: meta.update(holds={"y": "zero-order", "u": "zero-order"}))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert "'y': 'zero-order'" in str(raised.value)


@pytest.mark.parametrize("key", ["training", "versions"])
def test_histories_are_objects(file, key):
    rewrite(file, lambda tensors, meta: meta.update({key: [1]}))
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert key in str(raised.value)


@pytest.mark.parametrize("name", ["x_offset", "x_scale", "z_offset", "noise_gain"])
def test_scalings_are_rows(file, name):
    """A column would make estimates of a wrong shape."""

    def stand(tensors, meta):
        tensors[f"inverse.{name}"] = tensors[f"inverse.{name}"][:, None]

    rewrite(file, stand)
    with raises_naming(file) as raised:
        Artifact.read(file)
    assert f"{name} does not fit" in str(raised.value)


def test_a_forward_map_must_be_of_the_filters_state(make_artifact):
    forward = make_artifact("lorenz", forward=True).forward
    with pytest.raises(ArtifactError, match="3 states to 7 values does not fit 2 states and 5 values"):
        dataclasses.replace(make_artifact(), forward=forward)


def test_maps_of_free_and_driven_motion_are_told_the_same(make_artifact):
    artifact, other = make_artifact(process=True, free_inverse=True), make_artifact(free_inverse=True)
    with pytest.raises(ArtifactError, match="told of process noise"):
        dataclasses.replace(artifact, free_inverse=other.free_inverse)
    with pytest.raises(ArtifactError, match="told of process noise"):
        dataclasses.replace(artifact, free_inverse=dataclasses.replace(artifact.free_inverse, process_noise_max=0.3))


@pytest.mark.parametrize("number", [0, 7, "1", None])
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
    lambda t, m: m["inverse"].update(activation="gelu"),
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
    lambda t, m: m.update(measurement_noise=-0.1),
    lambda t, m: m.update(measurement_noise="0.1"),
    lambda t, m: m.update(measurement_noise=[0.1, 0.2]),
    lambda t, m: m.update(measurement_noise=None),
    lambda t, m: m.update(h=[]),
    lambda t, m: m.update(h=[["x", 0], ["x", 1]]),
    lambda t, m: m.update(h=[["x", 2]]),
    lambda t, m: m.update(h=[["__import__", "os"]]),
    lambda t, m: (m.update(h=[["x", 0]]), t.update(C=np.eye(2)[:1])),
    lambda t, m: t.update({"inverse.noise_gain": np.zeros((2, 9))}),
    lambda t, m: m["inverse"].update(noise_max=[1.0]),
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


def test_a_failed_save_leaves_the_old_file_and_nothing_else(file, make_artifact, monkeypatch):
    before = file.read_bytes()

    def fail(*arguments):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        make_artifact("van_der_pol", inputs=False).save(file)
    assert file.read_bytes() == before
    assert os.listdir(file.parent) == [file.name]


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
    monkeypatch.setattr(observers.names, "files", lambda package: tmp_path)


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


def test_check_tells_small_parameters_apart(make_artifact):
    artifact = dataclasses.replace(make_artifact(), parameters={"C": 1e-12, "offset": 0.0})
    here = {"system": "van_der_pol", "dt": 0.01, "ny": 1, "nu": 1}
    artifact.check(parameters={"C": 1e-12 * (1 + 1e-10), "offset": 0.0}, **here)
    with pytest.raises(ArtifactError, match=r"C = 1e-12, but the environment has 1\.5e-12"):
        artifact.check(parameters={"C": 1.5e-12, "offset": 0.0}, **here)


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
