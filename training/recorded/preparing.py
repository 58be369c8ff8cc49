"""What is made of records and a configuration before anything is fitted."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from observers import Artifact, LinearFilter
from observers.checks import shown
from training.recorded.config import RecordedConfig
from training.records import Record, Signals, jitter, median_step
from training.seeds import Stream, generator
from training.spectrum import Spectrum

FEW = 5  # records, below which none is held out as a whole


def filter_of(config: RecordedConfig, signals: Signals) -> LinearFilter:
    """The filter of a configuration for the signals of some records."""
    nu = len(signals.inputs) if config.inputs else 0
    return Spectrum(config.eigenvalues, config.pairs).filter(len(signals.measured), config.dt, nu)


def split(records: Sequence[Record], share: float, seed: int) -> tuple[list[Record], list[Record]]:
    """Hold a share of the records out: whole ones drawn by the seed, or the end of each where there are few."""
    if not share:
        return list(records), []
    if len(records) >= FEW:
        count = min(max(1, round(share * len(records))), len(records) - 1)
        chosen = generator(Stream.VALIDATION, seed).permutation(len(records))[:count]
        return [r for i, r in enumerate(records) if i not in chosen], [records[i] for i in sorted(chosen)]
    ends = [min(max(2, round((1 - share) * len(record.t))), len(record.t) - 2) for record in records]
    return (
        [record.part(slice(None, end)) for record, end in zip(records, ends)],
        [record.part(slice(end, None)) for record, end in zip(records, ends)],
    )


def check_plant(artifact: Artifact, record: Record) -> None:
    """Raise ValueError unless a record is of an observer's environment and signals, states among them."""
    signals, names = record.signals, artifact.signals or {}
    if record.x is None:
        raise ValueError(f"{record.name}: no hidden states were recorded; name them (--hidden)")
    for role in ("measured", "hidden", *(["inputs"] if artifact.nu else [])):
        if (here := getattr(signals, role)) != (there := tuple(names[role])):
            raise ValueError(f"{record.name}: {role} are {', '.join(here)}, but the observer's {', '.join(there)}")
    if record.environment != artifact.environment:
        raise ValueError(
            f"{record.name} is of {shown(record.environment)}, the observer of {shown(artifact.environment)}"
        )


def fingerprints(records: Sequence[Record]) -> dict[str, str]:
    """What identifies each file, or all episodes of a data set together, by its name."""
    found = dict[str, list[str]]()
    for record in records:
        found.setdefault(file_of(record), []).append(record.fingerprint)
    return {
        name: each[0] if len(each) == 1 else hashlib.sha256("".join(each).encode()).hexdigest()[:16]
        for name, each in found.items()
    }


def file_of(record: Record) -> str:
    """The name of the file, or of the data set, that a record is of."""
    return record.source or Path(record.name).name


def described(records: Sequence[Record], config: RecordedConfig, name: str) -> list[str]:
    """What is going to be done."""
    signals = records[0].signals
    given = " and ".join(", ".join(names) for names in (signals.measured, signals.inputs) if names)
    uneven, seconds = max(map(jitter, records)), sum(record.duration for record in records)
    lacking = sum(int(np.isnan(record.y).any(-1).sum()) for record in records)
    rates = Spectrum(config.eigenvalues, config.pairs).poles.real
    return [
        f"training an observer for {name} from recorded states: {', '.join(signals.hidden)} from {given}",
        f"{len(records)} records of {seconds:.4g} s together, {lacking} rows without an output",
        f"steps of {median_step(*records):.4g} s (median), uneven by up to {uneven:.1%}; resampled to {config.dt:g} s",
        f"{len(rates)} modes of A for each output, from {rates.max():.3g} to {rates.min():.3g} 1/s",
    ]
