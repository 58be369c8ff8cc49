"""``python -m examples.research agents``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console

from examples.research.agents.comparison import (
    ALL,
    ASKED_FOR,
    COMPARED,
    SEEDS,
    Compared,
    collect,
    kinds,
    noise_levels,
    planned,
    run_case,
)
from examples.research.agents.statistics import draw_scores, interval, middle, normalised
from examples.research.environments.command import compare_environments
from examples.research.environments.comparison import KINDS
from kkl_gym import get_system
from observers import Artifact
from observers.names import resolve
from observers.storage import write
from training import markdown
from training.agents.information import OBSERVED, observer_of
from training.agents.tasks import TASKS
from training.commands.environment import EnvironmentOptions
from training.commands.running import Workers, run_missing
from training.evaluation.levels import as_name
from training.progress import LOG, progress_bars

if TYPE_CHECKING:
    import pandas as pd

# On systems or in environments; a union of the two would be listed with repetitions.
Knows = Literal[
    "state", "ekf", "x_hat", "x_hat_std", "stacked_x_hat", "z", "stacked", "y", "recurrent", "recurrent-state"
]

LABELS = {
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


@dataclass(frozen=True)
class Compare:
    """Train agents that know different things, several seeds each, and compare them on the same unseen episodes.

    Writes OUT/results.csv (a row for each agent), OUT/table.md and OUT/scores.png. Each agent is a job with a folder of
    its own; what is there is not done again, so that a run may be stopped at any time. Missing agents are said to be.
    In environments there are also curves.csv and curves.png, the learning curves.
    """

    environments: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[ENV_ID ...]", help_behavior_hint="")
    ] = ()
    """Any environments of Gymnasium, of which agents see a part, in place of systems.

    See docs/results/partly_observed.md."""
    systems: tuple[str, ...] = tuple(TASKS)
    """Shipped ones, or classes of yours with inputs as script.py:Class or module:Class."""
    information: Annotated[
        tuple[Knows, ...] | None,
        tyro.conf.arg(aliases=["--knows"], help_behavior_hint="(default: all but x_hat_std)"),
    ] = None
    """What agents know (docs/guides/agents.md). In environments (docs/results/partly_observed.md): state,
    x_hat, stacked_x_hat, z, stacked, recurrent, y."""
    seeds: int = 5
    """Agents of each kind. Of our systems at most 3 of the recurrent ones, which take longest, and 1 at the further
    noise levels."""
    episodes: int = 100
    """Number of episodes that each agent is played on."""
    timesteps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: the hyperparameters')")] = None
    """Actions to learn from, in all environments together."""
    more_noise: bool = True
    """Compare also at noise 0.2 on Van der Pol and at noise 2 on Lorenz."""
    observers: tuple[str, ...] = ()
    """Observers for agents that know of one: a .safetensors file for each system of yours, or shipped maps."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = field(default_factory=Workers)
    out: Annotated[
        Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/agents/comparison, or runs/agents/environments)")
    ] = None
    """Folder of results."""
    beside: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: nothing)")] = None
    """Folder with results.csv and curves.csv of an earlier comparison in environments. What it has of other
    environments, and of what this one's agents are not shown, is taken over without training it again. Give it each
    time: tables are written anew. That both were made with the same settings is for you to see to."""
    noise: Annotated[tuple[float, ...], tyro.conf.arg(metavar="LEVEL [LEVEL ...]", aliases=["--measurement-noise"])] = (
        0.0,
    )
    """Standard deviations of the noise on what is measured in environments; each level is a task of its own."""
    environment: tyro.conf.OmitArgPrefixes[EnvironmentOptions] = field(default_factory=EnvironmentOptions)
    """Of agents in environments."""

    def run(self, console: Console) -> None:
        """Run what is missing, then report."""
        if min(self.seeds, self.episodes) < 1:
            raise ValueError(f"seeds and episodes must be positive, got {self.seeds} and {self.episodes}")
        known: tuple[Any, ...] = KINDS if self.environments else ALL
        usual: tuple[Any, ...] = KINDS if self.environments else COMPARED
        information: tuple[Any, ...] = usual if self.information is None else self.information
        for what, given in (
            ("systems", self.systems),
            ("environments", self.environments),
            ("information", information),
        ):
            if len(set(given)) < len(given) or not (given or what == "environments"):
                raise ValueError(f"give some {what}, each once; got {', '.join(given) or 'none'}")
        for what in information:
            if what not in known:
                raise ValueError(f"agents are compared by {', '.join(known)} here, got {what!r}")
        if self.beside is not None and not self.environments:
            raise ValueError("--beside is for environments; agents on systems are collected from the folder of results")
        if self.environments:
            self._in_environments(information, console)
        else:
            self.environment.refuse()
            self._on_systems(information, self.out or Path("runs/agents/comparison"), console)

    def _in_environments(self, information: tuple[Any, ...], console: Console) -> None:
        """Compare agents in environments of others."""
        compare_environments(
            [self.environment.task(env_id, level) for level in self.noise for env_id in self.environments],
            self.out or Path("runs/agents/environments"),
            console,
            kinds=information,
            seeds=self.seeds,
            episodes=self.episodes,
            timesteps=self.timesteps,
            aggregate=self.environment.aggregate,
            workers=self.workers,
            beside=self.beside,
        )

    def _on_systems(self, information: tuple[Compared, ...], out: Path, console: Console) -> None:
        """Compare agents on systems."""
        observers = self._observers(information)
        cases = planned(
            out,
            systems=self.systems,
            information=information,
            seeds=self.seeds,
            episodes=self.episodes,
            timesteps=self.timesteps,
            more_noise=self.more_noise,
            observers=observers,
        )
        failures = list[str]()
        try:
            with progress_bars(console, out / LOG) as progress:
                failures = run_missing(run_case, cases, workers=self.workers, what="agents", progress=progress)
        finally:  # also after an interruption
            with progress_bars(console, out / LOG) as progress, progress.phase("collecting results"):
                own = [system for system in self.systems if system not in TASKS]
                results = collect(out, episodes=self.episodes, timesteps=self.timesteps, own=own, observers=observers)
                if len(results):
                    write(out / "results.csv", results.to_csv(index=False))
                    report(out)
                    progress.say(f"wrote results.csv, table.md and scores.png in {out}")
        if failures:
            raise ValueError(f"{len(failures)} of {len(cases)} agents failed; the first: {failures[0]}")

    def _observers(self, information: tuple[Compared, ...]) -> dict[str, str]:
        """Observers by the name of the system that they were made for."""
        found: dict[str, str] = {}
        systems = {get_system(name).name for name in self.systems}
        for name in self.observers:
            system = Artifact.read(resolve(name)).system
            if system not in systems or system in found:
                raise ValueError(
                    f"the observer {name} is for {system}: name one for each of {', '.join(systems)} at most"
                )
            found[system] = name
        if {*OBSERVED} & set(information):
            for name in self.systems:  # an error now, not when their turn comes
                own = get_system(name)
                observer = found.get(own.name) or observer_of(own)
                if "x_hat_std" in information:
                    Artifact.read(resolve(observer)).require_spread()
        return found


