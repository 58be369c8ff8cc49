"""Checks of arguments. They reject values that Python or NumPy would silently convert to numbers."""

import math
from collections.abc import Collection, Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.ma import MaskedArray, is_masked

_FLOAT = np.dtype(float)  # arrays of float64 share this dtype object, and `is` is the fastest comparison
LARGEST = 1e15  # largest absolute value of an output or input; larger values could overflow in float32
_NO_NUMBERS = (bool, np.timedelta64)  # types that count as integers in Python and NumPy, but are no numbers
_TEXTS = (str, bytes, bytearray, memoryview)  # sequences that are not lists of numbers
_LARGEST_LEVEL = 1e12  # largest noise level; with this noise, outputs stay far below LARGEST


class ArtifactError(ValueError):
    """Raised for invalid, corrupt or incompatible artifacts and their files."""


def check_shapes(owner: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ArtifactError unless ``owner`` has attributes of these shapes; the keys of ``shapes`` are their names."""
    for name, shape in shapes.items():
        if (given := getattr(owner, name).shape) != shape:
            raise ArtifactError(f"{name} does not fit the other parts: it must have shape {shape}, got {given}")


def shown(value: object) -> str:
    """Return the text of a value for error messages: one line, shortened if it is long."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # for example, repr raises ValueError for integers of more than 4,300 digits
        return f"a {type(value).__name__}"
    return text if len(text) <= 200 else f"{text[:150]} … {text[-40:]}"


def is_finite(value: object) -> bool:
    """Whether a value is a finite real number; bools and time intervals are not."""
    try:
        return isinstance(value, Real) and not isinstance(value, _NO_NUMBERS) and math.isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def all_finite(values: np.ndarray, largest: float = LARGEST) -> bool:
    """Whether outputs or inputs are finite and at most ``largest`` in absolute value."""
    if values.ndim == 1:  # fast path for one sample
        for value in values.tolist():  # noqa: SIM110 - a generator is slower
            if not -largest <= value <= largest:  # NaN fails the comparison
                return False
        return True
    if np.vdot(values, values) <= largest**2:  # a fast, sufficient test, which NaN fails
        return True
    return bool((np.abs(values) <= largest).all())


def noise_level(name: str, level: Any) -> float:
    """Return a noise level as a float, or raise ValueError."""
    if not is_finite(level) or level < 0:
        raise ValueError(f"{name} must be a finite number, not negative, got {shown(level)}")
    level = float(level)
    if level > _LARGEST_LEVEL:
        raise ValueError(f"{name} must be at most {_LARGEST_LEVEL:g}, got {level!r}: use larger units")
    return level


def noise_levels(name: str, levels: Any, ny: int) -> float | tuple[float, ...]:
    """Return noise levels as one float for all outputs or a tuple with one for each, or raise ValueError."""
    if not isinstance(levels, list | tuple | np.ndarray) or (isinstance(levels, np.ndarray) and levels.ndim == 0):
        return noise_level(name, levels)
    if len(levels) != ny:
        raise ValueError(f"{name} must be one number, or one for each of {ny} outputs, got {shown(levels)}")
    each = tuple(noise_level(f"{name}[{i}]", level) for i, level in enumerate(levels))
    return each[0] if len(set(each)) == 1 else each


def check_dt(dt: Any) -> float:
    """Return a sampling interval as a float, or raise ValueError."""
    if not is_finite(dt) or not float(dt) > 0:
        raise ValueError(f"dt must be a positive, finite number of seconds, got {shown(dt)}")
    return float(dt)


def integer(name: str, value: Any, least: int, most: int | None = None) -> int:
    """Return a whole number as an int, or raise ValueError."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, _NO_NUMBERS)
    if not whole or value < least or (most is not None and value > most):
        wanted = "a positive integer" if least == 1 else "an integer, not negative"
        if most is not None:
            wanted = f"an integer from {least} to {most:,}"
        raise ValueError(f"{name} must be {wanted}, got {shown(value)}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return a bool, or raise ValueError: Python would take a text such as "no" as true."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def choice(name: str, value: Any, options: Collection[str]) -> str:
    """Return a string that is one of ``options``, or raise ValueError."""
    if not isinstance(value, str) or value not in options:
        raise ValueError(f"{name} must be {' or '.join(repr(option) for option in options)}, got {shown(value)}")
    return value


def mapping(name: str, value: Any) -> Mapping[Any, Any]:
    """Return a mapping, an empty one for None, or raise ValueError."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a dict, got {shown(value)}")
    return value


def real_array(name: str, values: Any) -> np.ndarray:
    """Return numbers as an array of float64, or raise ValueError."""
    if type(values) is np.ndarray:
        if values.dtype is _FLOAT:
            return values
        if values.dtype.kind in "fiu" and values.dtype.itemsize <= 8:
            return values.astype(float)
    elif isinstance(values, MaskedArray) and is_masked(values):
        raise ValueError(f"{name} holds masked entries: {shown(values)}; give them values")
    try:
        if _of_numbers(values):
            array = np.asarray(values)
            if array.dtype is _FLOAT:
                return array
            if array.dtype.kind in "fiu":
                with np.errstate(over="ignore"):  # callers reject infinite values
                    return array.astype(float)
    except Exception as error:  # for ragged lists, and for objects whose __array__ fails
        raise ValueError(f"{name} must hold real numbers in the shape of an array, got {shown(values)}") from error
    raise ValueError(f"{name} must hold real numbers, got {shown(values)}")


def _of_numbers(values: Any) -> bool:
    """Whether nested sequences hold only numbers; NumPy would convert True to 1 and drop masks."""
    if type(values) is list or isinstance(values, Sequence):
        if isinstance(values, _TEXTS):
            return False
        for value in values:
            if type(value) is not float and type(value) is not int and not _of_numbers(value):
                return False
        return True
    if isinstance(values, MaskedArray) and is_masked(values):
        return False
    return np.asarray(values).dtype.kind in "fiu"


def bool_array(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of bools, or raise ValueError."""
    try:
        array = values if type(values) is np.ndarray else np.asarray(values)
    except Exception as error:  # for ragged lists, and for objects whose __array__ fails
        raise ValueError(f"{name} must be boolean with shape {shape}, got {shown(values)}") from error
    if array.dtype.kind != "b" or array.shape != shape or (isinstance(values, MaskedArray) and is_masked(values)):
        raise ValueError(f"{name} must be boolean with shape {shape}, nothing masked, got {shown(values)}")
    return array
