"""``python -m examples.research agents``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from examples.research.agents import environment_agents, system_agents
from examples.research.agents.tables import (
    curves,
    draw_curves,
    draw_environments,
    report_systems,
    write_environments,
)
from examples.research.resumable import Workers, run_and_report
from kkl_gym import get_system
from observers import Artifact
from observers.names import resolve
from training.agents.information import OBSERVED, observer_of
from training.agents.tasks import TASKS
from training.commands.environment import EnvironmentOptions
from training.files import write
from training.progress import ProgressBars

# On systems or in environments; tyro would list those in both twice in a union of the two.
Kind = Literal[
    "state", "ekf", "x_hat", "x_hat_std", "stacked_x_hat", "z", "stacked", "y", "recurrent", "recurrent-state"
]


@dataclass(frozen=True)
class Compare:
    """Train agents that know different things, several seeds each, and compare them on the same unseen episodes.

    Writes OUT/results.csv (a row for each agent), OUT/table.md and OUT/scores.png; in environments also curves.csv and
    curves.png, the learning curves. Each agent is a job with a folder of its own. An interrupted run goes on where it
    stopped, and reports what is there and how much is missing.
    """

    environments: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[ENV_ID ...]", help_behavior_hint="")
    ] = ()
    """Any environments of Gymnasium, of which agents see a part, in place of systems.

    See docs/results/partly_observed.md."""
    systems: tuple[str, ...] = tuple(TASKS)
    """Shipped ones, or classes of yours with inputs as script.py:Class or module:Class."""
    information: Annotated[
        tuple[Kind, ...] | None, tyro.conf.arg(help_behavior_hint="(default: all but x_hat_std)")
    ] = None
    """What agents know (docs/guides/agents.md). In environments (docs/results/partly_observed.md): state,
    x_hat, stacked_x_hat, z, stacked, recurrent, y."""
    seeds: int = system_agents.SEEDS
    """Agents of each kind. On systems at most 3 of the recurrent ones, which take longest, and 1 at the further
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
    """Folder with results.csv and curves.csv of an earlier comparison in environments. Its rows of other environments
    and of other agents are taken over, so that new ones stand beside them without training those again. Give it each
    time: tables are written again. Both must have been made with the same settings, which is not checked."""
    measurement_noise: Annotated[tuple[float, ...], tyro.conf.arg(metavar="LEVEL [LEVEL ...]")] = (0.0,)
    """Standard deviations of the noise on the measured signals of environments; each level is a task of its own."""
    environment: tyro.conf.OmitArgPrefixes[EnvironmentOptions] = field(default_factory=EnvironmentOptions)
    """Of agents in environments."""

    def run(self, console: Console) -> None:
        """Train the missing agents, then report."""
        if min(self.seeds, self.episodes) < 1:
            raise ValueError(f"seeds and episodes must be positive, got {self.seeds} and {self.episodes}")
        kinds: tuple[str, ...] = environment_agents.KINDS if self.environments else system_agents.KINDS
        usual: tuple[str, ...] = environment_agents.KINDS if self.environments else system_agents.USUAL_KINDS
        information: tuple[Any, ...] = usual if self.information is None else self.information
        for what, given in (
            ("systems", self.systems),
            ("environments", self.environments),
            ("information", information),
        ):
            if len(set(given)) < len(given) or not (given or what == "environments"):
                raise ValueError(f"give some {what}, each once; got {', '.join(given) or 'none'}")
        if unknown := [kind for kind in information if kind not in kinds]:
            raise ValueError(f"agents are compared by {', '.join(kinds)} here, got {', '.join(unknown)}")
        if self.environments:
            self._in_environments(information, self.out or Path("runs/agents/environments"), console)
            return
        self.environment.refuse()
        if self.beside is not None:
            raise ValueError("--beside is for environments; agents on systems are collected from the folder of results")
        self._on_systems(information, self.out or Path("runs/agents/comparison"), console)

    def _on_systems(self, information: tuple[system_agents.Kind, ...], out: Path, console: Console) -> None:
        how: dict[str, Any] = {
            "episodes": self.episodes,
            "timesteps": self.timesteps,
            "observers": self._observers(information),
        }
        agents = system_agents.planned(
            out,
            systems=self.systems,
            information=information,
            seeds=self.seeds,
            more_noise=self.more_noise,
            **how,
        )

        def report(progress: ProgressBars) -> None:
            """Report all agents in the folder, whichever run trained them."""
            known, seeds = dict.fromkeys((*TASKS, *self.systems)), seeds_in(out)
            every = system_agents.planned(out, systems=list(known), information=system_agents.KINDS, seeds=seeds, **how)
            results = system_agents.collect(every)
            if len(results):
                write(out / "results.csv", results.to_csv(index=False))
                report_systems(out)
                progress.say(f"wrote results.csv, table.md and scores.png in {out}")

        run_and_report(agents, out, console, workers=self.workers, what="agents", report=report)

    def _observers(self, information: tuple[system_agents.Kind, ...]) -> dict[str, str]:
        """Observers by the name of their system; raises ValueError if one that is needed is missing."""
        observers: dict[str, str] = {}
        names = {get_system(name).name for name in self.systems}
        for observer in self.observers:
            artifact = Artifact.read(resolve(observer))
            system = artifact.system
            if not artifact.nu:
                raise ValueError(f"the observer {observer} takes in no inputs, by which agents act")
            if system not in names or system in observers:
                raise ValueError(
                    f"the observer {observer} is for {system}: name one for each of {', '.join(names)} at most"
                )
            observers[system] = observer
        if {*OBSERVED} & set(information):
            for name in self.systems:
                own = get_system(name)
                observer = observers.get(own.name) or observer_of(own)
                if "x_hat_std" in information:
                    Artifact.read(resolve(observer)).require_covariance()
        return observers

    def _in_environments(self, kinds: tuple[environment_agents.Kind, ...], out: Path, console: Console) -> None:
        tasks = [self.environment.task(name, level) for level in self.measurement_noise for name in self.environments]
        earlier = {name: environment_agents.read_earlier(self.beside, name) for name in environment_agents.COLUMNS}
        how: dict[str, Any] = {
            "episodes": self.episodes,
            "timesteps": self.timesteps,
            "aggregate": self.environment.aggregate,
        }
        agents = environment_agents.planned(tasks, out, kinds=kinds, seeds=self.seeds, **how)
        for task in tasks:  # raises the errors of a task before any training
            task.make().close()

        def report(progress: ProgressBars) -> None:
            """Report all agents in the folder, whichever run trained them."""
            there = [
                agent for agent in environment_agents.planned(tasks, out, seeds=seeds_in(out), **how) if agent.done
            ]
            own = environment_agents.collect(there)
            results = environment_agents.beside(earlier["results.csv"], own, own)
            if not set(results.shown) - {"state", environment_agents.RANDOM}:
                return
            missing = sum(not agent.done for agent in agents)
            partial = f" Partial: {missing} of {len(agents)} agents are missing." if missing else ""
            learned = environment_agents.beside(earlier["curves.csv"], curves(there), own)
            if self.beside is not None:
                progress.say(f"beside these {len(own)} agents, {len(results) - len(own)} from {self.beside}")
            write(out / "results.csv", results.to_csv(index=False))
            write(out / "curves.csv", learned.to_csv(index=False))
            write_environments(out / "table.md", results, partial, environment_agents.unusual_settings(tasks))
            draw_environments(out / "scores.png", results, partial)
            draw_curves(out / "curves.png", learned, partial)
            progress.say(f"wrote results.csv, curves.csv, table.md, scores.png and curves.png in {out}")

        run_and_report(agents, out, console, workers=self.workers, what="agents", report=report)


def seeds_in(out: Path) -> int:
    """One more than the largest seed of the agents' folders, OUT/jobs/TASK/KIND/SEED."""
    return 1 + max((int(path.name) for path in out.glob("jobs/*/*/*") if path.name.isdigit()), default=-1)
