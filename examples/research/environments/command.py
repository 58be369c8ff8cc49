"""``python -m examples.research agents ENV_ID ...``."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from examples.research.environments.comparison import KINDS, MANY, RANDOM, Kind, collect, planned, run_case
from examples.research.environments.tables import curves, draw_curves, draw_scores, write_table
from observers.storage import explained, write
from training.agents.any_environment.task import HiddenTask
from training.commands.running import Workers, run_missing
from training.progress import LOG, progress_bars

if TYPE_CHECKING:
    import pandas as pd

SETTINGS = ("time_constants", "frames", "past_actions", "angles")  # of tasks, that a command gives to all
COLUMNS = {
    "results.csv": ["environment", "noise", "shown", "seed", "return", "seconds"],
    "curves.csv": ["environment", "noise", "shown", "steps", "seconds", "return"],
}


def compare_environments(
    tasks: Sequence[HiddenTask],
    out: Path,
    console: Console,
    *,
    kinds: Sequence[Kind] = KINDS,
    seeds: int,
    episodes: int,
    timesteps: int | None,
    aggregate: int,
    workers: Workers,
    beside: Path | None = None,
) -> None:
    """Run what is missing of a comparison, then report."""
    earlier = {name: _earlier(beside, name) for name in COLUMNS}  # an error now, not after hours
    cases = planned(tasks, out, kinds=kinds, seeds=seeds, episodes=episodes, timesteps=timesteps, aggregate=aggregate)
    for task in tasks:
        task.make().close()  # an error now, not when its turn comes
    failures = list[str]()
    try:
        with progress_bars(console, out / LOG) as progress:
            failures = run_missing(run_case, cases, workers=workers, what="agents", progress=progress)
    finally:  # also after an interruption
        with progress_bars(console, out / LOG) as progress, progress.phase("collecting results"):
            every = planned(
                tasks,
                out,
                seeds=MANY,
                episodes=episodes,
                timesteps=timesteps,
                aggregate=aggregate,
            )
            there = [case for case in every if case.done]  # whichever run it is from
            here = collect(there)
            results = _joined(here, earlier["results.csv"], here) if len(here) else here
            if len(results) and set(results.shown) - {"state", RANDOM}:
                missing = sum(not case.done for case in cases)
                partial = f" Partial: {missing} of {len(cases)} agents are missing." if missing else ""
                learned = _joined(curves(there), earlier["curves.csv"], here)
                if beside is not None:
                    progress.say(f"beside these {len(here)} agents, {len(results) - len(here)} from {beside}")
                write(out / "results.csv", results.to_csv(index=False))
                write(out / "curves.csv", learned.to_csv(index=False))
                write_table(out / "table.md", results, partial, unusual(tasks))
                draw_scores(out / "scores.png", results, partial)
                draw_curves(out / "curves.png", learned, partial)
                progress.say(f"wrote results.csv, curves.csv, table.md, scores.png and curves.png in {out}")
    if failures:
        raise ValueError(f"{len(failures)} of {len(cases)} agents failed; the first: {failures[0]}")


def unusual(tasks: Sequence[HiddenTask]) -> str:
    """What agents on memories and stacks were told that is not as by default, as a sentence, or nothing."""
    found = []
    for field in fields(HiddenTask):
        values = {getattr(task, field.name) for task in tasks} if field.name in SETTINGS else set()
        found += [f"`{field.name}` {value}" for value in values if value != field.default]
    return f"Agents on z and on stacked observations: {', '.join(found)}." if found else ""


def _earlier(folder: Path | None, name: str) -> "pd.DataFrame":
    """Rows of an earlier run, none without one; raises ValueError or OSError if they cannot be taken over."""
    import pandas as pd  # which takes half a second that help need not wait for

    columns = COLUMNS[name]
    if folder is None:
        return pd.DataFrame(columns=columns)
    with explained(folder / name, ValueError):
        rows = pd.read_csv(folder / name, index_col=False)
        if list(rows.columns) != columns:
            raise ValueError(f"its columns are {', '.join(rows.columns)}, not {', '.join(columns)}")
        for column in columns:
            number = rows.empty or pd.api.types.is_numeric_dtype(rows[column])
            if column not in ("environment", "shown") and not number:
                raise ValueError(f"column {column} holds something that is no number")
        if rows.isna().any(axis=None):
            raise ValueError(f"row {rows.index[rows.isna().any(axis=1)][0] + 2} lacks a value")
        if unknown := set(rows.shown) - {*KINDS, RANDOM}:
            raise ValueError(f"agents are shown {', '.join(sorted(unknown))}; known are {', '.join(KINDS)}")
        if (twice := rows.duplicated(columns[:4])).any():
            raise ValueError(f"row {rows.index[twice][0] + 2} says again what one before it says")
    return rows


def _joined(rows: "pd.DataFrame", earlier: "pd.DataFrame", here: "pd.DataFrame") -> "pd.DataFrame":
    """Those of an earlier run first, but for what agents of this run are shown in the same environment and noise."""
    import pandas as pd

    what = ["environment", "noise", "shown"]
    others = earlier[~pd.MultiIndex.from_frame(earlier[what]).isin(pd.MultiIndex.from_frame(here[what]))]
    if others.empty:
        return rows
    joined = pd.concat([others, rows])
    return joined.iloc[np.argsort(pd.factorize(joined.environment)[0], kind="stable")]
