"""Load an observer by the name of a shipped map, or from a file."""

import os
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path

from observers.artifact import Artifact
from observers.checks import ArtifactError, shown
from observers.observer import KKLObserver


def load(
    name_or_path: str | os.PathLike[str],
    measurement_noise: float | Sequence[float] | None = None,
    *,
    process_noise: float | None = None,
    monitor: bool = False,
    tracking: bool | None = None,
    compiled: bool | None = None,
    gate: float | None = None,
    delay: int = 0,
) -> KKLObserver:
    """Load an observer.

    Parameters
    ----------
    name_or_path : str or PathLike
        A shipped name (``"van_der_pol"``, ``"lorenz-spinn"``) or a ``.safetensors`` file.
    measurement_noise, process_noise, monitor, tracking, compiled, gate, delay
        As for :class:`KKLObserver`.

    Returns
    -------
    KKLObserver
        The observer; call :meth:`KKLObserver.reset` before its first step.

    Raises
    ------
    ArtifactError, ImportError, ValueError
        If no such name or file exists, the file is damaged or of another kind, or KKLObserver rejects an argument.
    """
    return KKLObserver(
        Artifact.read(resolve(name_or_path)),
        measurement_noise,
        process_noise=process_noise,
        monitor=monitor,
        tracking=tracking,
        compiled=compiled,
        gate=gate,
        delay=delay,
    )


def shipped() -> tuple[str, ...]:
    """Return the names of the maps that ship with the package.

    Returns
    -------
    tuple of str
        The names for :func:`observers.load`, sorted.
    """
    return tuple(sorted(path.stem for path in _maps().glob("*.safetensors")))


def resolve(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the path of a shipped map from its name, or a given path unchanged."""
    text = os.fspath(name_or_path) if isinstance(name_or_path, str | os.PathLike) else None
    if not isinstance(text, str):
        raise ArtifactError(f"an observer is a shipped name or a path, got {shown(name_or_path)}")
    if text.endswith(".safetensors"):
        return Path(text)
    names = shipped()
    if ":" in text or text.endswith(".py"):
        raise ArtifactError(f"{text} names a system; pass its observer's file, such as runs/NAME/NAME.safetensors")
    if (name := matching(text, names)) is None:
        raise ArtifactError(
            f"unknown observer {shown(text)}{suggestion(text, names)}; shipped: {', '.join(names) or 'none'}; "
            "a file's name ends in .safetensors"
        )
    return _maps() / f"{name}.safetensors"


def matching(text: str, names: Iterable[str]) -> str | None:
    """Return the name that matches a text, or None; case, underscores, prefix "KKL" and suffix "-v0" do not matter."""
    return {_plain(name): name for name in names}.get(_plain(text.lower().removeprefix("kkl").removesuffix("-v0")))


def suggestion(text: str, names: Iterable[str]) -> str:
    """Return a hint for error messages: the name closest to a text, if any name is close."""
    close = get_close_matches(text, list(names), n=1)
    return f", did you mean {close[0]!r}?" if close else ""


def _plain(name: str) -> str:
    return name.lower().replace("_", "")


def _maps() -> Path:
    return Path(str(files("observers").joinpath("maps")))
