"""Columns of numbers in files: NPZ, CSV and Parquet. Nothing in a file runs."""

import csv
import zipfile
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from observers.checks import shown

MISSING = {"", "na", "n/a", "nan", "none", "null"}  # cells of a text file that hold no number, in small letters
SEPARATORS = ",;\t"
Columns = dict[str, np.ndarray]
Choose = Callable[[Sequence[str]], Sequence[str]]  # from the names of all columns to those that are wanted


def read_columns(path: Path, choose: Choose) -> tuple[tuple[str, ...], Columns]:
    """Read some columns of a file. Shapes: returns ``columns`` (n,)."""
    readers = {".npz": _npz, ".csv": _csv, ".parquet": _parquet}
    if path.suffix.lower() not in readers:
        raise ValueError(
            f"{path} is no record: its name must end in {', '.join(readers)}, or be minari:ID of a data set"
        )
    if not path.is_file():  # to read a pipe may never end
        raise ValueError(f"{path} is a folder, a pipe or a device" if path.exists() else f"there is no file {path}")

    def chosen(names: Sequence[str]) -> Sequence[str]:
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"{path} has more than one column {', '.join(twice)}")
        return choose(names)

    return readers[path.suffix.lower()](path, chosen)


def _npz(path: Path, choose: Choose) -> tuple[tuple[str, ...], Columns]:
    with _explained(path, "NPZ"):
        found = np.load(path, allow_pickle=False)
        if not isinstance(found, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array; save it by numpy.savez(path, t=t, y=y)")
        arrays, refused = dict[str, np.ndarray](), dict[str, ValueError]()
        with found:
            for name in found.files:
                try:
                    arrays[name] = found[name]
                except ValueError as error:  # such as of pickled objects, which hurt nobody who does not ask for them
                    refused[name] = error
    named: list[tuple[str, np.ndarray]] = []
    for name, values in arrays.items():
        if values.ndim == 2 and values.shape[1] > 1:
            named += [(f"{name}{i + 1}", column) for i, column in enumerate(values.T)]
        elif values.ndim in (1, 2) and values.size:  # nobody misses the inputs of a system that has none
            named.append((name, values.reshape(-1)))
    names, columns = (*(name for name, _ in named), *refused), dict(named)
    wanted = choose(names)
    for name in wanted:
        if name in refused:
            raise ValueError(f"{path}: column {name}: {refused[name]}")
    chosen = {name: _floats(path, name, columns[name]) for name in wanted}
    lengths = {name: len(values) for name, values in chosen.items()}
    for name, length in lengths.items():
        if length != lengths[wanted[0]]:
            raise ValueError(
                f"{path}: columns must be of one length; {wanted[0]} has {lengths[wanted[0]]}, {name} has {length} rows"
            )
    return names, chosen


def _parquet(path: Path, choose: Choose) -> tuple[tuple[str, ...], Columns]:
    try:
        from pyarrow import ArrowException, parquet
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{path}: Parquet needs pyarrow: pip install "kkl-gym[parquet]"', name=error.name
        ) from None
    try:
        names = tuple(parquet.read_schema(path).names)
        found = parquet.read_table(path, columns=list(choose(names)))
        return names, {name: _floats(path, name, found[name].to_numpy()) for name in found.column_names}
    except ArrowException as error:
        raise ValueError(f"{path} is damaged or no Parquet file: {error}") from None


def _floats(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{path}: column {name} must hold numbers, got {values.dtype}")
    return values.astype(float)


def _csv(path: Path, choose: Choose) -> tuple[tuple[str, ...], Columns]:
    with _explained(path, "CSV"), path.open(encoding="utf-8-sig", newline="") as file:
        header = file.readline()
        separator = max(SEPARATORS, key=header.count)
        layout: Any = {"delimiter": separator, "skipinitialspace": True}
        names = tuple(name.strip() for name in next(csv.reader([header], **layout), []))
        if not any(names) or all(_is_number(name) for name in names):
            raise ValueError("its first row must hold the names of the columns")
        chosen = list(choose(names))
        places = [names.index(name) for name in chosen]
        columns = [array("d") for _ in chosen]
        for row, cells in _rows(csv.reader(file, **layout)):
            if len(cells) != len(names):
                raise ValueError(f"row {row} has {len(cells)} cells, the header {len(names)}")
            for name, place, column in zip(chosen, places, columns):
                column.append(_number(cells[place], name, row))
    return names, {name: np.array(column) for name, column in zip(chosen, columns)}


def _rows(reader: Any) -> Iterator[tuple[int, list[str]]]:
    """Rows with their numbers; empty ones may stand at the end."""
    empty = 0
    for row, cells in enumerate(reader, 1):
        if not cells:
            empty = empty or row
        elif empty:
            raise ValueError(f"row {empty} is empty")
        else:
            yield row, cells


def _number(cell: str, column: str, row: int) -> float:
    try:
        return float(cell)
    except ValueError:
        if cell.strip().lower() in MISSING:
            return float("nan")
        hint = "; write decimals with a point" if "," in cell else ""
        raise ValueError(f"column {column}, row {row}: {shown(cell)} is no number{hint}") from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


@contextmanager
def _explained(path: Path, kind: str) -> Iterator[None]:
    """Put the file's name before what is wrong with it."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no {kind} file in UTF-8: {error}") from None
    except (zipfile.BadZipFile, EOFError, KeyError, MemoryError, csv.Error) as error:
        raise ValueError(f"{path} is damaged or no {kind} file: {error}") from None
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