def report(out: Path) -> None:
    """Write table.md and scores.png from results.csv alone."""
    results, partial = _read(out)
    tasks = _tasks(results)
    lines = [
        "# Agents",
        "",
        "Normalised score: 0 is zero input, 1 the interquartile mean of the agents that know the full state. "
        "Interquartile mean over agents [bootstrap 95 % interval], success rate in %, number of agents. Observers see "
        f"every sample of y; agents on y see it once for each action.{partial}",
        "",
    ]
    cells = _cells(results, tasks)
    rows = []
    for knows in _shown(results):
        row = [LABELS[knows]]
        for task in tasks:
            cell = cells.get((*task, knows))
            if cell is None:
                row.append("–")
                continue
            found, low, high = cell["interval"]
            spread = "" if np.isnan(low) else f" [{low:.2f}, {high:.2f}]"
            row.append(f"{found:.2f}{spread}, {100 * cell['success']:.0f} %, {len(cell['agents'])}")
        rows.append(row)
    lines += markdown.table(["", *(f"{system.replace('_', ' ')}, noise {noise}" for system, noise in tasks)], rows)
    minutes = results.groupby("knows").seconds.mean() / 60
    spent = ", ".join(f"{LABELS[knows]} {minutes[knows]:.1f}" for knows in ALL if knows in minutes)
    lines += ["", f"CPU minutes for one training: {spent}."]
    write(out / "table.md", "\n".join(lines) + "\n")
    draw_results(out, out / "scores.png")


