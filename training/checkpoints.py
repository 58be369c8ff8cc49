"""Checkpoints: tensors and plain values in torch's own format, of which loading runs nothing and damage is noticed."""

import io
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from observers.storage import replacing

SECONDS = 20.0  # between two checkpoints, at least
SUFFIX = ".checkpoint.pt"


def save(path: Path, state: Mapping[str, Any], *, fingerprint: str) -> None:
    """Write a checkpoint, whole or not at all."""
    content = io.BytesIO()  # torch reports a full disk as "unexpected pos"
    torch.save({**state, "fingerprint": fingerprint}, content)
    with replacing(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def load(path: Path, *, fingerprint: str | None = None) -> dict[str, Any]:
    """Read a checkpoint."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"the checkpoint {path} cannot be read: {error.strerror}") from error
    with restoring(path):
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            if part := file.testzip():  # torch writes the checksums of its parts, and does not check them
                raise ValueError(f"the checksum of {part} is wrong")
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        belongs_to = state.pop("fingerprint")
    if fingerprint not in (None, belongs_to):
        raise ValueError(f"the checkpoint {path} belongs to another configuration; train into another folder")
    return dict(state)


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Turn errors while a checkpoint's state is restored into one that names the file."""
    try:
        yield
    except Exception as error:  # pickle, zip and torch raise many kinds
        line = (str(error) if not isinstance(error, KeyError) else f"it lacks {error}").partition("\n")[0]
        raise ValueError(
            f"the checkpoint {path} is damaged or of another version, remove it to train that stage again: {line}"
        ) from error
