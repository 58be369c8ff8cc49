"""A record: samples of a plant's outputs, and of its inputs and states where they were recorded."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np

from observers.checks import real_array
from training.records.signals import Signals

ROLES = {"y": "measured", "u": "inputs", "x": "hidden"}  # of the arrays' columns, as Signals calls them
LARGEST = 1e100  # of a sample; sums of squares are finite up to there


@dataclass(frozen=True)
class Record:
    """Samples from one run of a plant. Shapes: ``t`` (n,), ``y`` (n, ny), ``u`` (n, nu), ``x`` (n, nx)."""

    name: str
    t: np.ndarray
    y: np.ndarray
    u: np.ndarray | None = None
    x: np.ndarray | None = None
    signals: Signals = field(default_factory=Signals)
    source: str = ""
    environment: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for letter in "tyux":
            values = getattr(self, letter)
            if values is not None or letter in "ty":
                object.__setattr__(self, letter, real_array(f"{self.name}: {letter}", values))
        if np.ndim(self.t) != 1 or len(self.t) < 2:
            raise ValueError(f"{self.name}: t must be two samples at least, got shape {np.shape(self.t)}")
        if not self.signals.time:
            object.__setattr__(self, "signals", replace(self.signals, time="t"))
        self._check("t", self.signals.time, self.t)
        back = np.flatnonzero(np.diff(self.t) <= 0)
        if len(back):
            row = int(back[0]) + 1
            self._fail(
                self.signals.time, row, f"time must increase, but {self.t[row]:g} comes after {self.t[row - 1]:g}"
            )
        for letter, role in ROLES.items():
            values = getattr(self, letter)
            if values is not None:
                for name, column in zip(self._names(letter, role, values), values.T, strict=True):
                    self._check(letter, name, column)

    def _names(self, letter: str, role: str, values: np.ndarray) -> tuple[str, ...]:
        """The names of an array's columns, which are numbered where nobody has named them; see that they fit it."""
        if values.ndim != 2 or len(values) != len(self.t) or not values.shape[1]:
            raise ValueError(
                f"{self.name}: {letter} must have shape ({len(self.t)}, n) as there are {len(self.t)} times, "
                f"got {values.shape}"
            )
        if not getattr(self.signals, role):
            numbered: Any = {role: tuple(f"{letter}{i + 1}" for i in range(values.shape[1]))}
            object.__setattr__(self, "signals", replace(self.signals, **numbered))
        names: tuple[str, ...] = getattr(self.signals, role)
        if len(names) != values.shape[1]:
            raise ValueError(f"{self.name}: {letter} has {values.shape[1]} columns, but {role} = {names}")
        return names

    def _check(self, letter: str, name: str, column: np.ndarray) -> None:
        """See that no sample of a column is infinite, and that no more are missing than may be."""
        refuse_infinite(self.name, name, column)
        missing = np.isnan(column)
        if missing.all():
            self._fail(name, 0, "no row holds a number")
        if missing.any() and letter in "tu":
            self._fail(name, int(missing.argmax()), "a number is missing, which may be in outputs and states alone")

    def _fail(self, column: str, row: int, why: str) -> NoReturn:
        raise ValueError(f"{self.name}: column {column}, row {row + 1}: {why}")

    def part(self, rows: slice) -> "Record":
        """Some rows of the record, two at least; without states where none of these rows has all of them."""
        u, x = (None if values is None else values[rows] for values in (self.u, self.x))
        if x is not None and np.isnan(x).any(-1).all():
            x = None
        return replace(self, t=self.t[rows], y=self.y[rows], u=u, x=x)

    @property
    def fingerprint(self) -> str:
        """What identifies the samples and the names of their signals."""
        found = hashlib.sha256(repr(self.signals).encode())
        for values in (self.t, self.y, self.u, self.x):
            found.update(b"" if values is None else np.ascontiguousarray(values).tobytes())
        return found.hexdigest()[:16]

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.t[-1] - self.t[0])


def refuse_infinite(name: str, column: str, values: np.ndarray) -> None:
    """Raise an error that names file, column and row if a value is infinite, or so large that its square is."""
    infinite = np.flatnonzero(abs(values) > LARGEST)
    if len(infinite):
        raise ValueError(f"{name}: column {column}, row {infinite[0] + 1}: {values[infinite[0]]:g} is no sample")
