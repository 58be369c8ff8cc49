"""Levels of measurement noise: parsing, formatting, and the range that a map was trained for."""

from collections.abc import Sequence

import numpy as np

from kkl_gym.system import System
from observers import Artifact
from observers.checks import noise_levels

Level = float | tuple[float, ...]  # standard deviation of the noise on y: one for all outputs, or one for each


def read_level(text: str) -> Level:
    """Parse a level: one number, or one for each output, separated by commas."""
    try:
        levels = tuple(float(number) for number in text.split(","))
    except ValueError:
        raise ValueError(
            f"{text!r} is no level of noise: write a number, or one for each output, as in 0.1,0.3"
        ) from None
    return levels[0] if len(levels) == 1 else levels


def show_level(level: float | Sequence[float]) -> str:
    """Format a level for tables and titles: ``0.5``, or ``0.1, 0.3`` where it differs by output."""
    return ", ".join(f"{each:g}" for each in np.atleast_1d(level))


def as_cell(level: Level) -> float | str:
    """Return a level as CSV files hold it: a number, or a text where it differs by output."""
    return show_level(level) if isinstance(level, tuple) else level


def multiple(system: System, factor: float) -> Level:
    """Return a multiple of a system's own level of measurement noise."""
    return noise_levels("measurement_noise", np.multiply(factor, system.measurement_noise), system.ny)


def level_for(artifact: Artifact, system: System, given: Level | None = None) -> Level:
    """Return ``given``; else the system's level (its largest if the map takes only one), limited to the map's range."""
    if given is not None:
        return noise_levels("measurement_noise", given, system.ny)
    own = multiple(system, 1.0)
    try:
        return artifact.inverse.within(own)
    except ValueError:
        return artifact.inverse.within(float(np.max(own)))


def beyond(artifact: Artifact, level: Level) -> str:
    """Return the reason why a level of measurement noise is invalid for a map, or an empty text."""
    try:
        if artifact.inverse.within(level) == level:
            return ""
    except ValueError as error:
        return str(error)
    ranges = ", ".join(f"0 to {largest:g}" for largest in np.atleast_1d(artifact.inverse.measurement_noise_max))
    return f"measurement noise {show_level(level)} is beyond the map's range, {ranges}"
