import errno
import hashlib
import json
import os
import re
import stat
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from safetensors_bytes import content, sealed

from observers import storage


class UnreadableError(ValueError):
    pass


ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "b": np.ones(2, np.float32),
    "none": np.zeros((0, 3)),
    "one": np.array(2.0),
    "turned": np.arange(12.0).reshape(3, 4).T,
    "strided": np.arange(12.0)[::2],
}
DESCRIBED = {"text": "ä", "format": 1}


def save(path, described=DESCRIBED, arrays=ARRAYS):
    storage.save(path, arrays, key="ours", described=described)


def read(path):
    return storage.read(path, key="ours", error=UnreadableError, what="a test")


def named(path, words):
    return pytest.raises(UnreadableError, match=f"{re.escape(str(path))}.*{words}|{words}.*{re.escape(str(path))}")


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "file.safetensors"
    save(found)
    return found


def test_round_trip(path):
    tensors, described = read(path)
    assert described == DESCRIBED
    assert set(tensors) == set(ARRAYS)
    os.truncate(path, 0)  # would kill the process if the arrays were memory-mapped
    for name, array in ARRAYS.items():
        assert (tensors[name].dtype, tensors[name].shape) == (array.dtype, array.shape)
        assert np.array_equal(tensors[name], array)
        tensors[name] += 1.0  # writable copies


def test_a_file_is_the_same_bytes_each_time_with_a_checksum_of_all_others(path):
    whole = path.read_bytes()
    for _ in range(8):  # safetensors alone writes metadata in random order
        save(path)
        assert path.read_bytes() == whole
    header = json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")])
    checksum = header["__metadata__"].pop("ours-sha256")
    assert header["__metadata__"] == {"ours": '{"format": 1, "text": "\\u00e4"}'}
    save_file({name: array.copy("C") for name, array in ARRAYS.items()}, path, metadata=header["__metadata__"])
    assert storage.checksum(path, UnreadableError) == hashlib.sha256(path.read_bytes()).hexdigest() == checksum
    with named(path, "lacks its checksum, the metadata ours-sha256.*get the file again, or make it again"):
        read(path)


def nested(levels):
    return {"a": nested(levels - 1)} if levels > 1 else [1.0] if levels else 1.0


