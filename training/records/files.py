"""Records from NPZ, CSV and Parquet files and Minari data sets. Reading runs no code from a file."""

import csv
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.named import FUNCTIONS
from kkl_gym.system import System
from observers.checks import shown
from training.records.checks import Warn, check_motion, check_signals
from training.records.episodes import is_dataset, read_dataset
from training.records.record import ROLES, Record, Signals

MISSING = ["na", "none", "NONE", "Null", "Nan", "Na"]  # marks of missing cells besides those that pandas recognises
SEPARATORS = ",;\t"
TIMES = ("t", "time")  # usual names of the column of time
Columns = Mapping[str, Any]


def read_records(
    files: Iterable[str | Path],
    *,
    signals: Signals | None = None,
    system: System | None = None,
    warn: Warn | None = None,
) -> list[Record]:
    """Read a record from each file, or from each episode of a data set, and check the records."""
    paths = [Path(path) for path in files]
    if not paths:
        raise ValueError(f"name a file of recorded data ({', '.join(READERS)}) or a data set (minari:ID), by --data")
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
    check_motion(records, warn)
    if system is not None and system.nu and not records[0].signals.inputs:
        warn(f"{records[0].name}: no column of inputs; they are assumed to be zero")
    return records


def _read(path: Path, wanted: Signals) -> Record:
    """Read the wanted signals of a file; a role without wanted signals has its usual columns, such as u for inputs."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(
            f"{path} is not a record: its name must end in {', '.join(READERS)}, or be minari:ID of a data set"
        )
    if not path.is_file():  # reading a pipe may never end
        raise ValueError(f"{path} is a folder, a pipe or a device" if path.exists() else f"there is no file {path}")
    try:
        return _record(path, wanted, reader(path))
    except ModuleNotFoundError:
        raise
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not in UTF-8: save it in this encoding") from None
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _record(path: Path, wanted: Signals, columns: Columns) -> Record:
    signals = _named(wanted, tuple(columns))
    t = _seconds(columns[signals.time], signals.time)

    def stacked(role: tuple[str, ...], *, held: bool = False) -> np.ndarray | None:
        values = list[np.ndarray]()
        for signal in role:
            name, function = _column(signal, columns)
            column = _numbers(columns[name], name)
            if held and len(column) == len(t) - 1 > 0:  # the last sample may lack an input
                column = np.append(column, column[-1])
            if len(column) != len(t):
                raise ValueError(
                    f"columns must be of one length; {signals.time} has {len(t)}, {name} has {len(column)} rows"
                )
            values.append(function(column))
        return np.stack(values, -1) if values else None

    y, u, x = stacked(signals.measured), stacked(signals.inputs, held=True), stacked(signals.hidden)
    return Record(str(path), t, y, u, x, signals)  # type: ignore[arg-type]


def _named(wanted: Signals, columns: tuple[str, ...]) -> Signals:
    """Return the wanted signals, with the usual columns for roles without names; ValueError if a column is missing."""
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
                raise ValueError(f"no column {name}; there are {shown(columns)} (--{role})")
            if name == signals.time and role != "time":
                raise ValueError(f"column {name} is the time, and cannot be a signal too")
    return signals


def _column(signal: str, columns: Iterable[str]) -> tuple[str, Callable[..., np.ndarray]]:
    """Return a signal's column, and the function to apply to it; a column may itself be named cos(...)."""
    match = None if signal in columns else re.fullmatch(rf"({'|'.join(FUNCTIONS)})\((.+)\)", signal)
    return (signal, np.asarray) if match is None else (match[2].strip(), FUNCTIONS[match[1]])


def _numbered(letter: str, columns: tuple[str, ...]) -> tuple[str, ...]:
    """Return the column named by the letter alone, or the columns named by the letter and a number."""
    if letter in columns:
        return (letter,)
    numbered = [name for name in columns if re.fullmatch(rf"{letter}[0-9]+", name)]
    return tuple(sorted(numbered, key=lambda name: int(name[1:])))


