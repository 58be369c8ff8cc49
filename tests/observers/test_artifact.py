import dataclasses
import json
import re

import numpy as np
import pytest
from error_bars import with_error_bars
from random_tracking import KINDS as TRACKING
from random_tracking import tracking
from safetensors import safe_open
from safetensors_bytes import with_arrays

from observers import MLP, Artifact, ArtifactError, Expression, KKLObserver, Limits, LinearFilter, load, shipped
from observers.names import resolve

LIMITS = Limits(
    np.array([0.0, 1.0]), np.ones((2, 1)), np.zeros((2, 1)), np.ones((2, 1)),
    window=0.5, warm_up=5.0, false_alarms=0.01, duration=50.0,
)  # fmt: skip
RECORDED = {"signals": {"measured": ["y"], "inputs": ["u"], "hidden": ["a", "b"]},
            "environment": {"id": "Pendulum-v1", "kwargs": {"g": 9.0}}}  # fmt: skip


def contents(path):
    with safe_open(path, framework="numpy") as opened:
        return {name: opened.get_tensor(name) for name in opened.keys()}, json.loads(opened.metadata()["kkl-gym"])  # noqa: SIM118


def rewrite(path, change):
    """Change the tensors and metadata of a file in place by change(tensors, meta)."""
    tensors, meta = contents(path)
    change(tensors, meta)
    path.write_bytes(with_arrays(tensors, "kkl-gym", meta))


@pytest.fixture
def file(tmp_path, make_artifact):
    path = tmp_path / "map.safetensors"
    dataclasses.replace(make_artifact(forward=True), C=np.array([[1.0, 0.0]]), limits=LIMITS).save(path)
    return path


def raises_naming(path, words=""):
    return pytest.raises(ArtifactError, match=f"(?s){re.escape(str(path))}.*{words}")


def same(one, other):
    """Whether two artifacts, or parts of them, are equal to the last bit."""
    if isinstance(one, LinearFilter):
        return (one.dt, one.nu) == (other.dt, other.nu) and same([one.A, one.B], [other.A, other.B])
    if isinstance(one, MLP):  # weights are stored in float32
        return one.activation == other.activation and same(one.layers, other.layers)
    if dataclasses.is_dataclass(one):
        names = [entry.name for entry in dataclasses.fields(one)]
        return type(one) is type(other) and all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    return type(one) is type(other) and one == other


KINDS = [
    *({"system": system} for system in ("van_der_pol", "lorenz", "rossler", "reverse_duffing")),
    {"inputs": False},
    {"noise": False, "age": False},
    {"inputs": False, "noise": False, "age": False},
    {"pair": True},
    {"forward": True},
    {"process": True, "free_inverse": True},
    {"free_inverse": True, "noise": False},
    {"outputs": 2},
    {"outputs": 2, "noise": False},
    {"outputs": 3, "process": True, "free_inverse": True},
    {"estimated": True, "process": True, "free_inverse": True},
]


