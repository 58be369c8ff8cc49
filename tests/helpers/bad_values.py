"""Values that somebody may pass by mistake, and what each means by rules that are not the package's own."""

import array
import math
from collections import deque
from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from numbers import Real
from pathlib import Path

import numpy as np
import pandas as pd

TEXTS = ("", "x", "0.5", "nan", "none", " ", "\0", "ä" * 5000, "../x", "os:getcwd", "a.py:B", ":", "..:x", "x\0.py:B")


class Stranger:
    """Refuses whatever it is asked."""

    def _refuse(self, *_args, **_kwargs):
        raise RuntimeError("a stranger's own error")

    __array__ = __float__ = __int__ = __index__ = __len__ = __iter__ = __getitem__ = __bool__ = __repr__ = _refuse


def itself():
    """A list that holds itself."""
    endless = []
    endless.append(endless)
    return endless


def deep():
    """A list in a list, a thousand times."""
    values = [0.5]
    for _ in range(1000):
        values = [values]
    return values


def _torch(values, **options):
    import torch

    return torch.tensor(values, **options)


def _sparse(values):
    from scipy.sparse import csr_matrix

    return csr_matrix(np.atleast_2d(values))


# Functions, as some can be used but once.
ATOMS = (
    *(lambda value=value: value for value in (
        None, True, False, 0, 1, -1, 2, 3, 10**400, -(10**400), 10**5000, 2**63, 2**64,
        0.0, -0.0, 0.5, -0.5, 1.0, 5e-324, 1e-300, 1e13, 1e16, 1e300, 1.7e308, -1e300, math.nan, math.inf, -math.inf,
        1 + 0j, 0.5j, Decimal("0.5"), Decimal("NaN"), Fraction(1, 2), Fraction(1, 10**400), Fraction(10**400, 3),
        np.float16(0.5), np.float32(0.5), np.float64(1.0), np.longdouble(0.5), np.longdouble("1e400"),
        np.int8(1), np.int64(3), np.uint64(2**64 - 1), np.bool_(True), np.str_("x"), np.bytes_(b"x"), np.complex64(1),
        np.datetime64("2020-01-01"), np.datetime64("NaT"), np.timedelta64(1, "s"), np.ma.masked, pd.NA, pd.NaT,
        b"", b"0.5", *TEXTS, ..., NotImplemented, len, int, float, np, Path("x"), Exception("x"), slice(1), range(2),
        frozenset({0.5}), Stranger, object(),
    )),
    Stranger, itself, deep, list, tuple, dict, set,
    lambda: bytearray(b"ab"), lambda: memoryview(b"ab"), lambda: memoryview(np.array([0.5])),
    lambda: {"a": 1}, lambda: {1: 2}, lambda: {0.5}, lambda: iter([0.5]), lambda: (value for value in [0.5]),
    lambda: deque([0.5]), lambda: deque([True, 0.5]), lambda: array.array("d", [0.5]), lambda: [None], lambda: [True],
    lambda: [True, 0.5], lambda: [[0.5], [0.5, 1.0]], lambda: ["0.5"], lambda: [b"0.5"], lambda: [Decimal(1)],
    lambda: [np.ma.array([0.5], mask=[True])], lambda: [np.ma.masked], lambda: [0.5, np.array([True])],
    lambda: [10**400], lambda: [2**64], lambda: np.empty(0), lambda: np.zeros((0, 3)), lambda: np.array(0.5),
    lambda: np.array([0.5]), lambda: np.array(True), lambda: np.array([0.5], object), lambda: np.array(["0.5"]),
    lambda: np.zeros(1, [("y", float)]), lambda: np.zeros((1, 1, 1)), lambda: np.array([1 + 1j]),
    lambda: np.array(["2020"], "datetime64[s]"), lambda: np.array([1], "timedelta64[s]"), lambda: np.array([b"1"]),
    lambda: pd.Series([0.5]), lambda: pd.Series([True]), lambda: pd.Series(["a"], dtype="category"),
    lambda: pd.Series([0.5, None], dtype="Float64"), lambda: pd.DataFrame({"a": [0.5]}), lambda: pd.Index([1]),
    lambda: _torch([0.5]), lambda: _torch(0.5), lambda: _torch([0.5], requires_grad=True), lambda: _sparse([[0.5]]),
)  # fmt: skip

ENTRIES = (math.nan, math.inf, -math.inf, 1e16, -1e300, None, True, "a", b"1", 10**400, 1j, Decimal(1), [1.0], {}, len)
TYPES = ("f2", "f4", "g", ">f8", ">f4", "i8", "u1", "i2", "bool", "c8", "object", "U8", "S8", "M8[s]", "m8[s]")


class Subclass(np.ndarray):
    """An array, but of another class."""


def _retyped(values, rng):
    kind = rng.choice(TYPES)
    return values.astype(kind) if kind[0] not in "Mm" else values.astype("i8").astype(kind)


def _masked(values, rng):
    mask = np.array([rng.random() < 0.3 for _ in range(values.size)], dtype=bool).reshape(values.shape)
    return np.ma.array(values, mask=rng.choice([False, mask]))