def draw_results(out: Path, path: Path) -> None:
    """Draw the scores alone from results.csv."""
    results, partial = _read(out)
    tasks, shown = _tasks(results), _shown(results)[::-1]
    cells = _cells(results, tasks)
    panels = {
        f"{system.replace('_', ' ')}, noise {noise}": [cells.get((system, noise, knows)) for knows in shown]
        for system, noise in tasks
    }
    title = f"What agents know and how well they act.{partial}"
    draw_scores(path, panels, [LABELS[knows] for knows in shown], title)


def _read(out: Path) -> tuple["pd.DataFrame", str]:
    """The rows of results.csv, and how many agents are missing, as a sentence."""
    import pandas as pd  # which takes half a second that help need not wait for

    results = pd.read_csv(out / "results.csv")
    results["noise"] = [_plain(level) for level in results.noise]
    shipped = noise_levels() if set(results.system) & set(TASKS) else {}
    levels = {name: tuple(map(as_name, at)) for name, at in shipped.items()}
    for name, group in results.groupby("system", sort=False):
        if name not in TASKS:
            levels[str(name)] = tuple(group.noise.unique())
    there = set(results[["system", "noise", "knows", "seed"]].itertuples(index=False, name=None))
    # What was asked for is planned where there is some of it.
    further = {(system, noise, knows) for system, noise, knows, _ in there if knows in ASKED_FOR}
    plan = {*kinds(levels), *((*kind, seed) for kind in further for seed in range(SEEDS))}
    missing = plan - there
    return results, f" Partial: {len(missing)} of {len(plan)} agents are missing." if missing else ""


def _shown(results: "pd.DataFrame") -> list[Compared]:
    """What agents know, row by row: all that is usual, and what else was asked for."""
    return [knows for knows in ALL if knows not in ASKED_FOR or knows in set(results.knows)]


def _tasks(results: "pd.DataFrame") -> list[tuple[str, str]]:
    """Systems and noises of results, in their order."""
    return list(results[["system", "noise"]].drop_duplicates().itertuples(index=False, name=None))


def _plain(level: float | str) -> str:
    """A level of noise as :func:`as_name` gives it, from a column in which some are numbers."""
    try:
        return as_name(float(level))
    except ValueError:  # one for each output
        return str(level)


def _cells(results: "pd.DataFrame", tasks: list[tuple[str, str]]) -> dict[tuple[str, str, str], dict[str, Any]]:
    """What table and figure show for each task and kind of agent."""
    cells = {}
    for system, noise in tasks:
        here = results[(results.system == system) & (results.noise == noise)]
        best = here[here.knows == "state"].score.to_numpy()
        if not len(best):  # nothing to measure the others by
            continue
        idle_score = float(here.idle.iloc[0])
        for knows, group in here.groupby("knows"):
            values = best if knows == "state" else group.score.to_numpy()
            found = interval(values, best, idle_score)
            if np.isfinite(found[0]):
                cells[system, noise, str(knows)] = {
                    "interval": found,
                    "agents": normalised(values, float(middle(best)), idle_score),
                    "success": group.success.mean(),
                }
    return cells
