"""Tables and figures of compared agents, from their results.csv alone."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from examples.research.agents import environment_agents, system_agents
from examples.research.agents.environment_agents import RANDOM, EnvironmentAgent
from examples.research.agents.statistics import interval, middle, normalised
from training import markdown
from training.agents.tasks import TASKS
from training.evaluation.levels import as_name
from training.figures import MEASURED, RIVAL, drawing
from training.files import write

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

ON_SYSTEMS = {
    "state": "full state",
    "ekf": "EKF estimate",
    "x_hat": "x̂",
    "x_hat_std": "x̂ and its standard deviations",
    "z": "z",
    "stacked": "8 y and actions",
    "y": "y",
    "recurrent": "y, recurrent agent",
    "recurrent-state": "full state, recurrent agent",
}
IN_ENVIRONMENTS = {
    "state": "full state",
    "x_hat": "y and x̂",
    "stacked_x_hat": "y and estimates of stacks",
    "z": "y and z",
    "stacked": "stacked y and actions",
    "recurrent": "y, recurrent agent",
    "y": "y",
}
PANELS_IN_A_ROW = 3
NARROWEST = 7.0  # inches, of a figure with its title
POINTS = 60  # of a learning curve
WINDOW = 0.05  # share of a training's steps over which a learning curve is averaged


@dataclass(frozen=True)
class Cell:
    """Agents of one kind in one task.

    Shapes: ``values``, ``scores`` (n,); ``scores`` and ``interval`` are normalised, NaN if the task has no scale.
    """

    values: np.ndarray
    scores: np.ndarray
    interval: tuple[float, float, float]
    success: float
    seconds: float


def cells(rows: "pd.DataFrame") -> dict[tuple[str, str], Cell]:
    """Cells by task and kind, of rows with task, kind, value, seconds, success and idle, the value of idle actions."""
    found = {}
    for (task, kind), group in rows.groupby(["task", "kind"], sort=False):
        values, idle = group.value.to_numpy(), float(group.idle.iloc[0])
        best = rows[(rows.task == task) & (rows.kind == "state")].value.to_numpy()
        best = values if kind == "state" else best
        ends, scores = (np.nan, np.nan, np.nan), np.full(len(values), np.nan)
        if len(best) and np.isfinite(idle):
            ends, scores = interval(values, best, idle), normalised(values, float(middle(best)), idle)
        found[str(task), str(kind)] = Cell(values, scores, ends, group.success.mean(), group.seconds.mean())
    return found


def report_systems(out: Path) -> None:
    """Write table.md and scores.png from results.csv."""
    rows, partial = _on_systems(out)
    found, tasks = cells(rows), list(dict.fromkeys(rows.task))
    lines = [
        "# Agents",
        "",
        "Normalised score: 0 is zero input, 1 the interquartile mean of the agents that know the full state. "
        "Interquartile mean over agents [bootstrap 95 % interval], success rate in %, number of agents. Observers see "
        f"every sample of y; agents on y see it once for each action.{partial}",
        "",
    ]

    def text(cell: Cell | None) -> str:
        if cell is None or np.isnan(cell.interval[0]):
            return "–"
        score, low, high = cell.interval
        ends = "" if np.isnan(low) else f" [{low:.2f}, {high:.2f}]"
        return f"{score:.2f}{ends}, {100 * cell.success:.0f} %, {len(cell.values)}"

    kinds = _kinds_on_systems(rows)
    table = [[ON_SYSTEMS[kind], *(text(found.get((task, kind))) for task in tasks)] for kind in kinds]
    minutes = rows.groupby("kind").seconds.mean() / 60
    spent = ", ".join(f"{ON_SYSTEMS[kind]} {minutes[kind]:.1f}" for kind in kinds if kind in minutes)
    lines += [*markdown.table(["", *tasks], table), "", f"CPU minutes for one training: {spent}."]
    write(out / "table.md", "\n".join(lines) + "\n")
    draw_systems(out, out / "scores.png")


def draw_systems(out: Path, path: Path) -> None:
    """Draw the scores from results.csv."""
    rows, partial = _on_systems(out)
    kinds: dict[str, str] = {kind: ON_SYSTEMS[kind] for kind in _kinds_on_systems(rows)}
    draw_scores(path, rows, kinds, f"What agents know and how well they act.{partial}")


def _on_systems(out: Path) -> tuple["pd.DataFrame", str]:
    """The rows of results.csv for :func:`cells`, and how many agents are missing, as a sentence."""
    import pandas as pd  # which takes half a second that help need not wait for

    results = pd.read_csv(out / "results.csv")
    results["noise"] = [_level_name(level) for level in results.noise]
    shipped = system_agents.noise_levels() if set(results.system) & set(TASKS) else {}
    levels = {name: tuple(map(as_name, own)) for name, own in shipped.items()}
    for name, group in results.groupby("system", sort=False):
        if name not in TASKS:
            levels[str(name)] = tuple(group.noise.unique())
    there = set(results[["system", "noise", "knows", "seed"]].itertuples(index=False, name=None))
    on_request = {agent[:3] for agent in there if agent[2] in system_agents.ON_REQUEST}
    plan = {*system_agents.combinations(levels)}
    plan |= {(*kind, seed) for kind in on_request for seed in range(system_agents.SEEDS)}
    missing = plan - there
    partial = f" Partial: {len(missing)} of {len(plan)} agents are missing." if missing else ""
    task = results.system.str.replace("_", " ") + ", noise " + results.noise
    return results.assign(task=task).rename(columns={"knows": "kind", "score": "value"}), partial


def _level_name(level: float | str) -> str:
    """A level of noise as :func:`as_name` writes it; a column has numbers, and texts of a level for each output."""
    try:
        return as_name(float(level))
    except ValueError:
        return str(level)


def _kinds_on_systems(rows: "pd.DataFrame") -> list[system_agents.Kind]:
    """All usual kinds of agents, and others if there are some."""
    return [kind for kind in system_agents.KINDS if kind not in system_agents.ON_REQUEST or kind in set(rows.kind)]


def tasks_in(results: "pd.DataFrame") -> list[tuple[str, float]]:
    """Environments and levels of noise, in their order, without those of the full state alone."""
    partly = results[~results.shown.isin(["state", RANDOM])]
    tasks = partly[["environment", "noise"]].drop_duplicates().itertuples(index=False, name=None)
    return [(str(env_id), float(noise)) for env_id, noise in tasks]


def write_environments(path: Path, results: "pd.DataFrame", partial: str = "", settings: str = "") -> None:
    """Write the table of a comparison in environments."""
    found = cells(_in_environments(results))
    kinds = [kind for kind in environment_agents.KINDS if kind in set(results.shown)]
    lines = [
        "# Agents in any environment",
        "",
        "Return: interquartile mean over agents. In brackets the normalised return, where 0 is random actions and 1 "
        "agents that see the full state without noise, with a bootstrap 95 % interval; then the number of agents. The "
        f"steps from which an observer was learned count.{partial}",
        *(["", settings] if settings else []),
        "",
    ]

    def text(cell: Cell | None) -> str:
        if cell is None:
            return "–"
        score, low, high = cell.interval
        ends = "" if np.isnan(low) else f", {low:.2f} to {high:.2f}"
        scale = "" if np.isnan(score) else f" ({score:.2f}{ends})"
        return f"{float(middle(cell.values)):.4g}{scale}, {len(cell.values)}"

    rows, spent = [], []
    for env_id, noise in tasks_in(results):
        name = _task_name(env_id, noise)
        own = [found.get((name, kind)) for kind in kinds]
        random = results[(results.environment == env_id) & (results.shown == RANDOM)]["return"]
        rows.append([name, *map(text, own), f"{random.iloc[0]:.4g}" if len(random) else "–"])
        spent.append([name, *("–" if cell is None else f"{cell.seconds:.0f}" for cell in own)])
    heads = ["", *(IN_ENVIRONMENTS[kind] for kind in kinds)]
    lines += markdown.table([*heads, "random"], rows)
    lines += ["", "CPU seconds for one training:", "", *markdown.table(heads, spent)]
    write(path, "\n".join(lines) + "\n")


def draw_environments(path: Path, results: "pd.DataFrame", partial: str = "") -> None:
    """Draw the normalised returns of all agents in environments."""
    kinds = {kind: label for kind, label in IN_ENVIRONMENTS.items() if kind in set(results.shown)}
    title = f"What agents are shown and how well they act.{partial}"
    draw_scores(path, _in_environments(results), kinds, title)


def _task_name(env_id: str, noise: float) -> str:
    return env_id + (f", noise {noise:g}" if noise else "")


def _in_environments(results: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of results.csv for :func:`cells`; those of the full state and random actions serve all noise levels."""
    import pandas as pd

    tasks = []
    for env_id, noise in tasks_in(results):
        here = results[results.environment == env_id]
        random = here[here.shown == RANDOM]["return"]
        rows = here[(here.noise == np.where(here.shown == "state", 0.0, noise)) & (here.shown != RANDOM)]
        idle = random.iloc[0] if len(random) else np.nan
        tasks.append(rows.assign(task=_task_name(env_id, noise), idle=idle, success=np.nan))
    return pd.concat(tasks).rename(columns={"shown": "kind", "return": "value"})


