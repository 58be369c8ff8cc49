"""What is wrong with a file, or with what it holds."""

from collections.abc import Mapping
from typing import Any


class ArtifactError(ValueError):
    """A file is no artifact of ours, is damaged, or does not fit where it is used."""


def check_shapes(owner: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ArtifactError unless the arrays of a map have these shapes."""
    for name, shape in shapes.items():
        found = getattr(owner, name).shape
        if found != shape:
            raise ArtifactError(f"{name} does not fit the network: it must have shape {shape}, got {found}")
