"""The table and the figures of a comparison in any environments."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from examples.research.agents import statistics
from examples.research.agents.statistics import interval, middle, normalised
from examples.research.environments.comparison import KINDS, RANDOM, Case
from observers.storage import write
from training import markdown
from training.figures import drawing

if TYPE_CHECKING:
    import pandas as pd

LABELS = {
    "state": "full state",
    "x_hat": "y and x̂",
    "stacked_x_hat": "y and estimates of stacks",
    "z": "y and z",
    "stacked": "stacked y and actions",
    "recurrent": "y, recurrent agent",
    "y": "y",
}
POINTS = 60  # of a learning curve
WINDOW = 0.05  # of a training's steps, over which a learning curve is averaged
Task = tuple[str, float]  # an environment and a noise


def tasks_in(results: "pd.DataFrame") -> list[Task]:
    """Environments and noises of results, in their order, but for those of the full state alone."""
    of = results[~results.shown.isin(["state", RANDOM])]
    found = of[["environment", "noise"]].drop_duplicates().itertuples(index=False, name=None)
    return [(str(env_id), float(noise)) for env_id, noise in found]


def cell(results: "pd.DataFrame", task: Task, shown: str) -> dict[str, Any] | None:
    """What a table says of agents that are shown the same."""
    here = results[results.environment == task[0]]
    noise = 0.0 if shown == "state" else task[1]
    mine = here[(here.shown == shown) & (here.noise == noise)]
    if mine.empty:
        return None
    values = mine["return"].to_numpy()
    found: dict[str, Any] = {"returns": values, "middle": float(middle(values)), "seconds": float(mine.seconds.mean())}
    random, best = here[here.shown == RANDOM]["return"], here[here.shown == "state"]["return"].to_numpy()
    if len(random) and len(best):
        idle = float(random.iloc[0])
        top = values if shown == "state" else best
        found["interval"] = interval(values, top, idle)
        found["agents"] = normalised(values, float(middle(top)), idle)
    return found


def write_table(path: Path, results: "pd.DataFrame", partial: str = "", settings: str = "") -> None:
    """Write the table of a comparison."""
    tasks = tasks_in(results)
    shown = [kind for kind in KINDS if kind in set(results.shown)]
    lines = [
        "# Agents in any environment",
        "",
        "Return: interquartile mean over agents. In brackets the normalised return, where 0 is random actions and 1 "
        "agents that see the full state without noise, with a bootstrap 95 % interval; then the number of agents. The "
        f"steps from which an observer was learned count.{partial}",
        *(["", settings] if settings else []),
        "",
    ]
    rows, spent = [], []
    for task in tasks:
        row, times = [_named(task)], [_named(task)]
        for kind in shown:
            found = cell(results, task, kind)
            row.append("–" if found is None else _written(found))
            times.append("–" if found is None else f"{found['seconds']:.0f}")
        random = results[(results.environment == task[0]) & (results.shown == RANDOM)]["return"]
        rows.append([*row, f"{random.iloc[0]:.4g}" if len(random) else "–"])
        spent.append(times)
    heads = ["", *(LABELS[kind] for kind in shown)]
    lines += markdown.table([*heads, "random"], rows)
    lines += ["", "CPU seconds for one training:", "", *markdown.table(heads, spent)]
    write(path, "\n".join(lines) + "\n")


def _named(task: Task) -> str:
    return task[0] + (f", noise {task[1]:g}" if task[1] else "")


def _written(found: Mapping[str, Any]) -> str:
    text = f"{found['middle']:.4g}"
    if "interval" in found:
        value, low, high = found["interval"]
        spread = "" if np.isnan(low) else f", {low:.2f} to {high:.2f}"
        text += f" ({value:.2f}{spread})"
    return f"{text}, {len(found['returns'])}"


def draw_scores(path: Path, results: "pd.DataFrame", partial: str = "") -> None:
    """Draw the normalised returns of all agents."""
    shown = [kind for kind in reversed(KINDS) if kind in set(results.shown)]
    panels = {}
    for task in tasks_in(results):
        found = [cell(results, task, kind) for kind in shown]
        known = [one if one is not None and np.isfinite(one.get("interval", [np.nan])[0]) else None for one in found]
        panels[_named(task)] = known
    title = f"What agents are shown and how well they act.{partial}"
    statistics.draw_scores(path, panels, [LABELS[kind] for kind in shown], title)


def curves(cases: Sequence[Case]) -> "pd.DataFrame":
    """Learning curves: returns of training episodes, averaged over a twentieth of the training, over its steps."""
    import pandas as pd

    groups: dict[tuple[str, float, str], list[pd.DataFrame]] = {}
    for case in cases:
        if case.kind != RANDOM:
            curve = pd.read_csv(case.folder / "curve.csv")
            if len(curve) > 1:
                groups.setdefault((case.task.env_id, case.task.measurement_noise, case.kind), []).append(curve)
    rows = []
    for (env_id, noise, kind), group in groups.items():
        last = max(float(curve.steps.iloc[-1]) for curve in group)
        first = max(float(curve.steps.iloc[0]) for curve in group)
        for steps in np.linspace(first, last, POINTS):
            near = [curve[(curve.steps > steps - WINDOW * last) & (curve.steps <= steps)] for curve in group]
            means = np.array([part["return"].mean() for part in near if len(part)])
            if len(means):
                seconds = [np.interp(steps, curve.steps, curve.seconds) for curve in group]
                value, spent = float(middle(means)), float(middle(np.array(seconds)))
                rows.append((env_id, noise, kind, round(steps), round(spent, 2), round(value, 3)))
    return pd.DataFrame(rows, columns=["environment", "noise", "shown", "steps", "seconds", "return"])


def draw_curves(path: Path, found: "pd.DataFrame", partial: str = "") -> None:
    """Draw learning curves against steps and against CPU seconds."""
    tasks = tasks_in(found)
    rows = max(1, math.ceil(len(tasks) / 2))
    with drawing(path, 12.0, 2.3 * rows + 0.8) as figure:
        axes = figure.subplots(rows, 4, squeeze=False)
        lines = dict[str, Any]()
        for pair, (env_id, noise) in zip(axes.reshape(-1, 2), tasks):
            for i, kind in enumerate(KINDS):
                level = 0.0 if kind == "state" else noise
                of = found[(found.environment == env_id) & (found.noise == level) & (found.shown == kind)]
                for ax, over in zip(pair, ("steps", "seconds")):
                    if len(of):
                        (lines[LABELS[kind]],) = ax.plot(of[over], of["return"], color=f"C{i}")
            pair[0].set(ylabel="return", title=_named((env_id, noise)), xlabel="steps of the environment")
            pair[0].xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}k")
            pair[1].set(xlabel="CPU seconds", xscale="log")
            pair[1].sharey(pair[0])
            pair[1].tick_params(labelleft=False)
        for ax in axes.reshape(-1)[2 * len(tasks) :]:
            ax.set_visible(False)
        figure.suptitle(f"Learning curves.{partial}")
        labels = [label for label in LABELS.values() if label in lines]
        figure.legend([lines[label] for label in labels], labels, loc="outside lower center", ncols=len(KINDS))


__all__ = ["LABELS", "cell", "curves", "draw_curves", "draw_scores", "tasks_in", "write_table"]
