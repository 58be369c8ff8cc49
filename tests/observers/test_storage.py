import json
import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from safetensors_bytes import content

import observers
from observers import MLP, storage


class UnreadableError(ValueError):
    pass


ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "b": np.ones(2, np.float32),
    "none": np.zeros((0, 3)),
    "one": np.array(2.0),
}


def read(path):
    return storage.read(path, key="ours", error=UnreadableError, what="a test")


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "file.safetensors"
    storage.save(found, ARRAYS, key="ours", described={"format": 1, "text": "ä"})
    return found


def test_what_is_saved_is_read(path):
    tensors, described = read(path)
    assert described == {"format": 1, "text": "ä"}
    assert set(tensors) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert tensors[name].dtype == array.dtype
        assert np.array_equal(tensors[name], array)
        assert tensors[name].shape == array.shape
        tensors[name] += 1.0  # arrays of one's own


def test_arrays_may_lie_in_memory_as_they_like(tmp_path):
    array = np.arange(12.0).reshape(3, 4)
    storage.save(tmp_path / "f", {"t": array.T, "s": array[:, ::2]}, key="ours", described={})
    tensors, _ = read(tmp_path / "f")
    assert np.array_equal(tensors["t"], array.T)
    assert np.array_equal(tensors["s"], array[:, ::2])


@pytest.mark.parametrize("dtype", [bool, int, np.uint8, np.float16, complex, object, "U3"])
def test_other_types_are_not_saved(tmp_path, dtype):
    with pytest.raises(TypeError, match=f"'weights' is of type {np.zeros(1, dtype).dtype}.* float32 and float64"):
        storage.save(tmp_path / "f", {"weights": np.zeros(2, dtype)}, key="ours", described={})
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(("described", "error"), [({"a": object()}, TypeError), ({"a": np.nan}, ValueError)])
def test_what_json_cannot_hold_is_not_saved(tmp_path, described, error):
    with pytest.raises(error):
        storage.save(tmp_path / "f", ARRAYS, key="ours", described=described)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(("umask", "rights"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_files_have_the_rights_that_the_umask_gives(tmp_path, umask, rights):
    before = os.umask(umask)
    try:
        storage.write(tmp_path / "a" / "b.txt", "text\n")
        storage.save(tmp_path / "c", ARRAYS, key="ours", described={})
    finally:
        os.umask(before)
    assert (tmp_path / "a" / "b.txt").read_text() == "text\n"
    assert stat.S_IMODE((tmp_path / "a" / "b.txt").stat().st_mode) == rights
    assert stat.S_IMODE((tmp_path / "c").stat().st_mode) == rights


def test_the_umask_is_never_touched(tmp_path, monkeypatch):
    """It is the whole process's: another thread would make files that everybody may write."""
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail("umask changed"))
    storage.write(tmp_path / "a", "text")


def test_temporary_files_lie_beside_and_keep_the_ending(tmp_path):
    with storage.replacing(tmp_path / "film.gif") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".gif")
        assert os.listdir(tmp_path) == [temporary.name]
        temporary.write_bytes(b"whole")
    assert os.listdir(tmp_path) == ["film.gif"]
    assert (tmp_path / "film.gif").read_bytes() == b"whole"


def test_the_file_is_on_disk_before_it_takes_its_place_and_the_folder_after(tmp_path, monkeypatch):
    events, fsync, replace = [], os.fsync, os.replace

    def recorded_fsync(descriptor):
        events.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def recorded_replace(*arguments):
        events.append("replace")
        replace(*arguments)

    monkeypatch.setattr(os, "fsync", recorded_fsync)
    monkeypatch.setattr(os, "replace", recorded_replace)
    storage.write(tmp_path / "a.txt", "text")
    assert events == ["file", "replace", "folder"]


def test_systems_that_open_no_folders(tmp_path, monkeypatch):
    opened = os.open

    def refuse(path, *arguments, **options):
        if Path(path).is_dir():
            raise PermissionError(13, "Permission denied")
        return opened(path, *arguments, **options)

    monkeypatch.setattr(os, "open", refuse)
    storage.write(tmp_path / "a.txt", "text")
    assert (tmp_path / "a.txt").read_text() == "text"


@pytest.mark.parametrize("failing", ["write_bytes", "fsync", "replace"])
def test_a_failed_save_leaves_the_old_file_and_nothing_else(path, monkeypatch, failing):
    before = path.read_bytes()

    def fail(*arguments):
        if failing == "write_bytes":
            with arguments[0].open("wb") as half:
                half.write(arguments[1][:9])
        raise OSError("disk full")

    monkeypatch.setattr(Path if failing == "write_bytes" else os, failing, fail)
    with pytest.raises(OSError, match="disk full"):
        storage.save(path, {"a": np.zeros(3)}, key="ours", described={})
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def named(path, words):
    return pytest.raises(UnreadableError, match=f"{re.escape(str(path))}.*{words}|{words}.*{re.escape(str(path))}")


def test_missing_files_and_folders(tmp_path):
    (tmp_path / "file").write_text("")
    for name in ("none", "no/folder/none", "file/none", ""):
        with named(tmp_path / name, "there is no file"):
            read(tmp_path / name)
    with pytest.raises(UnreadableError, match="there is no file"):
        read("a\0b")


