"""Check and complete the class variables of a user's system when its class is defined."""

import dataclasses
import inspect
import math
from numbers import Integral, Real
from typing import Any

import numpy as np

from kkl_gym.equation_errors import METHODS, is_sequence

_METHODS = (*METHODS, "draw_starts", "box", "output", "drift", "replace")
_SIZES = {"nx": "X", "nu": "u_max", "ny": "h(x)", "parameters": "the fields"}


def complete(cls: Any, base: Any) -> None:
    """Check a system's class variables, convert sequences to tuples, and give missing variables their defaults."""
    _check_names(cls, base)
    _read_box(cls)
    nx = len(cls.X)
    _read(cls, "u_max", "a tuple of positive numbers, one for each input, as in (1.0,)", (None,), above=0.0)
    cls.discrete = cls.step is not base.step
    if cls.discrete and cls.dt is base.dt:
        raise TypeError(f"{cls.__name__} defines step and must set dt, the sampling interval in seconds")
    _check_inputs(cls, base)
    # A subclass without its own X keeps its parent's box, and the values derived from it.
    if "X" in vars(cls):
        defaults = {
            "scale": tuple((high - low) / 2 for low, high in cls.X),
            "state_names": tuple(f"x{i + 1}" for i in range(nx)),
            "X_centre": tuple((low + high) / 2 for low, high in cls.X),
        }
        for name, default in defaults.items():
            if not _size(vars(cls).get(name, ())):
                setattr(cls, name, default)
    _read(cls, "scale", f"{nx} positive numbers, one for each state", (nx,), above=0.0)
    _read(cls, "X_centre", f"{nx} finite numbers, one for each state", (nx,))
    portrait = cls.portrait
    if not _is_row(portrait, 2, Integral) or any(isinstance(i, bool) or not -nx <= i < nx for i in portrait):
        raise _wrong(cls, "portrait", f"two indices of its {nx} states, as in (0, {nx - 1})")
    if not _is_row(cls.state_names, nx, str):
        raise _wrong(cls, "state_names", f"a tuple of {nx} texts, one for each state")
    level = "a number, not below zero"
    _read(cls, "process_noise", level, (), least=0.0)
    _read(cls, "dt", "a positive number of seconds", (), above=0.0)
    shape = () if isinstance(cls.measurement_noise, Real) else (None,)
    _read(cls, "measurement_noise", f"{level}, or one for each output", shape, least=0.0)


def _check_names(cls: Any, base: Any) -> None:
    """Raise TypeError if a class variable is missing, or a definition does not do what the user probably intended."""
    missing = [name for name in ("name", "X", "bounds") if not hasattr(cls, name)]
    if missing:
        raise TypeError(f"{cls.__name__} must set the class variables name, X and bounds; it lacks {missing[0]}")
    name = cls.name
    if not isinstance(name, str) or not name.strip() or {"/", "\\", ":"} & set(name):
        raise _wrong(cls, "name", "a non-empty text without slashes and colons, because it names files")
    if "name" not in vars(cls) and {"f", "g", "h", "step", "X"} & vars(cls).keys():
        raise TypeError(f"{cls.__name__} differs from the system {name!r} and needs a name of its own")
    variables = inspect.get_annotations(base)
    for name, kind in inspect.get_annotations(cls).items():
        if "ClassVar" not in str(kind) and (name in variables or hasattr(base, name)):
            raise TypeError(
                f"{cls.__name__}: {name} is annotated as a parameter, but System.{name} is not a parameter: "
                f"write {name}: ClassVar = ..., or give the parameter another name"
            )
    makers = [each for each in cls.__mro__ if "__init__" in vars(each) and each not in (base, object)]
    if any("__dataclass_fields__" not in vars(each) for each in makers):
        raise TypeError(
            f"{cls.__name__} defines __init__, and a copy would lack what __init__ sets: write the parameters as "
            "annotated fields under @dataclass(frozen=True), and values derived from them as properties"
        )
    # All fields in this loop are inherited, because the dataclass decorator adds the subclass's own fields only later.
    for name in (field.name for field in dataclasses.fields(cls)):
        first = next((each for each in cls.__mro__ if name in vars(each)), base)
        if first is not base and name not in inspect.get_annotations(first):
            raise TypeError(
                f"{cls.__name__}: {name} = {vars(first)[name]!r} does not change the parameter {name}: write "
                f"{name}: float = {vars(first)[name]!r} under @dataclass(frozen=True)"
            )
    for name in _METHODS:
        if name in vars(cls) and not callable(getattr(cls, name)):
            raise _wrong(cls, name, f"a method; a parameter {name} needs another name")
    for name, source in _SIZES.items():
        if name in vars(cls):
            raise TypeError(f"{cls.__name__}: {name} = {vars(cls)[name]!r} follows from {source}: leave it out")


