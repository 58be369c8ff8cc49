"""``kkl-gym agent compare ENV_ID ...``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from observers.storage import explained, write
from training.agents.any_environment.comparison import MANY, RANDOM, collect, planned, run_case
from training.agents.any_environment.information import SHOWN, Shown
from training.agents.any_environment.tables import curves, draw_curves, draw_scores, write_table
from training.agents.any_environment.task import HiddenTask
from training.commands.running import Workers, run_missing
from training.progress import LOG, progress_bars

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = {
    "results.csv": ["environment", "noise", "shown", "seed", "return", "seconds"],
    "curves.csv": ["environment", "noise", "shown", "steps", "seconds", "return"],
}


def compare_environments(
    tasks: Sequence[HiddenTask],
    out: Path,
    console: Console,
    *,
    kinds: Sequence[Shown] = SHOWN,
    seeds: int,
    episodes: int,
    timesteps: int | None,
    aggregate: int,
    workers: Workers,
    beside: Path | None = None,
) -> None:
    """Run what is missing of a comparison, then report.

    Parameters
    ----------
    tasks : sequence of HiddenTask
        Where agents act.
    out : Path
        Receives results.csv, curves.csv, table.md, scores.png and curves.png.
    console : rich.console.Console
        Where progress is shown.
    kinds : sequence of str
        What agents are shown.
    seeds, episodes : int
        Agents of each kind, and episodes that each is played on.
    timesteps : int or None
        Steps to learn from.
    aggregate : int
        How many times observers are fitted again.
    workers : Workers
        Where agents are trained.
    beside : Path, optional
        Folder with results.csv and curves.csv of an earlier run, whose rows of other environments are taken over.

    Raises
    ------
    ValueError
        If the folder holds another comparison, a file of the earlier run is damaged or missing, or a training failed.
    """
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
                recurrent_seeds=MANY,
                episodes=episodes,
                timesteps=timesteps,
                aggregate=aggregate,
            )
            there = [case for case in every if case.done]  # whichever run it is from
            results = collect(there)
            if len(results) and set(results.shown) - {"state", RANDOM}:
                missing = sum(not case.done for case in cases)
                partial = f" Partial: {missing} of {len(cases)} agents are missing." if missing else ""
                results, learned = (
                    _joined(rows, earlier[name]) for name, rows in zip(COLUMNS, (results, curves(there)))
                )
                write(out / "results.csv", results.to_csv(index=False))
                write(out / "curves.csv", learned.to_csv(index=False))
                write_table(out / "table.md", results, partial)
                draw_scores(out / "scores.png", results, partial)
                draw_curves(out / "curves.png", learned, partial)
                progress.say(f"wrote results.csv, curves.csv, table.md, scores.png and curves.png in {out}")
    if failures:
        raise ValueError(f"{len(failures)} of {len(cases)} agents failed; the first: {failures[0]}")


def _earlier(folder: Path | None, name: str) -> "pd.DataFrame":
    """Rows of an earlier run, none without one."""
    import pandas as pd  # which takes half a second that help need not wait for

    if folder is None:
        return pd.DataFrame(columns=COLUMNS[name])
    with explained(folder / name, ValueError):
        rows = pd.read_csv(folder / name)
        if list(rows.columns) != COLUMNS[name]:
            raise ValueError(f"its columns are {', '.join(rows.columns)}, not {', '.join(COLUMNS[name])}")
        return rows


def _joined(rows: "pd.DataFrame", earlier: "pd.DataFrame") -> "pd.DataFrame":
    """Those of other environments first, as they are; of one environment all rows are of one run."""
    import pandas as pd

    others = earlier[~earlier.environment.isin(set(rows.environment))]
    return pd.concat([others, rows]) if len(others) else rows