def draw_scores(path: Path, rows: "pd.DataFrame", kinds: Mapping[str, str], title: str) -> None:
    """Draw the normalised scores of all tasks, a panel each; ``kinds`` are labels, from the top."""
    found, tasks = cells(rows), list(dict.fromkeys(rows.task))
    columns = min(PANELS_IN_A_ROW, max(1, len(tasks)))
    lines = -(-len(tasks) // columns)
    with drawing(path, max(NARROWEST, 2.6 * columns + 1.5), 2.6 * lines + 0.6) as figure:
        axes = figure.subplots(max(1, lines), columns, sharey=True, squeeze=False).ravel()
        for ax, task in zip(axes, tasks):
            _draw_panel(ax, [found.get((task, kind)) for kind in kinds][::-1])
            ax.set(title=task, xlabel="normalised score")
            ax.set_yticks(range(len(kinds)), list(kinds.values())[::-1])
        for ax in axes[len(tasks) :]:
            ax.set_axis_off()
        figure.suptitle(title)


def _draw_panel(ax: "Axes", row: Sequence[Cell | None]) -> None:
    """Draw agents as dots and their means with intervals, from below."""
    for place, cell in enumerate(row):
        if cell is not None and np.isfinite(cell.interval[0]):
            score, low, high = cell.interval
            ax.plot(cell.scores, np.full(len(cell.scores), place), ".", color=MEASURED)
            ax.plot([low, high], [place, place], color=RIVAL, lw=2)
            ax.plot(score, place, "o", color=RIVAL, markersize=6)
    ax.axvline(1.0, color=MEASURED, lw=0.8)
    ax.locator_params(axis="x", nbins=4)


def curves(agents: Sequence[EnvironmentAgent]) -> "pd.DataFrame":
    """Learning curves: returns of training episodes, averaged over a twentieth of the training, over its steps."""
    import pandas as pd

    groups: dict[tuple[str, float, str], list[pd.DataFrame]] = {}
    for agent in agents:
        if agent.kind != RANDOM:
            curve = pd.read_csv(agent.folder / "curve.csv")
            if len(curve) > 1:
                groups.setdefault((agent.task.env_id, agent.task.measurement_noise, agent.kind), []).append(curve)
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
    return pd.DataFrame(rows, columns=environment_agents.COLUMNS["curves.csv"])


def draw_curves(path: Path, learned: "pd.DataFrame", partial: str = "") -> None:
    """Draw learning curves against steps and against CPU seconds."""
    tasks = tasks_in(learned)
    rows = max(1, math.ceil(len(tasks) / 2))
    with drawing(path, 12.0, 2.3 * rows + 0.8) as figure:
        axes = figure.subplots(rows, 4, squeeze=False)
        lines = dict[str, Any]()
        for pair, (env_id, noise) in zip(axes.reshape(-1, 2), tasks):
            for i, (kind, label) in enumerate(IN_ENVIRONMENTS.items()):
                level = 0.0 if kind == "state" else noise
                one = learned[(learned.environment == env_id) & (learned.noise == level) & (learned.shown == kind)]
                for ax, over in zip(pair, ("steps", "seconds")):
                    if len(one):
                        (lines[label],) = ax.plot(one[over], one["return"], color=f"C{i}")
            pair[0].set(ylabel="return", title=_task_name(env_id, noise), xlabel="steps of the environment")
            pair[0].xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}k")
            pair[1].set(xlabel="CPU seconds", xscale="log")
            pair[1].sharey(pair[0])
            pair[1].tick_params(labelleft=False)
        for ax in axes.reshape(-1)[2 * len(tasks) :]:
            ax.set_visible(False)
        figure.suptitle(f"Learning curves.{partial}")
        drawn = {label: lines[label] for label in IN_ENVIRONMENTS.values() if label in lines}
        figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=len(IN_ENVIRONMENTS))