def _read_box(cls: Any) -> None:
    pairs = "(low, high) for each state, as in ((-1.0, 1.0), (-2.0, 2.0))"
    for name in ("X", "bounds"):
        _read(cls, name, pairs, (None, 2))
        for i, (low, high) in enumerate(getattr(cls, name)):
            if not low < high:
                raise _wrong(cls, f"{name}[{i}]", "(low, high) with low < high", (low, high))
    if not cls.X:
        raise _wrong(cls, "X", pairs)
    if len(cls.bounds) != len(cls.X):
        raise TypeError(f"{cls.__name__}: X has {len(cls.X)} states and bounds has {len(cls.bounds)}")
    for i, ((low, high), (lower, upper)) in enumerate(zip(cls.X, cls.bounds, strict=True)):
        if not lower <= low < high <= upper:
            raise _wrong(cls, f"X[{i}]", f"within bounds[{i}] = {(lower, upper)}", (low, high))


def _check_inputs(cls: Any, base: Any) -> None:
    nx, nu = len(cls.X), len(cls.u_max)
    if nu == 0 and ("g" in vars(cls) or _size(vars(cls).get("G", ()))):
        given = "g(x)" if "g" in vars(cls) else f"G = {cls.G!r}"
        raise TypeError(f"{cls.__name__}: {given} needs u_max, the bound of each input; without it there are no inputs")
    if nu and cls.g is base.g and not cls.discrete:
        _read(cls, "G", f"{nx} rows of {nu} numbers, for {nx} states and {nu} inputs; or override g(x)", (nx, nu))


def _read(
    cls: Any,
    name: str,
    wanted: str,
    shape: tuple[int | None, ...],
    *,
    above: float = -math.inf,
    least: float = -math.inf,
) -> None:
    """Check the shape and the limits of a class variable, and convert a sequence to tuples."""
    # Properties are not checked. X, bounds and u_max must not be properties, because other checks use their values.
    if isinstance(getattr(cls, name), property) and name not in ("X", "bounds", "u_max"):
        return
    try:
        numbers = _numbers(getattr(cls, name), shape)
    except (ValueError, OverflowError):
        raise _wrong(cls, name, wanted) from None
    if any(number <= above or number < least for number in np.ravel(numbers)):
        raise _wrong(cls, name, wanted)
    if name in vars(cls):
        setattr(cls, name, numbers)


def _numbers(value: Any, shape: tuple[int | None, ...]) -> Any:
    """Return numbers as nested tuples; ValueError unless they are finite and have this shape (None: any length)."""
    if not shape:
        if isinstance(value, bool | np.bool_) or not isinstance(value, Real) or not math.isfinite(value):
            raise ValueError
        return value if isinstance(value, int) else float(value)
    length, *inner = shape
    if not _is_row(value, length):
        raise ValueError
    return tuple(_numbers(entry, tuple(inner)) for entry in value)


def _is_row(value: Any, length: int | None, kind: Any = object) -> bool:
    """Whether a value is a sequence of this length (None: any) with entries of this kind."""
    return is_sequence(value) and length in (None, len(value)) and all(isinstance(entry, kind) for entry in value)


def _size(value: Any) -> int:
    """Return the number of entries in a value, in all rows together."""
    return np.array(value, dtype=object).size


def _wrong(cls: Any, name: str, wanted: str, value: Any = None) -> TypeError:
    value = getattr(cls, name) if value is None else value
    return TypeError(f"{cls.__name__}: {name} = {value!r} must be {wanted}")
