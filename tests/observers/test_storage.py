import errno
import hashlib
import json
import os
import re
import stat
import subprocess
import sys
import tempfile
import time
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
    for name in ("none", "no/folder/none", "file/none"):
        with named(tmp_path / name, "there is no file"):
            read(tmp_path / name)
    os.mkfifo(tmp_path / "pipe")
    for name in ("", "pipe"):
        with named(tmp_path / name, "is a folder, a pipe or a device"):
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
    assert header["__metadata__"].pop("ours-sha256")
    assert header["__metadata__"] == {"ours": '{"format": 1, "text": "\\u00e4"}'}


def test_saving_twice_gives_the_same_bytes(path):
    """safetensors itself shuffles the entries of the metadata."""
    whole = path.read_bytes()
    for _ in range(8):
        storage.save(path, ARRAYS, key="ours", described={"format": 1, "text": "ä"})
        assert path.read_bytes() == whole


def test_flipped_bits_are_noticed_wherever_they_are(path):
    whole = path.read_bytes()
    for place in range(0, 8 * len(whole), 7):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        with pytest.raises(UnreadableError):
            read(path)


def test_zeroed_and_exchanged_parts_are_noticed(path):
    storage.save(path, {"a": np.arange(500.0)}, key="ours", described={})
    whole = path.read_bytes()
    for start in range(0, len(whole), 512):
        path.write_bytes(whole[:start] + bytes(len(whole[start : start + 512])) + whole[start + 512 :])
        with pytest.raises(UnreadableError):
            read(path)
    path.write_bytes(whole[:-16] + whole[-8:] + whole[-16:-8])
    with named(path, "it holds something else than its checksum says"):
        read(path)


def test_files_from_before_there_were_checksums(path):
    """They are read, and the checksum of what they hold is theirs."""
    with_one = storage.checksum(path, UnreadableError)
    save_file(ARRAYS, path, metadata={"ours": '{"format": 1, "text": "\\u00e4"}'})
    tensors, described = read(path)
    assert described == {"format": 1, "text": "ä"}
    assert np.array_equal(tensors["a"], ARRAYS["a"])
    assert storage.checksum(path, UnreadableError) == hashlib.sha256(path.read_bytes()).hexdigest() == with_one


def test_metadata_that_nobody_knows(path):
    save_file(ARRAYS, path, metadata={"ours": "{}", "ours-sha257": "0", "more": ""})
    with named(path, "nobody knows its metadata more, ours-sha257"):
        read(path)


@pytest.mark.parametrize("whole", [b"", b"\0" * 64, b"\2\0\0\0\0\0\0\0[]", content({}, {"a-sha256": "0"})[:-9]])
def test_checksums_of_what_is_no_file_of_tensors(path, whole):
    path.write_bytes(whole)
    with named(path, "damaged or no safetensors file"):
        storage.checksum(path, UnreadableError)


@pytest.mark.parametrize("size", [2 * 2**30, storage.MOST_BYTES + 1])
def test_files_that_are_too_large_are_not_read(path, size, monkeypatch):
    os.truncate(path, size)  # a sparse file, which takes no room on disk
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("read"))
    with named(path, f"has {size} bytes, more than the {storage.MOST_BYTES}"):
        read(path)


def test_headers_that_are_too_large_are_not_looked_into(path, monkeypatch):
    path.write_bytes(content({"a": ("F32", [1], bytes(4))}, {"ours": "{}" + " " * storage.MOST_HEADER}))
    monkeypatch.setattr(storage, "deserialize", lambda content: pytest.fail("looked into"))
    with named(path, f"its header has [0-9]+ bytes, more than {storage.MOST_HEADER}"):
        read(path)


@pytest.mark.parametrize("shape", [[1] * 100, [0, 2**40, 2**40], [0, 2**63]])
def test_shapes_that_numpy_knows_not(path, shape):
    path.write_bytes(content({"a": ("F32", shape, bytes(4 * (0 not in shape)))}, {"ours": "{}"}))
    with named(path, "its tensor a|no safetensors file"):
        read(path)


