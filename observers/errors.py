"""Errors of artifacts."""

from collections.abc import Mapping
from typing import Any


class ArtifactError(ValueError):
    """Raised for invalid, corrupt or incompatible artifacts and their files."""


def check_shapes(owner: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ArtifactError unless the arrays of a map have these shapes."""
    for name, shape in shapes.items():
        if (given := getattr(owner, name).shape) != shape:
            raise ArtifactError(f"{name} does not fit the network: it must have shape {shape}, got {given}")
