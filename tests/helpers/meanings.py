"""What a value means where it comes in, by rules that are not the package's own.

A meaning is a function: from a value to whether it is right there, and to the plain value that it then is the same as.
"""

from collections import deque
from collections.abc import Mapping

import numpy as np
from bad_values import number, numbers
from gymnasium.vector import AutoresetMode

from kkl_gym import SYSTEMS, System


def array(right, optional=False):
    """An array of real numbers for which ``right`` holds."""

    def means(value):
        found = numbers(value)
        return (True, None) if optional and value is None else (found is not None and bool(right(found)), found)

    return means


def within(shape, most=1e15):
    """Of an array: whether it has that shape and such entries."""
    return lambda values: values.shape == shape and (np.abs(values) <= most).all()


def real(right, optional=False):
    """A real number for which ``right`` holds."""

    def means(value):
        found = number(value)
        return (True, None) if optional and value is None else (found is not None and bool(right(found)), found)

    return means


def whole(least, most=np.inf, optional=False):
    """An integer."""

    def means(value):
        if optional and value is None:
            return True, None
        right = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
        return (True, int(value)) if right and least <= value <= most else (False, None)

    return means


def bools(shape, optional=False):
    """An array of bools."""

    def means(value):
        if optional and value is None:
            return True, None
        masked = isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any()
        found = np.asarray(value)
        return found.dtype == bool and found.shape == shape and not masked, found

    return means


def mapping(right):
    """A mapping, or None."""
    return lambda value: (value is None or (isinstance(value, Mapping) and right(value)), value)


def one_of(*options):
    """One of some strings and None."""
    return lambda value: ((value is None or isinstance(value, str)) and value in options, value)


def instance(kind):
    """An object of a class."""
    return lambda value: (isinstance(value, kind), value)


def flag(value):
    right = isinstance(value, bool | np.bool_)
    return right, bool(value) if right else None


def nothing(_):
    return False, None


def level(value):
    """A level of noise, or None for the default."""
    return real(lambda sigma: 0 <= sigma <= 1e12, optional=True)(value)


def levels(most=1e12, optional=True):
    """Levels of measurement noise where there is one output."""

    def means(value):
        alone = isinstance(value, list | tuple | np.ndarray) and np.shape(value) == (1,)
        return real(lambda sigma: 0 <= sigma <= most, optional and not alone)(value[0] if alone else value)

    return means


def parameters(value):
    """Parameters of Van der Pol's oscillator."""
    finite = real(np.isfinite)
    return mapping(lambda given: set(given) <= {"mu"} and all(finite(entry)[0] for entry in given.values()))(value)


def system(value):
    if isinstance(value, str):
        return value in SYSTEMS, str(value)
    return isinstance(value, System) or value in SYSTEMS.values(), value


def mode(value):
    """An autoreset mode."""
    names = {known.value: known for known in AutoresetMode}
    if isinstance(value, AutoresetMode):
        return True, value
    return isinstance(value, str) and value in names, names.get(value)


def seeds(n):
    """Of n environments: one seed, or one for each."""

    def means(value):
        if value is None or whole(0)(value)[0]:
            return True, value
        if isinstance(value, np.ndarray) and value.ndim == 0:
            return whole(0)(value[()])
        many = list(value) if isinstance(value, list | tuple | range | deque | np.ndarray) else []
        return len(many) == n and all(whole(0, optional=True)(one)[0] for one in many), many

    return means


def start_box(value):
    """A box of Van der Pol's states."""
    low, high = np.array(SYSTEMS["van_der_pol"].bounds).T

    def right(box):
        return (
            box.shape == (2, 2)
            and (low <= box[:, 0]).all()
            and (box[:, 0] <= box[:, 1]).all()
            and (box[:, 1] <= high).all()
        )

    return array(right, optional=True)(value)


def start(*rows):
    """States of Van der Pol's oscillator; with a number of rows, one for all or one for each."""
    low, high = np.array(SYSTEMS["van_der_pol"].bounds).T
    shapes = {(2,), (*rows, 2)}
    return array(lambda x: x.shape in shapes and ((x >= low) & (x <= high)).all(), optional=True)


def options(*rows):
    """What a reset takes."""
    return mapping(lambda given: set(given) <= {"x0"} and start(*rows)(given.get("x0"))[0])


def mask(n):
    """Which of n environments to reset, or None for all."""

    def means(value):
        right, found = bools((n,), optional=True)(value)
        return right and (found is None or found.any()), found

    return means


def time_constants(values):
    """Of an array: whether a memory can have these time constants."""
    return (
        values.ndim == 1
        and values.size
        and values.min() >= 0.5
        and values.max() <= 1e4
        and ((values[1:] >= 1.5 * values[:-1]).all())
    )


def actions(*shape):
    return array(lambda values: values.shape == shape and not np.isnan(values).any())
