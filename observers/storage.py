"""Files of arrays and JSON, which are written atomically and checked when they are read.

Files have the safetensors format and contain no code. Their metadata has two entries. ``KEY``, which names the kind of
file, holds a JSON object. ``KEY-sha256`` holds the SHA-256 of the file without this second entry.
"""

import hashlib
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, deserialize
from safetensors.numpy import save as serialise

from observers.network import MLP

MOST_BYTES = 256 * 2**20  # size of the largest file in bytes; the shipped maps have up to 350,000 bytes
MOST_HEADER = 2**20  # largest size in bytes of the header, which holds the JSON
DEEPEST = 32  # largest number of levels of nested objects and lists
UNFINISHED = ".part-"  # prefix of temporary files

# The types of arrays, by their safetensors names.
_TYPES: dict[str, np.dtype[Any]] = {"F32": np.dtype(np.float32), "F64": np.dtype(np.float64)}


@contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Put ``path`` into OSErrors that name the temporary file or, as on a full disk, no file."""
    try:
        yield
    except OSError as problem:
        if problem.errno and problem.filename in (None, str(temporary)):
            raise OSError(problem.errno, problem.strerror, str(path)) from problem
        raise


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary file to write, which replaces ``path`` once it is complete and on disk.

    The temporary file is in the same folder, which is created if missing. It has the permissions that the umask
    allows, and the suffix of ``path``, from which some writers choose a format. After an exception, it is deleted and
    ``path`` is unchanged. A killed process leaves it behind; :func:`training.files.clear_unfinished` removes it.
    """
    target = Path(path)
    temporary = target.with_name(f"{UNFINISHED}{secrets.token_hex(4)}-{target.stem}{target.suffix}")
    try:
        with naming(target, temporary):
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch(exist_ok=False)
            yield temporary
            with temporary.open("rb+") as written:
                os.fsync(written.fileno())
            os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    with suppress(OSError):  # not every system can open or sync a folder
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def save(
    path: str | os.PathLike[str], tensors: Mapping[str, np.ndarray], *, key: str, described: Mapping[str, Any]
) -> None:
    """Write arrays and their description to one file, atomically, and create its folder if it is missing."""
    arrays = {name: np.asarray(tensor, order="C") for name, tensor in tensors.items()}
    for name, array in arrays.items():
        if array.dtype not in _TYPES.values():
            raise TypeError(f"{name!r} is of type {array.dtype}, but {path} holds only float32 and float64: convert it")
    text = json.dumps(dict(described), sort_keys=True, allow_nan=False)
    header, data = _parts(serialise(arrays, metadata={key: text}))
    header["__metadata__"][f"{key}-sha256"] = hashlib.sha256(_whole(header, data)).hexdigest()
    content = _whole(header, data)
    if len(content) > MOST_BYTES or _header_size(content) > MOST_HEADER or _is_deeper(described, DEEPEST):
        raise ValueError(
            f"{path} would have {len(content)} bytes, {_header_size(content)} of them in its header; the limits are "
            f"{MOST_BYTES} and {MOST_HEADER}, and at most {DEEPEST} levels of nested objects and lists"
        )
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read(
    path: str | os.PathLike[str], *, key: str, error: type[Exception], what: str
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return arrays and description from a file of :func:`save`, or raise ``error``; ``what`` is the kind of file."""
    content = _content(path, error)
    try:
        views: list[tuple[str, dict[str, Any]]] = deserialize(content)  # type: ignore[no-untyped-call]
        header, data = _parts(content)
    except (SafetensorError, ValueError) as problem:
        raise error(f"{path} is damaged or not a safetensors file: {problem}") from problem
    metadata = header.get("__metadata__") or {}
    if key not in metadata:
        raise error(f"{path} is not {what} of kkl-gym: it has no {key!r} metadata")
    expected = metadata.pop(f"{key}-sha256", None)
    if expected is None:
        raise error(
            f"{path} lacks its checksum, the metadata {key}-sha256, without which damage would stay unnoticed: "
            "get the file again, or make it again with kkl-gym"
        )
    if set(metadata) != {key}:
        raise error(f"{path} is damaged: unknown metadata: {', '.join(sorted(set(metadata) - {key}))}")
    if expected != hashlib.sha256(_whole(header, data)).hexdigest():
        raise error(f"{path} is damaged: its content does not match its checksum; get it again")
    try:
        described = json.loads(metadata[key])
    except (ValueError, RecursionError) as problem:
        raise error(f"{path} is damaged: its {key!r} metadata is not JSON: {problem}") from problem
    if not isinstance(described, dict):
        raise error(f"{path} is damaged: its {key!r} metadata is not a JSON object")
    if _is_deeper(described, DEEPEST):
        raise error(f"{path} is damaged: its {key!r} metadata has more than {DEEPEST} levels")
    tensors = {}
    for name, view in views:
        if view["dtype"] not in _TYPES:
            raise error(f"{path}: its tensor {name} is of type {view['dtype']}, expected one of {', '.join(_TYPES)}")
        try:
            tensors[name] = np.frombuffer(view["data"], _TYPES[view["dtype"]]).reshape(view["shape"])
        except (ValueError, OverflowError) as problem:  # the file's shapes may not fit its data
            raise error(f"{path} is damaged: its tensor {name}: {problem}") from problem
    return tensors, described


def checksum(path: str | os.PathLike[str], error: type[Exception]) -> str:
    """Return the SHA-256 of a file, or raise ``error`` if it cannot be read."""
    return hashlib.sha256(_content(path, error)).hexdigest()


def _content(path: str | os.PathLike[str], error: type[Exception]) -> bytes:
    """Return the bytes of a file, after checks of its type and size."""
    try:
        if not Path(path).is_file():  # reading a pipe may never end
            is_other = Path(path).exists()
            raise error(f"{path} is a folder, a pipe or a device" if is_other else f"there is no file {path}")
        if (size := Path(path).stat().st_size) > MOST_BYTES:
            raise error(f"{path} has {size} bytes, more than the {MOST_BYTES} that a file of kkl-gym may have")
        content = Path(path).read_bytes()  # not memory-mapped: rewriting a mapped file would crash this process
    except OSError as problem:
        raise error(f"{path} cannot be read: {problem.strerror or problem}") from problem
    if (size := _header_size(content)) > MOST_HEADER:
        raise error(f"{path} is damaged or not a safetensors file: its header has {size} bytes, limit {MOST_HEADER}")
    return content


def _header_size(content: bytes) -> int:
    return int.from_bytes(content[:8], "little")


def _parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header and the arrays' bytes of a safetensors file."""
    end = 8 + _header_size(content)
    return json.loads(content[8:end]), content[end:]


def _whole(header: Mapping[str, Any], data: bytes) -> bytes:
    """Return the bytes of a safetensors file; the library itself would write the metadata in random order."""
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data


def _is_deeper(value: Any, levels: int) -> bool:
    """Whether objects and lists are nested more than ``levels`` deep."""
    inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else None
    return inner is not None and (levels == 0 or any(_is_deeper(one, levels - 1) for one in inner))


@contextmanager
def explained(path: str | os.PathLike[str], error: type[ValueError]) -> Iterator[None]:
    """Convert exceptions from invalid contents of a file into an error that names the file."""
    try:
        yield
    except KeyError as problem:
        raise error(f"{path} is incomplete: it lacks {problem}") from problem
    except ValueError as problem:
        raise error(f"{path}: {problem}") from problem
    except (TypeError, IndexError, AttributeError, OverflowError, RecursionError) as problem:
        raise error(f"{path} is damaged: {problem!r}; get it again") from problem


def put_mlp(tensors: MutableMapping[str, np.ndarray], prefix: str, mlp: MLP) -> None:
    """Add a network's weights and biases to the arrays of a file."""
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        tensors[f"{prefix}{i}.weight"], tensors[f"{prefix}{i}.bias"] = weight, bias


def get_mlp(tensors: Mapping[str, np.ndarray], prefix: str, activation: str) -> MLP:
    """Return the network that :func:`put_mlp` added."""
    matches = (re.fullmatch(rf"{re.escape(prefix)}(\d+)\.(weight|bias)", name) for name in tensors)
    layers = range(len({match[1] for match in matches if match}))
    return MLP(
        [tensors[f"{prefix}{i}.weight"] for i in layers], [tensors[f"{prefix}{i}.bias"] for i in layers], activation
    )
