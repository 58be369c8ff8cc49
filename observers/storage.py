"""Files of ours: each appears whole or not at all, holds arrays and JSON alone, and says what is wrong with it.

A file of arrays is in the safetensors format; a JSON object that describes them lies in its metadata under a key of its
kind. Nothing in it can run.
"""

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

# All that files hold, as safetensors calls it.
_TYPES: dict[str, np.dtype[Any]] = {"F32": np.dtype(np.float32), "F64": np.dtype(np.float64)}


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary file to write, which takes the place of ``path`` once it is whole and on disk.

    The temporary file lies in the same folder, which is made. It keeps the ending of the name, by which some writers
    choose a format, and has the rights that the umask gives. After an exception it is gone, and ``path`` is as it was.

    Parameters
    ----------
    path : str or PathLike
        The file to write.

    Yields
    ------
    Path
        The temporary file, empty.

    Raises
    ------
    OSError
        If the file cannot be written or put in its place.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    with suppress(OSError):  # not every system can open a folder, or put it on disk
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all; makes its folder."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def save(
    path: str | os.PathLike[str], tensors: Mapping[str, np.ndarray], *, key: str, described: Mapping[str, Any]
) -> None:
    """Write arrays and what describes them to one file, whole or not at all; makes its folder.

    Parameters
    ----------
    path : str or PathLike
        The file to write.
    tensors : mapping of str to ndarray
        Arrays of float32 or float64, of any shapes.
    key : str
        Names the kind of file; :func:`read` asks for it.
    described : mapping
        What JSON can hold, numbers finite.

    Raises
    ------
    TypeError
        If an array is not of float32 or float64, or ``described`` is nothing that JSON can hold.
    ValueError
        If a number in ``described`` is not finite.
    OSError
        If the file cannot be written.
    """
    arrays = {name: np.asarray(tensor, order="C") for name, tensor in tensors.items()}
    for name, array in arrays.items():
        if array.dtype not in _TYPES.values():
            raise TypeError(f"{name!r} is of type {array.dtype}, {path} can hold float32 and float64: convert it")
    text = json.dumps(dict(described), sort_keys=True, allow_nan=False)
    content = serialise(arrays, metadata={key: text})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read(
    path: str | os.PathLike[str], *, key: str, error: type[Exception], what: str
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what :func:`save` wrote.

    Parameters
    ----------
    path : str or PathLike
        The file to read.
    key : str
        The kind of file, as it was saved.
    error : type of Exception
        Raised, with a message that names the file, if it cannot be read.
    what : str
        The kind of file for the message, "an observer".

    Returns
    -------
    tensors : dict of str to ndarray
        The arrays, float32 or float64.
    described : dict
        What describes them; nobody has checked it.

    Raises
    ------
    error
        If the file is missing, not readable, damaged or of another kind, or an array is not of float32 or float64.
    """
    try:
        if not Path(path).is_file():
            raise error(f"there is no file {path}")
        content = Path(path).read_bytes()  # as a whole: who rewrites a mapped file in place ends the process
    except OSError as problem:
        raise error(f"{path} cannot be read: {problem.strerror or problem}") from problem
    try:
        views: list[tuple[str, dict[str, Any]]] = deserialize(content)  # type: ignore[no-untyped-call]
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    except (SafetensorError, ValueError) as problem:
        raise error(f"{path} is damaged or no safetensors file: {problem}") from problem
    text = (header.get("__metadata__") or {}).get(key)
    if text is None:
        raise error(f"{path} is not {what} of kkl-gym: it carries no {key!r} metadata")
    try:
        described = json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"{path} is damaged: its {key!r} metadata is no JSON: {problem}") from problem
    if not isinstance(described, dict):
        raise error(f"{path} is damaged: its {key!r} metadata is no JSON object")
    tensors = {}
    for name, view in views:
        if view["dtype"] not in _TYPES:
            raise error(f"{path}: its tensor {name} is of type {view['dtype']}, expected one of {', '.join(_TYPES)}")
        tensors[name] = np.frombuffer(view["data"], _TYPES[view["dtype"]]).reshape(view["shape"])
    return tensors, described


@contextmanager
def explained(path: str | os.PathLike[str], error: type[ValueError]) -> Iterator[None]:
    """Turn whatever goes wrong while something is made of a file's contents into an error that names the file.

    Parameters
    ----------
    path : str or PathLike
        The file.
    error : type of ValueError
        What to raise instead.

    Raises
    ------
    error
        If the body raises what contents that are missing, of a wrong type or out of range lead to.
    """
    try:
        yield
    except KeyError as problem:
        raise error(f"{path} is incomplete: it lacks {problem}") from problem
    except ValueError as problem:
        raise error(f"{path}: {problem}") from problem
    except (TypeError, IndexError, AttributeError, OverflowError, RecursionError) as problem:
        raise error(f"{path} is damaged: {problem!r}") from problem


def put_mlp(tensors: MutableMapping[str, np.ndarray], prefix: str, mlp: MLP) -> None:
    """Add a network's weights and biases to the arrays of a file, as float32.

    Parameters
    ----------
    tensors : mutable mapping of str to ndarray
        Gains ``{prefix}0.weight``, ``{prefix}0.bias``, ``{prefix}1.weight``, ...
    prefix : str
        Of the names, a dot at its end included; may be empty.
    mlp : MLP
        The network. Its activation is for the file's description.
    """
    for i, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        tensors[f"{prefix}{i}.weight"] = np.asarray(weight, dtype=np.float32)
        tensors[f"{prefix}{i}.bias"] = np.asarray(bias, dtype=np.float32)


def get_mlp(tensors: Mapping[str, np.ndarray], prefix: str, activation: str) -> MLP:
    """Return the network that :func:`put_mlp` added.

    Parameters
    ----------
    tensors : mapping of str to ndarray
        The arrays of a file, others among them.
    prefix : str
        As it was put.
    activation : str
        As the file's description has it.

    Returns
    -------
    MLP
        The network.

    Raises
    ------
    KeyError
        If a weight or a bias of a layer is missing.
    ValueError
        If there is none, or the layers make no network.
    """
    found = (re.fullmatch(rf"{re.escape(prefix)}(\d+)\.(weight|bias)", name) for name in tensors)
    layers = range(len({match[1] for match in found if match}))
    return MLP(
        [tensors[f"{prefix}{i}.weight"] for i in layers], [tensors[f"{prefix}{i}.bias"] for i in layers], activation
    )
