"""Names of the maps that ship, and the files behind them."""

import os
from importlib.resources import files
from pathlib import Path

from observers.checks import shown
from observers.errors import ArtifactError


def shipped() -> tuple[str, ...]:
    """Return the names of the maps that ship with the package.

    Returns
    -------
    tuple of str
        What :func:`observers.load` takes, sorted.
    """
    return tuple(sorted(path.stem for path in _maps().glob("*.safetensors")))


def resolve(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the file behind a name."""
    text = os.fspath(name_or_path) if isinstance(name_or_path, str | os.PathLike) else None
    if not isinstance(text, str):
        raise ArtifactError(f"an observer is a shipped name or a path, got {shown(name_or_path)}")
    if text.endswith(".safetensors"):
        return Path(text)
    names = shipped()
    if text not in names:
        raise ArtifactError(
            f"unknown observer {shown(text)}; shipped: {', '.join(names) or 'none'}; a file's name ends in .safetensors"
        )
    return _maps() / f"{text}.safetensors"


def _maps() -> Path:
    return Path(str(files("observers").joinpath("maps")))


__all__ = ["resolve", "shipped"]
