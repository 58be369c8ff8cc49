"""Records from files: NPZ, CSV and Parquet, and Minari data sets. Nothing in a file runs."""

import csv
import re
import textwrap
import warnings
import zipfile
from array import array
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.named import FUNCTIONS
from kkl_gym.system import System
from observers.checks import shown
from training.records.checks import check_against_system, check_between_records, check_motion, check_signals
from training.records.episodes import is_dataset, read_dataset
from training.records.record import ROLES, Record, Signals, refuse_infinite

MISSING = {"", "na", "n/a", "nan", "none", "null"}  # cells of a text file that hold no number, in small letters
SEPARATORS = ",;\t"
TIMES = ("t", "time")  # usual names of the column of time
Columns = dict[str, np.ndarray]
Choose = Callable[[tuple[str, ...]], list[str]]  # from the names of all columns to those that are wanted


def read_records(
    files: Iterable[str | Path],
    *,
    signals: Signals | None = None,
    system: System | None = None,
    warn: Callable[[str], object] | None = None,
) -> list[Record]:
    """Read records, one from each file or episode, and check them."""
    paths = [Path(path) for path in files]
    if not paths:
        raise ValueError("name a file of recorded data, .npz, .csv or .parquet, or a data set, minari:ID (--data)")
    if twice := sorted({str(path) for path in paths if paths.count(path) > 1}):
        raise ValueError(f"{', '.join(twice)}: named twice, which would count each sample twice")
    warn = warn or (lambda text: warnings.warn(text, stacklevel=4))
    records = list[Record]()
    for path in paths:
        if is_dataset(path):
            records += read_dataset(path, warn).records(signals)
        else:
            records.append(_read(path, signals or Signals()))
    check_signals(records, system)
    if len(paths) > 1:  # episodes of one environment are in the same units
        check_between_records(records, warn)
    check_motion(records, warn)
    if system is not None:
        check_against_system(records, system, warn)
    return records


def _read(path: Path, wanted: Signals) -> Record:
    """Read the wanted signals of a file, and those of the usual names where none are named."""
    readers = {".npz": _npz, ".csv": _csv, ".parquet": _parquet}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(
            f"{path} is no record: its name must end in {', '.join(readers)}, or be minari:ID of a data set"
        )
    if not path.is_file():  # to read a pipe may never end
        raise ValueError(f"{path} is a folder, a pipe or a device" if path.exists() else f"there is no file {path}")
    try:
        return _record(path, wanted, reader)
    except (ValueError, KeyError, EOFError, MemoryError, NotImplementedError, zipfile.BadZipFile, csv.Error) as error:
        raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _record(path: Path, wanted: Signals, reader: Callable[[Path, Choose], Columns]) -> Record:
    names, signals = tuple[str, ...](), wanted

    def choose(there: tuple[str, ...]) -> list[str]:
        nonlocal names, signals
        if twice := sorted({name for name in there if there.count(name) > 1}):
            raise ValueError(f"more than one column {', '.join(twice)}")
        names, signals = there, _named(wanted, there)
        return list(dict.fromkeys([signals.time, *(_column(signal, names)[0] for signal in signals.all)]))

    columns = reader(path, choose)
    t = columns[signals.time]
    for name, values in columns.items():
        if values.dtype.kind not in "fiu":
            raise ValueError(f"column {name} must hold numbers, got {values.dtype}")
        if len(values) != len(t):
            raise ValueError(
                f"columns must be of one length; {signals.time} has {len(t)}, {name} has {len(values)} rows"
            )
        refuse_infinite(str(path), name, values)

    def stacked(role: tuple[str, ...]) -> Any:
        parts = [_column(signal, names) for signal in role]
        return np.stack([function(columns[name].astype(float)) for name, function in parts], -1) if parts else None

    y, u, x = map(stacked, (signals.measured, signals.inputs, signals.hidden))
    return Record(str(path), t, y, u, x, signals)


