"""``kkl-gym agent compare ENV_ID ...``."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from observers.storage import write
from training.agents.any_environment.comparison import MANY, RANDOM, collect, planned, run_case
from training.agents.any_environment.information import SHOWN, Shown
from training.agents.any_environment.tables import curves, draw_curves, draw_scores, write_table
from training.agents.any_environment.task import HiddenTask
from training.commands.running import Workers, run_missing
from training.progress import LOG, progress_bars


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

    Raises
    ------
    ValueError
        If the folder holds another comparison, or a training failed.
    """
    cases = planned(tasks, out, kinds=kinds, seeds=seeds, episodes=episodes, timesteps=timesteps, aggregate=aggregate)
    for task in tasks:
        task.make().close()  # an error now, not when its turn comes
    failures = list[str]()
    try:
        with progress_bars(console, out / LOG) as progress:
            failures = run_missing(run_case, cases, workers=workers, what="agents", progress=progress)
    finally:  # also after an interruption
        with progress_bars(console, out / LOG) as progress, progress.phase("collecting results"):
            every = planned(tasks, out, seeds=MANY, episodes=episodes, timesteps=timesteps, aggregate=aggregate)
            there = [case for case in every if case.done]  # whichever run it is from
            results = collect(there)
            if len(results) and set(results.shown) - {"state", RANDOM}:
                missing = sum(not case.done for case in cases)
                partial = f" Partial: {missing} of {len(cases)} agents are missing." if missing else ""
                learned = curves(there)
                write(out / "results.csv", results.to_csv(index=False))
                write(out / "curves.csv", learned.to_csv(index=False))
                write_table(out / "table.md", results, partial)
                draw_scores(out / "scores.png", results, partial)
                draw_curves(out / "curves.png", learned, partial)
                progress.say(f"wrote results.csv, curves.csv, table.md, scores.png and curves.png in {out}")
    if failures:
        raise ValueError(f"{len(failures)} of {len(cases)} agents failed; the first: {failures[0]}")
