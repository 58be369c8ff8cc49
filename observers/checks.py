"""What observers take from outside: real numbers, and nothing that Python or NumPy would quietly turn into one."""

import math
from numbers import Real
from typing import Any

import numpy as np
from numpy.ma import MaskedArray, is_masked

_FLOAT = np.dtype(float)  # one object: to compare by identity is quick, and a step's cost would be felt


def is_finite(value: object) -> bool:
    """Whether a value is a real number, not a bool, that is finite as a float."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer beyond every float
        return False


def noise_level(name: str, level: Any) -> float:
    """Return a level of noise as a float.

    Parameters
    ----------
    name : str
        What it is the level of, for the message.
    level : float
        The level.

    Returns
    -------
    float
        The level.

    Raises
    ------
    ValueError
        If the level is no real number, not finite or negative.
    """
    if not is_finite(level) or level < 0:
        raise ValueError(f"{name} must be a finite number, not negative, got {level!r}")
    return float(level)


def noise_levels(name: str, levels: Any, ny: int) -> float | tuple[float, ...]:
    """Return levels of noise as one float for all outputs, or a tuple of one for each.

    Parameters
    ----------
    name : str
        What they are the levels of, for the message.
    levels : float or sequence of float, length ny
        The levels.
    ny : int
        Number of outputs.

    Returns
    -------
    float or tuple of float, length ny
        The levels; a float if all are the same.

    Raises
    ------
    ValueError
        If there are not ny levels, or one is no real number, not finite or negative.
    """
    if not isinstance(levels, list | tuple | np.ndarray) or (isinstance(levels, np.ndarray) and levels.ndim == 0):
        return noise_level(name, levels)
    if len(levels) != ny:
        raise ValueError(f"{name} must be one number, or one for each of {ny} outputs, got {levels!r}")
    each = tuple(noise_level(f"{name}[{i}]", level) for i, level in enumerate(levels))
    return each[0] if len(set(each)) == 1 else each


def real_array(name: str, values: Any) -> np.ndarray:
    """Return numbers as an array of float64.

    Parameters
    ----------
    name : str
        What the numbers are, for the message.
    values : array_like
        The numbers, of any shape.

    Returns
    -------
    ndarray
        The numbers; ``values`` itself if it is such an array already.

    Raises
    ------
    ValueError
        If there is anything but real numbers, or a masked entry.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} must hold real numbers, got type {array.dtype}: {values!r}")
    if array is not values and isinstance(values, MaskedArray) and is_masked(values):
        raise ValueError(f"{name} holds masked entries: {values!r}; give them values")
    return array if array.dtype is _FLOAT else array.astype(float)