def _named(wanted: Signals, columns: tuple[str, ...]) -> Signals:
    """The wanted signals, those of the usual names in place of empty ones; ValueError if a column is missing."""
    signals = replace(
        wanted,
        time=wanted.time or next((name for name in TIMES if name in columns), TIMES[0]),
        measured=wanted.measured or _numbered("y", columns) or ("y",),
        inputs=wanted.inputs or _numbered("u", columns),
        hidden=wanted.hidden or _numbered("x", columns),
    )
    for role in ("time", *ROLES.values()):
        for signal in (signals.time,) if role == "time" else getattr(signals, role):
            name, _ = _column(signal, columns)
            if name not in columns:
                there = textwrap.shorten(", ".join(columns), 200, placeholder=" ...") or "none"
                raise ValueError(f"no column {name}; there are {there} (--{role})")
            if name == signals.time and role != "time":
                raise ValueError(f"column {name} is the time, and cannot be a signal too")
    return signals


def _column(signal: str, columns: tuple[str, ...]) -> tuple[str, Callable[..., np.ndarray]]:
    """The column of a signal, and the function that is taken of it; a column may itself be called cos(...)."""
    match = None if signal in columns else re.fullmatch(rf"({'|'.join(FUNCTIONS)})\((.+)\)", signal)
    return (signal, np.asarray) if match is None else (match[2].strip(), FUNCTIONS[match[1]])


def _numbered(letter: str, columns: tuple[str, ...]) -> tuple[str, ...]:
    """The column that is a letter alone, or those of the letter with numbers."""
    if letter in columns:
        return (letter,)
    numbered = [name for name in columns if re.fullmatch(rf"{letter}[0-9]+", name)]
    return tuple(sorted(numbered, key=lambda name: int(name[1:])))


def _npz(path: Path, choose: Choose) -> Columns:
    file = np.load(path, allow_pickle=False)
    if not isinstance(file, np.lib.npyio.NpzFile):
        raise ValueError("it holds a single array; save it by numpy.savez(path, t=t, y=y)")
    columns = Columns()
    with file:
        for name in file.files:
            try:
                values = file[name]
            except ValueError:  # pickled objects, which are no error unless they are asked for
                values = np.empty(1, dtype=object)
            if values.ndim == 2 and values.shape[1] > 1:
                columns |= {f"{name}{i + 1}": column for i, column in enumerate(values.T)}
            elif values.ndim in (1, 2) and values.size:  # u may be empty where a system has no inputs
                columns[name] = values.reshape(-1)
    return {name: columns[name] for name in choose(tuple(columns))}


def _parquet(path: Path, choose: Choose) -> Columns:
    try:
        from pyarrow import parquet
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{path}: Parquet needs pyarrow: pip install "kkl-gym[parquet]"', name=error.name
        ) from None
    names = choose(tuple(parquet.read_schema(path).names))
    table = parquet.read_table(path, columns=names)
    return {name: table[name].to_numpy() for name in names}


def _csv(path: Path, choose: Choose) -> Columns:
    with path.open(encoding="utf-8-sig", newline="") as file:
        header = file.readline()
        layout: Any = {"delimiter": max(SEPARATORS, key=header.count), "skipinitialspace": True}
        names = tuple(name.strip() for name in next(csv.reader([header], **layout), []))
        if not any(names):
            raise ValueError("its first row must hold the names of the columns")
        columns = {name: array("d") for name in choose(names)}
        places = {name: names.index(name) for name in columns}
        for row, cells in enumerate(csv.reader(file, **layout), 1):
            if not cells:  # an empty row
                continue
            if len(cells) != len(names):
                raise ValueError(f"row {row} has {len(cells)} cells, the header {len(names)}")
            for name, column in columns.items():
                column.append(_number(cells[places[name]], name, row))
    return {name: np.array(column) for name, column in columns.items()}


def _number(cell: str, column: str, row: int) -> float:
    try:
        return float(cell)
    except ValueError:
        if cell.strip().lower() in MISSING:
            return float("nan")
        hint = "; write decimals with a point" if "," in cell else ""
        raise ValueError(f"column {column}, row {row}: {shown(cell)} is no number{hint}") from None
