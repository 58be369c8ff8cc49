"""The results of a benchmark's jobs, put together: as CSV files, as a table and as a figure."""

import json
from collections.abc import Iterable, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from examples.research.benchmark.tables import draw, write_table
from examples.research.methods import ABLATION, METHODS
from kkl_gym.systems import SYSTEMS
from observers.storage import explained
from training.evaluation.levels import read_level, show_level
from training.files import write

FILES = ("results.csv", "methods.csv")  # a row for each trajectory, and for each method on each system
NAMED = 4  # of the methods that are missing, by their names


def _full_set(found: Iterable[str]) -> list[str]:
    """The shipped methods, in order, of the comparison that some are of: the benchmark, the ablation, or both."""
    names = set(found)
    ablation = bool(names & (set(ABLATION) - set(METHODS)))
    benchmark = bool(names & (set(METHODS) - set(ABLATION)))
    if ablation:
        return list(METHODS | ABLATION if benchmark else ABLATION)
    return list(METHODS)


def collect(out: Path, beside: Path | None = None) -> None:
    """Write one CSV file of all errors and one of all costs, from every job found in the folder."""
    errors, costs = [], []
    rules: dict[str, Any] = {}

    for folder in sorted(path.parent for path in (out / "jobs").glob("*/*/errors.csv")):
        with explained(folder, ValueError):
            errors.append(pd.read_csv(folder / "errors.csv"))
            info, job = (json.loads((folder / file).read_text()) for file in ("info.json", "job.json"))
            its = _rules(job, folder.parent.name)
            speed = folder / "speed.json"
            costs.append(
                {
                    "system": folder.parent.name,
                    "method": folder.name,
                    "label": info["label"],
                    "budget": job["budget"]["name"],
                    "configuration": json.dumps(info["configuration"]),
                    "validation": json.dumps(info["validation"]),
                    "train_seconds": info["train_seconds"],
                    **(
                        json.loads(speed.read_text()) if speed.exists() else {"us_batch_1": None, "us_batch_1000": None}
                    ),
                    "trajectories": info["trajectories"],
                    "seed": job["protocol"]["seed"],
                }
            )
        for rule, value in its.items():
            if rules.setdefault(rule, value) != value:
                raise ValueError(
                    f"{out} holds jobs of several benchmarks: {rule} = {value} in {folder}, "
                    f"{rules[rule]} elsewhere; remove the ones that do not belong there"
                )
    for name, found in zip(FILES, (pd.concat(errors), pd.DataFrame(costs))):
        rows = _as_written(StringIO(found.to_csv(index=False, float_format="%.4g")))
        if beside is not None:
            with explained(beside / name, ValueError):
                rows = _joined(rows, _as_written(beside / name))
        write(out / name, _in_order(rows).to_csv(index=False))


def _as_written(source: Path | StringIO) -> pd.DataFrame:
    """A CSV file, every digit as it is there."""
    return pd.read_csv(source, dtype=str, keep_default_na=False)


def _joined(rows: pd.DataFrame, earlier: pd.DataFrame) -> pd.DataFrame:
    """Rows of jobs, in the columns that the earlier ones have, and those of other observers as they are."""
    here, there = (_conditions(frame, set(rows.system) & set(earlier.system)) for frame in (rows, earlier))
    if here != there:
        raise ValueError(
            f"it is of another benchmark: {'; '.join(sorted(there))} there, {'; '.join(sorted(here))} here"
        )
    observers = set(zip(rows.system, rows.method))
    others = [observer not in observers for observer in zip(earlier.system, earlier.method)]
    return pd.concat([rows.reindex(columns=earlier.columns, fill_value=""), earlier[others]])


def _conditions(frame: pd.DataFrame, systems: set[str]) -> set[str]:
    """What rows of one benchmark have in common."""
    if "budget" in frame:
        return {f"budget {budget}, seed {seed}" for budget, seed in zip(frame.budget, frame.seed)}
    cases = frame[frame.system.isin(systems)][["system", "starts", "noise"]].drop_duplicates()
    return {f"{system} in {starts} at {show_level(read_level(noise))}" for system, starts, noise in cases.to_numpy()}


def _in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """First what ships, in its order, then the user's systems and methods; rows of an observer stay as they are."""
    places = [
        {name: place for place, name in enumerate(dict.fromkeys([*shipped, *sorted(set(column))]))}
        for shipped, column in ((SYSTEMS, rows.system), (_full_set(rows.method), rows.method))
    ]
    keys = [[place[name] for name in column] for place, column in zip(places, (rows.system, rows.method))]
    return rows.iloc[np.lexsort(keys[::-1])]


def _rules(job: Mapping[str, Any], system: str) -> dict[str, Any]:
    """What the jobs of one benchmark agree in. Systems of the user's have sampling intervals and noise of their own."""
    budget, dt = dict(job["budget"]), job["budget"]["dt"]
    budget |= {"duration": f"{budget['duration'] / dt:.0f} samples", "dt": None}
    own = "" if system in SYSTEMS else f" of {system}"
    rules = {"budget": budget, f"dt{own}": dt}
    for name in ("protocol", "validation"):
        described = dict(job[name])
        rules[f"measurement_noise{own}"] = described.pop("measurement_noise")
        rules[name] = described | {"duration": f"{described['duration'] / dt:.0f} samples"}
    return rules | {name: job[name] for name in ("search", "seed", "version")}


def check_results(folder: Path) -> None:
    """Raise a ValueError unless a folder has the two CSV files."""
    for name in FILES:
        if not (folder / name).exists():
            raise ValueError(f"{folder / name} does not exist; run the benchmark first")


def report(out: Path) -> str:
    """Write table.md and heatmap.png from the CSV files."""
    results, methods, note, missing = _read(out)
    write_table(out / "table.md", results, methods, note=note + missing)
    draw(out / "heatmap.png", results, methods, note=note)
    return note + missing


def draw_results(out: Path, path: Path) -> None:
    """Draw the heatmap alone from the CSV files."""
    results, methods, note, _ = _read(out)
    draw(path, results, methods, note=note)


def _read(out: Path) -> tuple[pd.DataFrame, pd.DataFrame, str, str]:
    """Results and methods, what was compared, and which are missing."""
    check_results(out)
    results, methods = (pd.read_csv(out / name) for name in FILES)
    note = f"Budget {methods.budget[0]}, seed {methods.seed[0]}, {methods.trajectories.max()} trajectories a case."
    partial, missing = _missing(methods)
    return results, methods, note + partial, missing


def _missing(methods: pd.DataFrame) -> tuple[str, str]:
    """How many observers there are of a full set, the user's included, and which are not; empty if all are there."""
    systems = dict.fromkeys([*SYSTEMS, *methods.system])
    names = dict.fromkeys([*_full_set(methods.method), *methods.method])
    there = set(zip(methods.system, methods.method, strict=True))
    missing = {name: [system for system in systems if (system, name) not in there] for name in names}
    few = [name if len(on) == len(systems) else f"{name} on {', '.join(on)}" for name, on in missing.items() if on]
    if not few:
        return "", ""
    more = f" and {len(few) - NAMED} more methods" if len(few) > NAMED else ""
    return (
        f" Partial: {len(there)} of {len(systems) * len(names)} observers.",
        f" Missing: {'; '.join(few[:NAMED])}{more}.",
    )
