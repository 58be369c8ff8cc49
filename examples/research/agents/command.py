"""``python -m examples.research agents``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from examples.research.agents import comparison
from examples.research.agents.comparison import Kind
from examples.research.agents.tables import curves, draw_curves, draw_scores, write_table
from examples.research.resumable import Workers, run_and_report
from kkl_gym import get_system
from observers import Artifact
from observers.names import resolve
from training.agents.agent import fingerprint
from training.agents.information import OBSERVED, observer_of
from training.agents.tasks import TASKS, Task
from training.commands.agent import TaskOptions
from training.commands.options import NoiseLevels
from training.evaluation.levels import Level
from training.files import write
from training.progress import ProgressBars


@dataclass(frozen=True)
class Compare:
    """Train agents that see different information, with several seeds, and compare them on the same unseen episodes.

    Writes OUT/results.csv (a row for each agent), OUT/table.md, OUT/scores.png, and the learning curves as
    OUT/curves.csv and OUT/curves.png. Each agent is a job with its own folder. An interrupted run reports on the agents
    that are done; the same command continues it.
    """

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[SYSTEM ... | ENV_ID ...]", help_behavior_hint="")
    ] = tuple(TASKS)
    """Systems with inputs (shipped, or your own as script.py:Class or module:Class; by default all that ship), or any
    Gymnasium environments, which agents then observe partly (docs/results/partly_observed.md)."""
    information: Annotated[
        tuple[Kind, ...] | None, tyro.conf.arg(help_behavior_hint="(default: those of the published tables)")
    ] = None
    """Information that agents see (docs/guides/agents.md); ekf and x_hat_std exist only for systems."""
    seeds: int = comparison.SEEDS
    """Number of agents of each kind. On systems there are at most 3 agents of each recurrent kind, whose trainings take
    longest, and only 1 at the second default noise level."""
    episodes: int = 100
    """Number of evaluation episodes of each agent."""
    timesteps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: from the hyperparameters)")] = None
    """Number of actions in a training, summed over its parallel environments."""
    measurement_noise: Annotated[
        NoiseLevels, tyro.conf.arg(help_behavior_hint="(default: the task's own; also 0.2 on Van der Pol, 2 on Lorenz)")
    ] = None
    """Standard deviations of the measurement noise; each level is a separate task."""
    observers: tuple[str, ...] = ()
    """Observers for agents on systems: a .safetensors file for each of your own systems, or shipped maps."""
    aggregate: int = 0
    """For x_hat in environments: number of the observer's refits to the agent's steps (kkl-gym agent train --help)."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = field(default_factory=Workers)
    out: Annotated[
        Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/agents/comparison, or runs/agents/environments)")
    ] = None
    """Folder of results."""
    options: tyro.conf.OmitArgPrefixes[TaskOptions] = field(default_factory=TaskOptions)

    def run(self, console: Console) -> None:
        """Train the missing agents, then report."""
        if min(self.seeds, self.episodes) < 1:
            raise ValueError(f"seeds and episodes must be positive, got {self.seeds} and {self.episodes}")
        for what, given in (("names", self.names), ("information", self.information or ("state",))):
            if len(set(given)) < len(given) or not given:
                raise ValueError(f"give at least one of the {what}, each once; got {', '.join(given) or 'none'}")
        tasks = [task for name in self.names for task in self._tasks(name)]
        systems = {task.system is not None for task in tasks}
        if len(systems) > 1:
            raise ValueError("compare agents either on systems or in environments, in separate folders")
        (on_systems,) = systems
        if not on_systems and {"ekf", "x_hat_std"} & set(self.information or ()):
            raise ValueError("agents in environments cannot act on ekf or x_hat_std; leave out both")
        out = self.out or Path("runs/agents") / ("comparison" if on_systems else "environments")
        kinds = self.information
        how: dict[str, Any] = {
            "episodes": self.episodes,
            "timesteps": self.timesteps,
            "aggregate": self.aggregate,
            "observers": self._observers(tasks),
        }
        agents = comparison.planned(tasks, out, kinds=kinds, seeds=self.seeds, **how)

        def report(progress: ProgressBars) -> None:
            """Report on all agents of these tasks in the folder, including agents of earlier runs."""
            everyone = comparison.planned(tasks, out, kinds=comparison.KINDS, seeds=comparison.seeds_in(out), **how)
            there = [agent for agent in everyone if (agent.folder / agent.result).exists() and agent.done]
            results = comparison.collect(there)
            if not set(results.shown) - {"state", comparison.IDLE}:
                return
            missing = sum(not agent.done for agent in agents)
            partial = f" Partial: {missing} of {len(agents)} agents are missing." if missing else ""
            learned = curves(there)
            write(out / "results.csv", results.dropna(axis=1, how="all").to_csv(index=False))
            write(out / "curves.csv", learned.to_csv(index=False))
            write_table(out / "table.md", results, partial, comparison.unusual_settings(tasks))
            draw_scores(out / "scores.png", results, partial)
            draw_curves(out / "curves.png", learned, partial, systems=on_systems)
            progress.say(f"wrote results.csv, curves.csv, table.md, scores.png and curves.png in {out}")

        run_and_report(agents, out, console, workers=self.workers, what="agents", report=report)

    def _tasks(self, name: str) -> list[Task]:
        """Return the task at each noise level."""
        own = self.options.task(name)
        levels: list[Level] = list(self.measurement_noise or (own.measurement_noise,))
        if self.measurement_noise is None and own.name in comparison.SECOND_NOISE:
            levels.append(comparison.SECOND_NOISE[own.name])
        return [self.options.task(name, level) for level in levels]

    def _observers(self, tasks: list[Task]) -> dict[str, str]:
        """Return the observers by the name of their system; raise ValueError if one is missing or unfit."""
        observers: dict[str, str] = {}
        systems = {task.name: task.system for task in tasks if task.system is not None}
        for observer in self.observers:
            artifact = Artifact.read(resolve(observer))
            system = artifact.system
            if not artifact.nu:
                raise ValueError(f"the observer {observer} has no inputs, but agents act by inputs")
            if system not in systems or system in observers:
                raise ValueError(
                    f"the observer {observer} is for {system}: name at most one for each of {', '.join(systems)}"
                )
            observers[system] = observer
        kinds = set(comparison.ON_SYSTEMS if self.information is None else self.information)
        for name, system in systems.items() if kinds & set(OBSERVED) else ():
            observer = observers.get(name) or observer_of(get_system(system))
            fingerprint(observer)
            if "x_hat_std" in kinds:
                Artifact.read(resolve(observer)).require_covariance()
        return observers
