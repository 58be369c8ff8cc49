"""The combined results of a benchmark's jobs: CSV files, a table and a figure."""

import json
import math
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd

from examples.research.benchmark.budgets import BUDGETS
from examples.research.benchmark.tables import draw, write_table
from examples.research.methods import ABLATION, METHODS
from kkl_gym.systems import SYSTEMS
from observers.storage import explained
from training.evaluation.levels import read_level, show_level
from training.files import write

FILES = ("results.csv", "methods.csv")  # a row for each trajectory; a row for each method and system


def collect(out: Path, beside: Path | None = None) -> None:
    """Write results.csv and methods.csv of all jobs in ``out``; add other observers' rows from folder ``beside``."""
    errors, costs = [], []
    for folder in sorted(path.parent for path in (out / "jobs").glob("*/*/errors.csv")):
        with explained(folder, ValueError):
            errors.append(pd.read_csv(folder / "errors.csv"))
            info, job = (json.loads((folder / file).read_text()) for file in ("info.json", "job.json"))
            speed = folder / "speed.json"
            times = json.loads(speed.read_text()) if speed.exists() else {"us_batch_1": None, "us_batch_1000": None}
            costs.append(
                {
                    "system": folder.parent.name,
                    "method": folder.name,
                    "label": info["label"],
                    "budget": job["budget"]["name"],
                    "configuration": json.dumps(info["configuration"]),
                    "validation": json.dumps(info["validation"]),
                    "train_seconds": info["train_seconds"],
                    **times,
                    "trajectories": info["trajectories"],
                    "seed": job["protocol"]["seed"],
                }
            )
    if len(benchmarks := {(cost["budget"], cost["seed"]) for cost in costs}) > 1:
        raise ValueError(f"{out} holds jobs of several pairs (budget, seed), {sorted(benchmarks)}; keep jobs of one")
    for name, frame in zip(FILES, (pd.concat(errors), pd.DataFrame(costs))):
        rows = _as_written(StringIO(frame.to_csv(index=False, float_format="%.4g")))
        if beside is not None:
            with explained(beside / name, ValueError):
                rows = _joined(rows, _as_written(beside / name))
        write(out / name, _in_order(rows).to_csv(index=False))


def _as_written(source: Path | StringIO) -> pd.DataFrame:
    """Read a CSV file as text, so that every digit is kept."""
    return pd.read_csv(source, dtype=str, keep_default_na=False)


def _joined(rows: pd.DataFrame, earlier: pd.DataFrame) -> pd.DataFrame:
    """Return the jobs' rows, in the columns of ``earlier``, and then the rows of ``earlier`` for other observers."""
    here, there = (_conditions(frame, set(rows.system) & set(earlier.system)) for frame in (rows, earlier))
    if here != there:
        raise ValueError(
            f"it is of another benchmark: {'; '.join(sorted(there))} there, {'; '.join(sorted(here))} here"
        )
    observers = set(zip(rows.system, rows.method))
    others = [observer not in observers for observer in zip(earlier.system, earlier.method)]
    return pd.concat([rows.reindex(columns=earlier.columns, fill_value=""), earlier[others]])


def _conditions(frame: pd.DataFrame, systems: set[str]) -> set[str]:
    """Return what joined files must share: budget and seed (methods.csv), or cases of ``systems`` (results.csv)."""
    if "budget" in frame:
        return {f"budget {budget}, seed {seed}" for budget, seed in zip(frame.budget, frame.seed)}
    cases = frame[frame.system.isin(systems)][["system", "starts", "noise"]].drop_duplicates()
    return {f"{system} in {starts} at {show_level(read_level(noise))}" for system, starts, noise in cases.to_numpy()}


def _in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """Sort rows by system and method (SYSTEMS, ABLATION and METHODS first); an observer's rows keep their order."""
    places = [
        {name: place for place, name in enumerate(dict.fromkeys([*shipped, *sorted(set(column))]))}
        for shipped, column in ((SYSTEMS, rows.system), (ABLATION | METHODS, rows.method))
    ]
    keys = [[place[name] for name in column] for place, column in zip(places, (rows.system, rows.method))]
    return rows.iloc[np.lexsort(keys[::-1])]


def check_results(folder: Path) -> None:
    """Raise ValueError unless a folder has both CSV files."""
    for name in FILES:
        if not (folder / name).exists():
            raise ValueError(f"{folder / name} does not exist; run the benchmark first")


def report(out: Path) -> None:
    """Write table.md and heatmap.png from the CSV files."""
    results, methods, note = _read(out)
    write_table(out / "table.md", results, methods, note=note)
    draw(out / "heatmap.png", results, methods, note=note)


def draw_results(out: Path, path: Path) -> None:
    """Draw only the heatmap from the CSV files."""
    results, methods, note = _read(out)
    draw(path, results, methods, note=note)


def _read(out: Path) -> tuple[pd.DataFrame, pd.DataFrame, str]:
    """Read results and methods, and return them with a note on the conditions."""
    check_results(out)
    results, methods = (pd.read_csv(out / name) for name in FILES)
    budget = BUDGETS[methods.budget[0]]
    spent = f"{budget.cpu_seconds:g} CPU seconds" if math.isfinite(budget.cpu_seconds) else f"{budget.steps} batches"
    note = (
        f"{spent} for each training, seed {methods.seed[0]}, {methods.trajectories.max()} trajectories for each cell."
    )
    return results, methods, note
