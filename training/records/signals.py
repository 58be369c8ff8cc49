"""Which columns of a file are what: time, measured outputs, inputs and hidden states."""

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

TIMES = ("t", "time")  # what the time is called where nobody says it
FUNCTIONS = {"cos": np.cos, "sin": np.sin}  # of a column that holds an angle


@dataclass(frozen=True)
class Signals:
    """The columns of records by what they are; what is left empty is found by its name.

    A measured, an input or a hidden signal is the name of a column, or ``cos(column)`` or ``sin(column)`` of an angle
    in rad.
    """

    time: str = ""
    measured: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for role in ("measured", "inputs", "hidden"):
            names = getattr(self, role)
            if isinstance(names, str) or not all(isinstance(name, str) and name for name in names):
                raise ValueError(f"{role} must be names of columns, got {names!r}")
            object.__setattr__(self, role, tuple(names))
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"{role} names {', '.join(twice)} twice")

    @property
    def all(self) -> tuple[str, ...]:
        """The measured, input and hidden signals, in this order."""
        return self.measured + self.inputs + self.hidden

    def found_in(self, path: object, columns: Sequence[str]) -> "Signals":
        """Find in a file's columns what nobody has named, and see that all others are there."""
        found = replace(
            self,
            time=self.time or next((name for name in TIMES if name in columns), TIMES[0]),
            measured=self.measured or _numbered("y", columns) or ("y",),
            inputs=self.inputs or _numbered("u", columns),
            hidden=self.hidden or _numbered("x", columns),
        )
        options = {
            "--time": (found.time,),
            "--measured": found.measured,
            "--inputs": found.inputs,
            "--hidden": found.hidden,
        }
        for option, names in options.items():
            for name in names:
                if column_of(name, columns) not in columns:
                    there = textwrap.shorten(", ".join(columns), 200, placeholder=" ...") or "none"
                    raise ValueError(f"{path} has no column {column_of(name, columns)}; there are {there} ({option})")
        if found.time in {column_of(name, columns) for name in found.all}:
            raise ValueError(f"{path}: column {found.time} is the time, and cannot be a signal too")
        return found


def column_of(signal: str, columns: Sequence[str]) -> str:
    """The column that a signal is made of: the signal itself, or what stands between the brackets of cos() or sin()."""
    function = _function(signal, columns)
    return signal if function is None else function[2].strip()


def values_of(signal: str, columns: Sequence[str], column: np.ndarray) -> np.ndarray:
    """A signal's values, (n,), from those of its column."""
    function = _function(signal, columns)
    return column if function is None else np.asarray(FUNCTIONS[function[1]](column))


def _function(signal: str, columns: Sequence[str]) -> re.Match[str] | None:
    """The cos() or sin() in a signal; a column may bear such a name itself."""
    return None if signal in columns else re.fullmatch(rf"({'|'.join(FUNCTIONS)})\((.+)\)", signal)


def _numbered(letter: str, columns: Sequence[str]) -> tuple[str, ...]:
    """The columns of a letter alone, or with numbers, by their numbers."""
    if letter in columns:
        return (letter,)
    found = [name for name in columns if re.fullmatch(rf"{letter}[0-9]+", name)]
    return tuple(sorted(found, key=lambda name: int(name[1:])))