def _seconds(values: Any, column: str) -> np.ndarray:
    """Convert times to seconds; dates, or texts of dates in ISO 8601, count from the first one."""
    import pandas as pd

    values = pd.Series(values)
    if values.empty:
        raise ValueError(f"column {column} has no rows")
    if not pd.api.types.is_numeric_dtype(values):
        dates = pd.to_datetime(values, format="ISO8601", errors="coerce", utc=True)
        if dates.notna().any():
            for row in np.flatnonzero(dates.isna() & values.notna()):
                raise ValueError(f"column {column}, row {row + 1}: {shown(values.iloc[row])} is not a date in ISO 8601")
            return np.asarray((dates - dates.iloc[0]).dt.total_seconds())
    return _numbers(values, column)


def _numbers(values: Any, column: str) -> np.ndarray:
    import pandas as pd

    values = pd.Series(values)
    numbers = pd.to_numeric(values, errors="coerce")
    if len(wrong := np.flatnonzero(numbers.isna() & values.notna())) or numbers.dtype.kind not in "fiub":
        value = values.iloc[wrong[0]] if len(wrong) else values.dtype
        hint = "; write decimals with a point" if "," in str(value) else ""
        raise ValueError(f"column {column}, row {wrong[:1].sum() + 1}: {shown(value)} is not a number{hint}")
    return np.asarray(numbers, dtype=float)


def _npz(path: Path) -> Columns:
    file = np.load(path, allow_pickle=False)
    if not isinstance(file, np.lib.npyio.NpzFile):
        raise ValueError("it holds a single array; save it by numpy.savez(path, t=t, y=y)")
    columns = dict[str, np.ndarray]()
    with file:
        for name in file.files:
            with suppress(ValueError):  # raised for pickled objects, which are not read
                values = file[name]
                if values.ndim == 2 and values.shape[1] > 1:
                    columns |= {f"{name}{i + 1}": column for i, column in enumerate(values.T)}
                elif values.ndim in (1, 2) and values.size:  # u may be empty where a system has no inputs
                    columns[name] = values.reshape(-1)
    return columns


def _parquet(path: Path) -> Columns:
    import pandas as pd

    try:
        frame = pd.read_parquet(path, engine="pyarrow")
    except ImportError as error:
        raise ModuleNotFoundError(f'{path}: Parquet needs pyarrow: pip install "kkl-gym[parquet]"') from error
    if isinstance(frame.index, pd.DatetimeIndex):
        frame = frame.reset_index(names=frame.index.name or TIMES[0])
    return frame


def _csv(path: Path) -> Columns:
    import pandas as pd

    with path.open(encoding="utf-8-sig", newline="") as file:
        header = file.readline()
        first = next(filter(str.strip, file), header)
        bare = [re.sub('"[^"]*"', "", line) for line in (header, first)]
        separator = max(SEPARATORS, key=lambda mark: min(line.count(mark) for line in bare))
        file.seek(0)
        file.readline()
        layout: Any = {"delimiter": separator, "skipinitialspace": True}
        names = [name.strip() for name in next(csv.reader([header], **layout), [])]
        if not any(names):
            raise ValueError("its first row must hold the names of the columns")
        if twice := sorted({name for name in names if name and names.count(name) > 1}):
            raise ValueError(f"more than one column {', '.join(twice)}")
        for row, cells in enumerate(csv.reader(file, **layout), 1):
            if len(cells) not in (0, len(names)):  # pandas would fill or shift such a row
                raise ValueError(f"row {row} has {len(cells)} cells, the header {len(names)}: {shown(names)}")
    layout |= {"header": None, "skiprows": 1, "names": range(len(names)), "na_values": MISSING}
    frame = pd.read_csv(path, encoding="utf-8-sig", **layout)
    return {name: frame[i] for i, name in enumerate(names)}


READERS: dict[str, Callable[[Path], Columns]] = {".npz": _npz, ".csv": _csv, ".parquet": _parquet}
