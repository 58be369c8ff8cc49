"""Tables and figures of compared agents, from results.csv, and learning curves from the agents' folders."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from examples.research.agents.comparison import COLUMNS, IDLE, IN_ENVIRONMENTS, KINDS, ON_SYSTEMS, ComparedAgent
from examples.research.agents.statistics import interval, middle, normalised
from training import files
from training.evaluation.levels import as_cell
from training.figures import MEASURED, RIVAL, drawing
from training.files import write

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

LABELS = {
    "state": "full state",
    "ekf": "EKF estimate",
    "x_hat": "x̂",
    "x_hat_std": "x̂ and its standard deviations",
    "z": "z",
    "traces": "traces of y and actions",
    "stacked": "8 y and actions",
    "y": "y",
    "recurrent": "y, recurrent agent",
    "recurrent-state": "full state, recurrent agent",
}
LABELS_IN_ENVIRONMENTS = LABELS | {
    "x_hat": "y and x̂",
    "z": "y and z",
    "stacked": "stacked y and actions",
}
PANELS_IN_A_ROW = 3
NARROWEST = 7.0  # least width in inches of a figure with its title
POINTS = 60  # points of a learning curve
WINDOW = 0.05  # a learning curve is averaged over this share of the steps


@dataclass(frozen=True)
class Cell:
    """Agents of one kind in one task: their returns ``values`` (n,) and normalised ``scores`` (n,).

    ``interval``: interquartile mean score, low, high. If idle or full-state agents are missing, all scores are NaN.
    """

    values: np.ndarray
    scores: np.ndarray
    interval: tuple[float, float, float]
    success: float
    seconds: float


def on_systems(results: "pd.DataFrame") -> bool:
    """Whether results are of agents on systems, which have success rates."""
    return bool(results.success.notna().any())


def tasks_in(results: "pd.DataFrame") -> list[tuple[str, Any]]:
    """Return environment and noise level of each task that has agents other than full-state and idle ones, in order."""
    partly = results[~results.shown.isin(["state", IDLE])]
    return list(partly[["environment", "noise"]].drop_duplicates().itertuples(index=False, name=None))


def _kinds_in(results: "pd.DataFrame") -> list[str]:
    """Return kinds of agents in the table's order; on systems, default kinds are included even without results."""
    systems = on_systems(results)
    there = {*results.shown} | ({*ON_SYSTEMS} if systems else set())
    order = KINDS if systems else dict.fromkeys((*IN_ENVIRONMENTS, *KINDS))
    return [kind for kind in order if kind in there]


def _labels(results: "pd.DataFrame") -> dict[str, str]:
    labels = LABELS if on_systems(results) else LABELS_IN_ENVIRONMENTS
    return {kind: labels[kind] for kind in _kinds_in(results)}


def _task_name(environment: str, noise: float | str) -> str:
    """Return a task's title; ``noise`` is a number, or a text with a level for each output."""
    try:
        level = f"{float(noise):g}"
    except ValueError:
        level = str(noise)
    return environment.replace("_", " ") + ("" if level == "0" else f", noise {level}")


def in_tasks(results: "pd.DataFrame") -> "pd.DataFrame":
    """Add columns task and idle (return). In environments, all noise levels share full-state and idle agents."""
    import pandas as pd

    tasks = []
    for environment, noise in tasks_in(results):
        here = results[results.environment == environment]
        same = here.noise == noise
        state = same if on_systems(results) else here.noise == 0.0
        idle = here[(here.shown == IDLE) & state]["return"]
        rows = here[np.where(here.shown == "state", state, same) & (here.shown != IDLE)]
        value = idle.iloc[0] if len(idle) else np.nan
        tasks.append(rows.assign(task=_task_name(environment, noise), idle=value))
    return pd.concat(tasks) if tasks else results.assign(task="", idle=np.nan)[:0]


def cells(rows: "pd.DataFrame") -> dict[tuple[str, str], Cell]:
    """Return cells by task and kind, from the rows of :func:`in_tasks`."""
    by_kind = {}
    for (task, kind), group in rows.groupby(["task", "shown"], sort=False):
        values, idle = group["return"].to_numpy(), float(group.idle.iloc[0])
        best = rows[(rows.task == task) & (rows.shown == "state")]["return"].to_numpy()
        best = values if kind == "state" else best
        ends, scores = (np.nan, np.nan, np.nan), np.full(len(values), np.nan)
        if len(best) and np.isfinite(idle):
            ends, scores = interval(values, best, idle), normalised(values, float(middle(best)), idle)
        by_kind[str(task), str(kind)] = Cell(values, scores, ends, group.success.mean(), group.seconds.mean())
    return by_kind