def nested(levels):
    return {"a": nested(levels - 1)} if levels > 1 else [1.0] if levels else 1.0


def test_metadata_is_nested_32_times_at_most(path):
    storage.save(path, {}, key="ours", described=nested(32))
    assert read(path)[1] == nested(32)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="at most 32 objects and lists within one another"):
        storage.save(path, {}, key="ours", described=nested(33))
    assert path.read_bytes() == before
    path.write_bytes(content({}, {"ours": json.dumps(nested(33))}))
    with named(path, "has more than 32 levels"):
        read(path)


def test_what_could_not_be_read_is_not_saved(path, monkeypatch):
    before = path.read_bytes()
    with pytest.raises(ValueError, match=f"{re.escape(str(path))} would have"):
        storage.save(path, {}, key="ours", described={"text": "a" * storage.MOST_HEADER})
    monkeypatch.setattr(storage, "MOST_BYTES", 1000)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))} would have"):
        storage.save(path, {"a": np.zeros(200)}, key="ours", described={})
    assert path.read_bytes() == before


@pytest.mark.parametrize("place", ["write", "fsync", "replace"])
def test_a_full_disk_is_told_by_the_name_of_the_file(path, place, monkeypatch):
    before = path.read_bytes()

    def fail(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if place == "write":
        monkeypatch.setattr(Path, "write_bytes", fail)
    else:
        monkeypatch.setattr(os, place, fail)
    with pytest.raises(OSError, match=re.escape(f"No space left on device: '{path}'")) as raised:
        storage.save(path, {"a": np.zeros(3)}, key="ours", described={})
    assert raised.value.filename == str(path)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_a_folder_that_one_may_not_write_to(path, monkeypatch):
    def refuse(self, **options):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(PermissionError, match=re.escape(f"Permission denied: '{path}'")):
        storage.write(path, "text")
    assert os.listdir(path.parent) == [path.name]


def test_a_folder_that_one_may_not_write_to_is_found_out_beforehand(tmp_path, monkeypatch):
    storage.require_writable(tmp_path / "new" / "folder")
    assert not os.listdir(tmp_path)

    def refuse(**options):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), f"{options['dir']}/.part-1")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    with pytest.raises(PermissionError, match=re.escape(f"Permission denied: '{tmp_path}'")):
        storage.require_writable(tmp_path)


def test_other_errors_while_writing_stay_as_they_are(tmp_path):
    with pytest.raises(FileNotFoundError, match="'other'"), storage.replacing(tmp_path / "a"):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "other")
    with pytest.raises(KeyboardInterrupt), storage.replacing(tmp_path / "a"):
        raise KeyboardInterrupt
    assert not os.listdir(tmp_path)


KILLED = """
import os, signal, sys
from observers import storage

with storage.replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_killed_processes_leave_is_cleared_away(path):
    before = path.read_bytes()
    root = str(Path(observers.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], env={**os.environ, "PYTHONPATH": root}, timeout=60)
    assert done.returncode == -9
    assert path.read_bytes() == before
    (left,) = {*path.parent.iterdir()} - {path}
    storage.clear_unfinished(path.parent)
    assert left.exists()  # somebody may be at work on it
    for file in (left, path):
        os.utime(file, (time.time() - 3700.0,) * 2)
    storage.clear_unfinished(path.parent)
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="this system has no links")
def test_what_is_linked_to_stays(tmp_path):
    kept = tmp_path / "kept" / "file"
    kept.parent.mkdir()
    kept.touch()
    link = tmp_path / ".part-link"
    link.symlink_to(kept.parent, target_is_directory=True)
    for path in (link, kept.parent, kept):
        os.utime(path, (time.time() - 3700.0,) * 2, follow_symlinks=False)
    storage.clear_unfinished(tmp_path)
    assert kept.exists()
    assert not link.is_symlink()