def _in_another_container(values, rng):
    plain = values.tolist()
    flat = values.ravel().tolist()
    return rng.choice([
        lambda: plain, lambda: tuple(plain) if values.ndim else plain, lambda: deque(flat), lambda: iter(flat),
        lambda: set(flat), lambda: dict(enumerate(flat)), lambda: list(values) if values.ndim else [values],
        lambda: pd.Series(flat), lambda: pd.DataFrame(np.atleast_2d(values)), lambda: _torch(plain),
        lambda: _torch(plain, requires_grad=True, dtype=None if values.dtype.kind == "f" else float),
        lambda: _sparse(values) if values.ndim <= 2 else plain, lambda: memoryview(np.ascontiguousarray(values)),
        lambda: array.array("d", flat), lambda: np.matrix(values) if values.ndim <= 2 else plain,
        lambda: values.view(Subclass), lambda: [np.ma.array(v, mask=rng.random() < 0.5) for v in np.atleast_1d(values)],
    ])()  # fmt: skip


def _reshaped(values, rng):
    return rng.choice([
        lambda: values[None], lambda: values[..., None], lambda: values.ravel(), lambda: values.T, lambda: values[()],
        lambda: values[:0] if values.ndim else values, lambda: np.concatenate([np.atleast_1d(values)] * 2),
        lambda: np.atleast_1d(values)[1:], lambda: np.squeeze(values), lambda: values.sum(),
        lambda: np.stack([values] * 3),
    ])()  # fmt: skip


def _with_a_bad_entry(values, rng):
    entry = rng.choice(ENTRIES)
    if isinstance(entry, float) and values.size and rng.random() < 0.7:
        changed = values.astype(float)
        changed.flat[rng.randrange(values.size)] = entry
        return changed
    nested = np.atleast_1d(values).tolist()
    row = nested
    while row and isinstance(row[0], list) and rng.random() < 0.8:
        row = rng.choice(row)
    if row:
        row[rng.randrange(len(row))] = entry
    else:
        row.append(entry)
    return nested


def array_value(good, rng):
    """A value where an array like ``good`` is wanted."""
    if rng.random() < 0.25:
        return rng.choice(ATOMS)()
    changes = (_retyped, _masked, _in_another_container, _reshaped, _with_a_bad_entry)
    value = rng.choice(changes)(np.array(good), rng)
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and rng.random() < 0.3:
        value = rng.choice(changes)(np.asarray(value), rng)
    return value


def scalar_value(good, rng):
    """A value where a number, a flag or a name like ``good`` is wanted."""
    if rng.random() < 0.75:
        return rng.choice(ATOMS)()
    kinds = (np.array, lambda v: [v], lambda v: (v,), lambda v: np.array([v]), str, repr, lambda v: {v: v},
             lambda v: {v}, lambda v: np.array(v, object), lambda v: pd.Series([v]), lambda v: lambda: v)  # fmt: skip
    if isinstance(good, Real):
        kinds += (np.float32, np.float16, np.longdouble, int, float, Fraction, Decimal, complex, np.int64,
                  lambda v: -v, lambda v: 1 - v, lambda v: _torch(v), lambda v: np.ma.array(v, mask=True))  # fmt: skip
    return rng.choice(kinds)(good)


def mapping_value(good, rng):
    """A value where a dict like ``good`` is wanted."""
    if rng.random() < 0.5:
        return rng.choice(ATOMS)()
    return rng.choice([
        lambda: list(good.items()), lambda: {**good, "unknown": 1.0}, lambda: {**good, 1: 2},
        lambda: {key.encode(): value for key, value in good.items()}, lambda: str(good), lambda: pd.Series(good),
        lambda: {key: rng.choice(ATOMS)() for key in good}, lambda: dict.fromkeys(good), lambda: good.items(),
    ])()  # fmt: skip


def numbers(value):
    """The array of float64 that a value says, or None if it is no array of real numbers."""
    if isinstance(value, bool | np.bool_ | str | bytes | bytearray | memoryview):
        return None
    if isinstance(value, np.ma.MaskedArray):
        return None if np.ma.getmaskarray(value).any() else numbers(value.data)
    if isinstance(value, pd.Series | pd.DataFrame | pd.Index):
        return numbers(value.to_numpy())
    if type(value).__module__ == "torch":
        return numbers(value.detach().numpy())
    if isinstance(value, np.ndarray | np.generic):
        with np.errstate(over="ignore"):
            return np.array(value, float) if value.dtype.kind in "fiu" else None
    if isinstance(value, Real):
        try:
            return np.array(float(value))
        except OverflowError:
            return None
    if isinstance(value, Sequence | array.array | deque):
        parts = [numbers(part) for part in value]
        if any(part is None for part in parts) or len({part.shape for part in parts}) > 1:
            return None
        return np.stack(parts) if parts else np.zeros(0)
    return None


def number(value):
    """The float that a value says, or None if it is no real number."""
    if isinstance(value, bool | np.timedelta64) or not isinstance(value, Real):
        return None
    found = numbers(value)
    return None if found is None else float(found)