@pytest.mark.parametrize(
    ("arrays", "described", "error", "words"),
    [({"weights": np.zeros(2, dtype)}, {}, TypeError, f"'weights' is of type {np.zeros(1, dtype).dtype}.* float64")
     for dtype in (bool, int, np.float16, complex, object)]
    + [
        ({}, {"a": object()}, TypeError, "JSON"),
        ({}, {"a": np.nan}, ValueError, "JSON"),
        ({}, nested(33), ValueError, "at most 32 levels of nested objects and lists"),
        ({}, {"text": "a" * storage.MOST_HEADER}, ValueError, "file.safetensors would have"),
        ({"a": np.zeros(200)}, {}, ValueError, "file.safetensors would have"),
    ],
)  # fmt: skip
def test_contents_that_read_would_refuse_are_not_saved(path, arrays, described, error, words, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr(storage, "MOST_BYTES", 1000 if arrays else storage.MOST_BYTES)
    with pytest.raises(error, match=words):
        save(path, described, arrays)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_files_have_the_rights_that_the_umask_gives(tmp_path, monkeypatch):
    """The umask belongs to the process: changing it could make other threads' files writable for all users."""
    for umask, rights in ((0o022, 0o644), (0o077, 0o600), (0o002, 0o664)):
        before = os.umask(umask)
        try:
            with monkeypatch.context() as patched:
                patched.setattr(os, "umask", lambda mask: pytest.fail("umask changed"))
                save(tmp_path / str(umask) / "b.txt")
        finally:
            os.umask(before)
        assert stat.S_IMODE((tmp_path / str(umask) / "b.txt").stat().st_mode) == rights


def test_the_file_is_synchronised_before_it_is_renamed_and_the_folder_after(tmp_path, monkeypatch):
    events, fsync, replace, opened = [], os.fsync, os.replace, os.open

    def recorded_fsync(descriptor):
        events.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def recorded_replace(*arguments):
        events.append("replace")
        replace(*arguments)

    def refuse(path, *arguments, **options):
        if Path(path).is_dir():
            raise PermissionError(13, "Permission denied")
        return opened(path, *arguments, **options)

    monkeypatch.setattr(os, "fsync", recorded_fsync)
    monkeypatch.setattr(os, "replace", recorded_replace)
    save(tmp_path / "a")
    assert events == ["file", "replace", "folder"]
    monkeypatch.setattr(os, "open", refuse)  # as on systems that cannot open folders
    save(tmp_path / "a", {"text": "other"})
    assert read(tmp_path / "a")[1] == {"text": "other"}


@pytest.mark.parametrize("place", ["write_bytes", "fsync", "replace"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(path, place, monkeypatch):
    before = path.read_bytes()

    def fail(*arguments):
        if place == "write_bytes":
            with arguments[0].open("wb") as half:
                half.write(arguments[1][:9])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path if place == "write_bytes" else os, place, fail)
    with pytest.raises(OSError, match=re.escape(f"No space left on device: '{path}'")) as raised:
        save(path, {})
    assert raised.value.filename == str(path)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_missing_files_and_folders(tmp_path):
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for name in ("none", "no/folder/none", "file/none"):
        with named(tmp_path / name, "there is no file"):
            read(tmp_path / name)
    for name in ("", "pipe"):
        with named(tmp_path / name, "is a folder, a pipe or a device"):
            read(tmp_path / name)
    with pytest.raises(UnreadableError, match="there is no file"):
        read("a\0b")


def test_damage_is_noticed_at_any_byte(path):
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with named(path, "damaged or not a safetensors file"):
            read(path)
    path.write_bytes(whole + b"more")
    with named(path, "damaged or not a safetensors file"):
        read(path)
    for place in range(0, 8 * len(whole), 7):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        with pytest.raises(UnreadableError, match=re.escape(str(path))):
            read(path)
    path.write_bytes(whole[:-16] + whole[-8:] + whole[-16:-8])
    with named(path, "its content does not match its checksum; get it again"):
        read(path)


def ours(text, tensors={}):  # noqa: B006
    return sealed(content(tensors, {"ours": text}), "ours")


@pytest.mark.parametrize(
    ("whole", "words"),
    [
        (b"this is no file of tensors\n" * 100, "damaged or not a safetensors file"),
        (content({}), "is not a test of kkl-gym: it has no 'ours' metadata"),
        (content({}, {"format": "pt"}), "is not a test of kkl-gym: it has no 'ours' metadata"),
        (sealed(content({}, {"ours": "{}", "more": ""}), "ours"), "unknown metadata: more"),
        *((ours(text), "its 'ours' metadata is not JSON: ") for text in ("", "nonsense", "[" * 100_000, "9" * 5000)),
        *((ours(text), "its 'ours' metadata is not a JSON object") for text in ("[]", "3", "null", '"text"')),
        (ours(json.dumps(nested(33))), "has more than 32 levels"),
        *((ours("{}", {"weights": (dtype, [2], bytes(2 * size))}), f"its tensor weights is of type {dtype}, expected")
          for dtype, size in (("BOOL", 1), ("I64", 8), ("F16", 2))),
        *((ours("{}", {"a": ("F32", shape, bytes(4 * (0 not in shape)))}), "its tensor a|not a safetensors file")
          for shape in ([1] * 100, [0, 2**40, 2**40], [0, 2**63])),
    ],
    ids=lambda value: str(value)[:40],
)  # fmt: skip
def test_foreign_and_impossible_files(path, whole, words):
    path.write_bytes(whole)
    with named(path, words):
        read(path)


def test_files_that_are_too_large_are_not_looked_into(path, monkeypatch):
    path.write_bytes(content({"a": ("F32", [1], bytes(4))}, {"ours": "{}" + " " * storage.MOST_HEADER}))
    monkeypatch.setattr(storage, "deserialize", lambda content: pytest.fail("looked into"))
    with named(path, f"its header has [0-9]+ bytes, limit {storage.MOST_HEADER}"):
        read(path)
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("read"))
    for size in (2 * 2**30, storage.MOST_BYTES + 1):
        os.truncate(path, size)  # a sparse file takes no space on disk
        with named(path, f"has {size} bytes, more than the {storage.MOST_BYTES}"):
            read(path)
