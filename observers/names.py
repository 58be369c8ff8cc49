"""Names of the maps that ship, and the files behind them."""

import os
import re
from importlib.resources import files
from pathlib import Path

from observers.checks import shown
from observers.errors import ArtifactError


def shipped() -> dict[str, str]:
    """Return the names of the maps that ship with the package: ``{"van_der_pol": "van_der_pol-v2", ...}``.

    Returns
    -------
    dict of str to str
        The name of a file, without its ending, by name. Every version that was released is there under its full name;
        the name without a version is the newest.
    """
    versions: dict[str, list[int]] = {}
    for entry in files("observers").joinpath("maps").iterdir():
        match = re.fullmatch(r"(.+)-v(\d+)\.safetensors", entry.name)
        if match:
            versions.setdefault(match[1], []).append(int(match[2]))
    names = {}
    for name, numbers in sorted(versions.items()):
        names[name] = f"{name}-v{max(numbers)}"
        names.update({f"{name}-v{number}": f"{name}-v{number}" for number in numbers})
    return names


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
    return Path(str(files("observers").joinpath("maps", f"{names[text]}.safetensors")))


__all__ = ["resolve", "shipped"]
