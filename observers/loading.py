"""Observers by the name of a map that ships, or by file."""

import os
from collections.abc import Sequence

from observers.artifact import Artifact
from observers.names import resolve
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
    """Return the observer behind a name.

    Parameters
    ----------
    name_or_path : str or PathLike
        A shipped name (``"van_der_pol"``, ``"lorenz-spinn"``) or a ``.safetensors`` file.
    measurement_noise, process_noise, monitor, tracking, compiled, gate, delay
        As for :class:`KKLObserver`.

    Returns
    -------
    KKLObserver
        The observer, which awaits :meth:`KKLObserver.reset`.

    Raises
    ------
    ArtifactError
        If there is no such name or file, or the file is damaged or foreign. It is a ValueError.
    ImportError
        If ``compiled`` is True and Numba is not installed.
    ValueError
        If a noise level is out of range, or a monitor is asked for and the file holds no limits.
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