def write_table(path: Path, results: "pd.DataFrame", partial: str = "", settings: str = "") -> None:
    """Write the table of a comparison on systems or in environments."""
    rows, labels = in_tasks(results), _labels(results)
    table = _table_of_systems if on_systems(results) else _table_of_environments
    lines = table(results, cells(rows), list(dict.fromkeys(rows.task)), labels, partial)
    if settings:
        lines[3:3] = [settings, ""]
    write(path, "\n".join(lines) + "\n")


def _table_of_systems(
    results: "pd.DataFrame",
    by_kind: Mapping[tuple[str, str], Cell],
    tasks: Sequence[str],
    labels: Mapping[str, str],
    partial: str,
) -> list[str]:
    def text(cell: Cell | None) -> str:
        if cell is None or np.isnan(cell.interval[0]):
            return "–"
        score, low, high = cell.interval
        ends = "" if np.isnan(low) else f" [{low:.2f}, {high:.2f}]"
        return f"{score:.2f}{ends}, {100 * cell.success:.0f} %, {len(cell.values)}"

    table = [[label, *(text(by_kind.get((task, kind))) for task in tasks)] for kind, label in labels.items()]
    minutes = results[results.shown != IDLE].groupby("shown").seconds.mean() / 60
    spent = "; ".join(f"{label}: {minutes[kind]:.1f}" for kind, label in labels.items() if kind in minutes)
    return [
        "# Agents",
        "",
        "Normalised score: 0 is zero input, 1 the interquartile mean of the agents that know the full state. "
        "Interquartile mean over agents [bootstrap 95 % interval], success rate in %, number of agents. Observers see "
        f"every sample of y; agents on y see one sample for each action.{partial}",
        "",
        *files.table(["", *tasks], table),
        "",
        f"CPU minutes for one training – {spent}.",
    ]


def _table_of_environments(
    results: "pd.DataFrame",
    by_kind: Mapping[tuple[str, str], Cell],
    tasks: Sequence[str],
    labels: Mapping[str, str],
    partial: str,
) -> list[str]:
    def text(cell: Cell | None) -> str:
        if cell is None:
            return "–"
        score, low, high = cell.interval
        ends = "" if np.isnan(low) else f", {low:.2f} to {high:.2f}"
        scale = "" if np.isnan(score) else f" ({score:.2f}{ends})"
        return f"{float(middle(cell.values)):.4g}{scale}, {len(cell.values)}"

    rows, spent = [], []
    for task, (environment, _) in zip(tasks, tasks_in(results), strict=True):
        own = [by_kind.get((task, kind)) for kind in labels]
        random = results[(results.environment == environment) & (results.shown == IDLE)]["return"]
        rows.append([task, *map(text, own), f"{random.iloc[0]:.4g}" if len(random) else "–"])
        spent.append([task, *("–" if cell is None else f"{cell.seconds:.0f}" for cell in own)])
    heads = ["", *labels.values()]
    return [
        "# Agents in any environment",
        "",
        "Return: interquartile mean over agents. In brackets the normalised return (0: random actions; 1: agents that "
        "see the full state without noise) with a bootstrap 95 % interval; then the number of agents. "
        f"Steps that trained an observer count as training steps.{partial}",
        "",
        *files.table([*heads, "random"], rows),
        "",
        "CPU seconds for one training:",
        "",
        *files.table(heads, spent),
    ]