@pytest.mark.parametrize("options", KINDS, ids=str)
def test_round_trip(options, make_artifact, tmp_path):
    artifact, path = make_artifact(**options), tmp_path / "new" / "map.safetensors"
    artifact.save(path)
    again = Artifact.read(path)
    assert same(again, artifact)
    y, u = np.random.default_rng(2).normal(size=(20, 3, artifact.ny)), np.ones((20, 3, artifact.nu))
    for inputs in ((), (u,)):
        assert np.array_equal(KKLObserver(again).estimate(y, *inputs), KKLObserver(artifact).estimate(y, *inputs))
    before = path.read_bytes()
    again.save(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("more", [
    lambda a: with_error_bars(a),
    lambda a: dataclasses.replace(a, C=np.array([[1.0, 0.0]]), limits=LIMITS),
    lambda a: dataclasses.replace(a, h=Expression([["*", 2.0, ["sin", ["x", 0]]]]), measurement_noise=0.2),
    lambda a: dataclasses.replace(a, **RECORDED),
    lambda a: dataclasses.replace(a, parameter_ranges={"mu": (2.0, 4.0)}),
    *(lambda a, kind=kind: tracking(**kind) for kind in TRACKING),
])  # fmt: skip
def test_round_trip_of_optional_parts(more, make_artifact, tmp_path):
    artifact = more(make_artifact())
    artifact.save(tmp_path / "map.safetensors")
    assert same(Artifact.read(tmp_path / "map.safetensors"), artifact)


@pytest.mark.parametrize("name", shipped())
def test_shipped_files_are_read_and_written_without_a_change(name, tmp_path):
    Artifact.read(resolve(name)).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == resolve(name).read_bytes()


def test_files_that_hold_no_observer(file):
    whole = file.read_bytes()
    for wrong in (b"", whole[:-1], whole + b"more", b"this is no map\n" * 100):
        file.write_bytes(wrong)
        with raises_naming(file):
            Artifact.read(file)
    for name in ("missing.safetensors", "no/such/folder/map.safetensors"):
        with raises_naming(file.parent / name):
            load(str(file.parent / name))
    file.write_bytes(with_arrays({"A": np.eye(2)}, "other", "{}"))
    with raises_naming(file, "is not an observer"):
        Artifact.read(file)


def without(described, path):
    """A description without the key at the end of a path."""
    first, *rest = path
    left = {key: value for key, value in described.items() if key != first}
    return {**left, first: without(described[first], rest)} if rest else left


def paths(described, begin=()):
    for key, value in described.items():
        yield (*begin, key)
        if isinstance(value, dict) and not {"parameters", "training", "versions"} & {*begin, key}:
            yield from paths(value, (*begin, key))


@pytest.mark.parametrize("by", ["equations", "flow"])
def test_missing_tensors_and_keys_have_no_defaults(by, tmp_path):
    """A default unit or factor would change estimates silently."""
    path = tmp_path / "map.safetensors"
    tracking(by, outputs=2, process=True, free_inverse=True).save(path)
    whole, (tensors, meta) = path.read_bytes(), contents(path)
    for name in tensors:
        rewrite(path, lambda tensors, meta, name=name: tensors.pop(name))
        with raises_naming(path):
            Artifact.read(path)
        path.write_bytes(whole)
    for key in set(paths(meta)) - {("motion",), ("free_inverse",)}:  # these are optional as a whole
        path.write_bytes(with_arrays(tensors, "kkl-gym", without(meta, key)))
        with raises_naming(path):
            Artifact.read(path)


def nothing_estimated(tensors, meta):
    tensors["inverse.2.weight"], tensors["inverse.2.bias"] = tensors["inverse.2.weight"][:0], np.zeros(0)
    tensors["inverse.x_offset"] = tensors["inverse.x_scale"] = np.zeros(0)


@pytest.mark.parametrize(("change", "words"), [
    *((lambda t, m, number=number: m.update(format=number), f"it has format {number!r}, kkl-gym reads 1: train")
      for number in (0, 6, "1", None)),
    *((lambda t, m, dt=dt: m.update(dt=dt), "dt must be a positive, finite number")
      for dt in (0.0, True, "0.01", None)),
    *((lambda t, m, nu=nu: m.update(inputs=nu), f"number of inputs must be an integer from 0 to 64, got {nu!r}")
      for nu in (-1, 65, 1.0, None)),
    *((lambda t, m, mu=mu: m.update(parameters={"mu": mu}), "parameter mu") for mu in (np.nan, None, "abc", True)),
    *((lambda t, m, name=name: m.update({name: [1]}), name)
      for name in ("parameters", "parameter_ranges", "training", "versions")),
    *((lambda t, m, shape=shape: t.update(A=-np.eye(shape[0]), B=np.ones(shape)), "got nz = ")
      for shape in ((0, 0), (0, 1), (1, 0), (1025, 1), (5, 1025))),
    *((lambda t, m, name=name: t[name].flat.__setitem__(0, np.nan), name)
      for name in ("A", "inverse.0.weight", "inverse.2.bias", "inverse.whiten", "forward.x_scale")),
    *((lambda t, m, value=value: m["limits"].update(value), next(iter(value)))
      for value in ({"window": 0}, {"warm_up": 50.0}, {"false_alarms": 1.0}, {"duration": 4.0}, {"window": "abc"})),
    (lambda t, m: t.update({"inverse.x_offset": t["inverse.x_offset"][:, None]}), "x_offset does not fit"),
    *((lambda t, m, name=name: t.update({f"inverse.{name}": np.zeros(3)}), name)
      for name in ("z_offset", "noise_gain", "x_offset", "x_scale")),
    *((lambda t, m, features=features: m["inverse"].update(features=features), "feature|network must have")
      for features in (["z_u", "z_y"], ["z_y", "z_u", "measurement_noise", "time"], ["z_y", "z_u", "age"], [])),
    *((lambda t, m, noise=noise: m.update(measurement_noise=noise), "measurement_noise")
      for noise in (-0.1, "0.1", [0.1, 0.2], None)),
    *((lambda t, m, h=h: (m.update(h={"components": h}), t.pop("C"), m.pop("limits")), "")
      for h in ([], [["x", 0], ["x", 1]], [["x", 2]], [["__import__", "os"]])),
    (lambda t, m: m.update(h={"components": [["x", 0]]}), "C must be None"),
    (nothing_estimated, "must estimate states"),
    (lambda t, m: t.update({"inverse.0.weight": t["inverse.0.weight"].astype(np.int64)}), "weight is of type I64"),
    (lambda t, m: m.update(system=3), "name must be a string"),
    (lambda t, m: m.update(inverse=[]), "lacks"),
    (lambda t, m: m.update(invented=1.0), "unknown metadata keys: invented"),
    (lambda t, m: t.update(extra=np.zeros(1)), "unknown tensors: extra"),
    (lambda t, m: m["inverse"].update(activation="gelu"), "gelu"),
    (lambda t, m: m["inverse"].update(measurement_noise_max=[1.0]), "measurement_noise_max must be a positive"),
    (lambda t, m: t.update(A=np.eye(5)), "Hurwitz"),
    (lambda t, m: t.update({"inverse.noise_gain": np.zeros((2, 9))}), ""),
    (lambda t, m: t.update({"inverse.1.bias": np.zeros((8, 1), np.float32)}), ""),
])  # fmt: skip
def test_contents_that_do_not_fit(file, change, words):
    rewrite(file, change)
    with raises_naming(file, words):
        Artifact.read(file)


def test_maps_must_fit_the_one_of_driven_motion(make_artifact):
    forward = make_artifact("lorenz", forward=True).forward
    with pytest.raises(ArtifactError, match="T must map 2 states to nz = 5 values, got a map of 3 states to 7 values"):
        dataclasses.replace(make_artifact(), forward=forward)
    artifact, plain = make_artifact(process=True, free_inverse=True), make_artifact(free_inverse=True)
    free, lorenz = artifact.free_inverse, make_artifact("lorenz", free_inverse=True).free_inverse
    for whole, other, words in (
        (artifact, artifact.inverse, "must take z_y alone, 5 values"),
        (artifact, lorenz, "must take z_y"),
        (artifact, dataclasses.replace(free, measurement_noise_max=2.0), "differ in measurement noise"),
        (artifact, plain.free_inverse, "differ in process noise"),
        (artifact, with_error_bars(artifact).free_inverse, "differ in having a covariance"),
    ):
        with pytest.raises(ArtifactError, match=words):
            dataclasses.replace(whole, free_inverse=other)


@pytest.mark.parametrize(("changed", "match"), [
    ({"system": "rossler"}, "'van_der_pol', but the environment has 'rossler'"),
    ({"parameters": {"mu": 2.0}}, r"mu = 3\.0, but the environment has 2\.0"),
    ({"dt": 0.02}, r"dt = 0\.01, but the environment has 0\.02"),
    ({"ny": 2}, "number of outputs 1, but the environment has 2"),
    ({"nu": 2}, "number of inputs 1, but the environment has 2"),
])  # fmt: skip
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