@pytest.mark.parametrize("call", ["is_file", "read_bytes"])
def test_files_that_one_may_not_read(path, monkeypatch, call):
    def refuse(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, call, refuse)
    with named(path, "cannot be read: Permission denied"):
        read(path)


def test_truncated_and_longer_files(path):
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with named(path, "damaged or no safetensors file"):
            read(path)
    path.write_bytes(whole + b"more")
    with named(path, "damaged or no safetensors file"):
        read(path)


def test_foreign_files(path):
    for metadata in (None, {}, {"format": "pt"}):
        save_file({"a": np.eye(2)}, path, metadata=metadata)
        with named(path, "is not a test of kkl-gym: it carries no 'ours' metadata"):
            read(path)
    path.write_text("this is no file of tensors\n" * 100)
    with named(path, "damaged or no safetensors file"):
        read(path)


@pytest.mark.parametrize("text", ["", "{", "nonsense", "[" * 100_000, '{"a":' * 100_000, "9" * 5000])
def test_metadata_that_is_no_json(path, text):
    path.write_bytes(content({}, {"ours": text}))
    with named(path, "its 'ours' metadata is no JSON: "):
        read(path)


@pytest.mark.parametrize("text", ["[]", "3", "null", '"text"', "true"])
def test_metadata_that_is_no_object(path, text):
    path.write_bytes(content({}, {"ours": text}))
    with named(path, "its 'ours' metadata is no JSON object"):
        read(path)


@pytest.mark.parametrize(("dtype", "size"), [("BOOL", 1), ("U8", 1), ("I32", 4), ("I64", 8), ("F16", 2), ("BF16", 2)])
def test_other_types_are_not_read(path, dtype, size):
    path.write_bytes(content({"weights": (dtype, [2], bytes(2 * size))}, {"ours": "{}"}))
    with named(path, f"its tensor weights is of type {dtype}, expected one of F32, F64"):
        read(path)


REWRITTEN = """
import sys, threading, time
from observers import storage

path, stop = sys.argv[1], threading.Event()
whole = open(path, "rb").read()

def rewrite():
    with open(path, "rb+") as file:
        while not stop.is_set():
            file.seek(0)
            file.truncate(0)
            file.write(whole)
            file.flush()
            time.sleep(0.001)

thread = threading.Thread(target=rewrite)
thread.start()
end, good = time.monotonic() + 20.0, 0
while good < 200 and time.monotonic() < end:
    try:
        storage.read(path, key="ours", error=ValueError, what="a test")
        good += 1
    except ValueError:
        time.sleep(0.0005)
stop.set()
thread.join()
print(good)
"""


def test_files_rewritten_in_place_are_damaged_at_worst(tmp_path):
    """A mapped file that shrinks while it is read ends the process."""
    path = tmp_path / "file.safetensors"
    storage.save(path, {f"a{i}": np.ones(2000) for i in range(100)}, key="ours", described={})
    root = str(Path(observers.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", REWRITTEN, str(path)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": root},
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 0


@pytest.mark.parametrize("raised", [KeyError("mass"), TypeError("mass"), IndexError("mass"), AttributeError("mass"),
                                    ValueError("mass"), OverflowError("mass"), RecursionError("mass")])  # fmt: skip
def test_whatever_contents_lead_to_names_the_file(raised):
    with named("some.file", "mass"), storage.explained("some.file", UnreadableError):
        raise raised


def test_other_errors_are_not_hidden():
    with pytest.raises(ZeroDivisionError), storage.explained("some.file", UnreadableError):
        _ = 1 / 0


@pytest.fixture
def mlp():
    rng = np.random.default_rng(0)
    sizes = [(4, 3), (4, 4), (2, 4)]
    return MLP([rng.normal(size=size) for size in sizes], [rng.normal(size=size[0]) for size in sizes], "silu")


@pytest.mark.parametrize("prefix", ["", "inverse.", "a+b."])
def test_networks_come_back(mlp, prefix):
    tensors = {"bias": np.zeros(2), "other.0.weight": np.zeros(2), f"{prefix}whiten": np.zeros(2)}
    storage.put_mlp(tensors, prefix, mlp)
    assert tensors[f"{prefix}2.bias"].dtype == np.float32
    again = storage.get_mlp(tensors, prefix, "silu")
    x = np.random.default_rng(1).normal(size=(5, 3))
    assert np.array_equal(again(x), mlp(x))
    assert len(again.weights) == 3


def test_networks_that_lack_a_layer(mlp):
    whole = {}
    storage.put_mlp(whole, "net.", mlp)
    for name in whole:
        tensors = {key: value for key, value in whole.items() if key != name}
        with pytest.raises(KeyError, match=re.escape(name)):
            storage.get_mlp(tensors, "net.", "silu")
    with pytest.raises(ValueError, match="0 weights"):
        storage.get_mlp(whole, "other.", "silu")


def test_metadata_is_json_with_sorted_keys(path):
    text = path.read_bytes()
    header = json.loads(text[8 : 8 + int.from_bytes(text[:8], "little")])
    assert header["__metadata__"] == {"ours": '{"format": 1, "text": "\\u00e4"}'}
