"""From files to records."""

import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from kkl_gym.system import System
from training.records.checks import check_against_system, check_between_records, check_motion, check_signals
from training.records.files import read_columns
from training.records.minari import is_dataset, read_dataset
from training.records.record import Record, refuse_infinite
from training.records.signals import Signals, column_of, values_of


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
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: named twice, which would count each sample twice")
    told = warn or (lambda text: warnings.warn(text, stacklevel=4))
    records = list[Record]()
    for path in paths:
        records += (
            read_dataset(path, told).records(signals) if is_dataset(path) else [_read(path, signals or Signals())]
        )
    check_signals(records, system)
    if len(paths) > 1:  # episodes of one environment are in the same units
        check_between_records(records, told)
    check_motion(records, told)
    if system is not None:
        check_against_system(records, system, told)
    return records


def _read(path: Path, wanted: Signals) -> Record:
    found = wanted

    def choose(columns: Sequence[str]) -> Sequence[str]:
        nonlocal found
        found = wanted.found_in(path, columns)
        return list(dict.fromkeys([found.time, *(column_of(signal, columns) for signal in found.all)]))

    names, columns = read_columns(path, choose)
    for name, values in columns.items():
        refuse_infinite(str(path), name, values)

    def stacked(signals: tuple[str, ...]) -> np.ndarray:
        return np.stack([values_of(signal, names, columns[column_of(signal, names)]) for signal in signals], -1)

    u, x = (stacked(signals) if signals else None for signals in (found.inputs, found.hidden))
    return Record(str(path), columns[found.time], stacked(found.measured), u, x, found)