def draw_scores(path: Path, results: "pd.DataFrame", partial: str = "") -> None:
    """Draw the normalised scores: a panel for each task, with a row for each kind of agents."""
    rows, kinds = in_tasks(results), _labels(results)
    by_kind, tasks = cells(rows), list(dict.fromkeys(rows.task))
    columns = min(PANELS_IN_A_ROW, max(1, len(tasks)))
    lines = -(-len(tasks) // columns)
    with drawing(path, max(NARROWEST, 2.6 * columns + 1.5), 2.6 * lines + 0.6) as figure:
        axes = figure.subplots(max(1, lines), columns, sharey=True, squeeze=False).ravel()
        for ax, task in zip(axes, tasks):
            _draw_panel(ax, [by_kind.get((task, kind)) for kind in kinds][::-1])
            ax.set(title=task, xlabel="normalised score")
            ax.set_yticks(range(len(kinds)), list(kinds.values())[::-1])
        for ax in axes[len(tasks) :]:
            ax.set_axis_off()
        figure.suptitle(f"What agents {'know' if on_systems(results) else 'are shown'} and how well they act.{partial}")


def _draw_panel(ax: "Axes", row: Sequence[Cell | None]) -> None:
    """Draw one panel: agents as dots, means with intervals. ``row`` holds the panel's cells from bottom to top."""
    for place, cell in enumerate(row):
        if cell is not None and np.isfinite(cell.interval[0]):
            score, low, high = cell.interval
            ax.plot(cell.scores, np.full(len(cell.scores), place), ".", color=MEASURED)
            ax.plot([low, high], [place, place], color=RIVAL, lw=2)
            ax.plot(score, place, "o", color=RIVAL, markersize=6)
    ax.axvline(1.0, color=MEASURED, lw=0.8)
    ax.locator_params(axis="x", nbins=4)


def curves(agents: Sequence[ComparedAgent]) -> "pd.DataFrame":
    """Return learning curves: returns of training episodes by steps, averaged over a twentieth of the training."""
    import pandas as pd

    groups: dict[tuple[str, Any, str], list[pd.DataFrame]] = {}
    for agent in agents:
        if agent.kind != IDLE:
            curve = pd.read_csv(agent.folder / "curve.csv")
            if len(curve) > 1:
                key = (agent.task.name, as_cell(agent.task.measurement_noise), agent.kind)
                groups.setdefault(key, []).append(curve)
    rows = []
    for (environment, noise, kind), group in groups.items():
        last = max(float(curve.steps.iloc[-1]) for curve in group)
        first = max(float(curve.steps.iloc[0]) for curve in group)
        for steps in np.linspace(first, last, POINTS):
            near = [curve[(curve.steps > steps - WINDOW * last) & (curve.steps <= steps)] for curve in group]
            means = np.array([part["return"].mean() for part in near if len(part)])
            if len(means):
                seconds = [np.interp(steps, curve.steps, curve.seconds) for curve in group]
                value, spent = float(middle(means)), float(middle(np.array(seconds)))
                rows.append((environment, noise, kind, round(steps), round(spent, 2), round(value, 3)))
    return pd.DataFrame(rows, columns=COLUMNS["curves.csv"])


def draw_curves(path: Path, learned: "pd.DataFrame", partial: str = "", *, systems: bool = False) -> None:
    """Draw learning curves by steps and by CPU seconds."""
    tasks = tasks_in(learned)
    rows = max(1, math.ceil(len(tasks) / 2))
    with drawing(path, 12.0, 2.3 * rows + 0.8) as figure:
        axes = figure.subplots(rows, 4, squeeze=False)
        lines = dict[str, Any]()
        for pair, (environment, noise) in zip(axes.reshape(-1, 2), tasks):
            own = learned[learned.environment == environment]
            for i, (kind, label) in enumerate((LABELS if systems else LABELS_IN_ENVIRONMENTS).items()):
                one = own[(own.noise == noise) & (own.shown == kind)]
                if kind == "state" and one.empty:
                    one = own[(own.noise == 0.0) & (own.shown == kind)]
                for ax, over in zip(pair, ("steps", "seconds")):
                    if len(one):
                        (lines[label],) = ax.plot(one[over], one["return"], color=f"C{i}")
            pair[0].set(ylabel="return", title=_task_name(environment, noise), xlabel="steps of the environment")
            pair[0].xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}k")
            pair[1].set(xlabel="CPU seconds", xscale="log")
            pair[1].sharey(pair[0])
            pair[1].tick_params(labelleft=False)
        for ax in axes.reshape(-1)[2 * len(tasks) :]:
            ax.set_visible(False)
        figure.suptitle(f"Learning curves.{partial}")
        figure.legend(lines.values(), lines, loc="outside lower center", ncols=len(lines) or 1)
