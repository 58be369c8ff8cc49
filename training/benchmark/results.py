"""The results of a benchmark's jobs, put together: as CSV files, as a table and as a figure."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from kkl_gym.systems import SYSTEMS
from observers.storage import explained, write
from training.benchmark.tables import draw, write_table
from training.methods import ABLATION, METHODS

NAMED = 4  # of the methods that are missing, by their names


def _full_set(found: Iterable[str]) -> list[str]:
    """The shipped methods, in order, of the comparison that some are of: the benchmark, the ablation, or both."""
    names = set(found)
    ablation = bool(names & (set(ABLATION) - set(METHODS)))
    benchmark = bool(names & (set(METHODS) - set(ABLATION)))
    if ablation:
        return list(METHODS | ABLATION if benchmark else ABLATION)
    return list(METHODS)


def collect(out: Path) -> None:
    """Write one CSV file of all errors and one of all costs, from every job found in the folder.

    Parameters
    ----------
    out : Path
        Folder of the benchmark.

    Raises
    ------
    ValueError
        If they are not all of one benchmark, or a file is damaged.
    """
    errors, costs = [], []
    rules: dict[str, Any] = {}

    systems, methods = list(SYSTEMS), _full_set(path.name for path in (out / "jobs").glob("*/*"))  # then the user's

    def position(folder: Path) -> tuple[int, str, int, str]:
        system, method = folder.parent.name, folder.name
        first = systems.index(system) if system in systems else len(systems)
        second = methods.index(method) if method in methods else len(methods)
        return first, system, second, method

    for folder in sorted((path.parent for path in (out / "jobs").glob("*/*/errors.csv")), key=position):
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
    write(out / "results.csv", pd.concat(errors).to_csv(index=False, float_format="%.4g"))
    write(out / "methods.csv", pd.DataFrame(costs).to_csv(index=False, float_format="%.4g"))


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


def report(out: Path) -> str:
    """Write table.md and heatmap.png from the CSV files.

    Parameters
    ----------
    out : Path
        Folder of the benchmark.

    Returns
    -------
    str
        What was compared, and what is missing.

    Raises
    ------
    ValueError
        If there are no CSV files.
    """
    for name in ("results.csv", "methods.csv"):
        if not (out / name).exists():
            raise ValueError(f"{out / name} does not exist; run the benchmark first")
    results, methods = pd.read_csv(out / "results.csv"), pd.read_csv(out / "methods.csv")
    note = f"Budget {methods.budget[0]}, seed {methods.seed[0]}, {methods.trajectories.max()} trajectories a case."
    partial, missing = _missing(methods)
    write_table(out / "table.md", results, methods, note=note + partial + missing)
    draw(out / "heatmap.png", results, methods, note=note + partial)
    return note + partial + missing


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
