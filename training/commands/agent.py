"""``kkl-gym agent``: train and evaluate agents."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from kkl_gym import SYSTEMS, get_system
from training.agents.agent import Agent, AgentError
from training.agents.information import Information
from training.agents.play import Episodes, play
from training.agents.tasks import get_task, scores, successes
from training.commands.compare import Compare
from training.seeds import AGENT_EVALUATION_SEED


@dataclass(frozen=True)
class Train:
    """Train an agent with stable-baselines3 to hold a system's target.

    Writes agent.safetensors (the policy, with its task and observer) and progress.csv (the learning curve) into the
    run's folder. Hyperparameters are those of training/agents/hyperparameters.
    """

    system: tyro.conf.Positional[str]
    """A system with a control task: reverse_duffing, van_der_pol, rossler or lorenz."""
    information: Information = "x_hat"
    """What the agent knows."""
    seed: int = 0
    """Of networks, exploration and episodes."""
    measurement_noise: float | None = None
    """Standard deviation on every sample of y; default: the task's, 0.5."""
    timesteps: int | None = None
    """Actions to learn from, in all environments together; default: the hyperparameters'."""
    observer: str | None = None
    """A shipped map's name or a .safetensors file; default: the map that ships for the system, the one fitted in closed
    loop if there is one."""
    algorithm: Literal["ppo", "sac"] | None = None
    """Default: the one that there are hyperparameters for."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: agents/SYSTEM-INFORMATION-SEED)")] = None
    """The run's folder."""
    threads: int = 1
    """CPU threads of the networks."""

    def run(self, console: Console) -> None:
        """Train."""
        from training.agents.learn import learn  # stable-baselines3 takes seconds to import

        task = get_task(self.system, self.measurement_noise)
        folder = self.out or Path("agents") / f"{self.system}-{self.information}-{self.seed}"
        if (folder / "agent.safetensors").exists():
            raise FileExistsError(f"{folder} holds an agent already; choose another folder with --out")
        torch.set_num_threads(self.threads)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console) as progress:
            agent = learn(
                task,
                self.information,
                folder,
                seed=self.seed,
                timesteps=self.timesteps,
                observer=self.observer,
                algorithm=self.algorithm,
                progress=progress,
            )
        show(console, agent, 100)
        console.print(f"wrote agent.safetensors and progress.csv in {folder}")


@dataclass(frozen=True)
class Evaluate:
    """Play an agent on unseen episodes; draw closed-loop trajectories and an animated phase portrait."""

    agent: tyro.conf.Positional[str]
    """A system whose agent ships with the package, or an agent.safetensors file."""
    episodes: int = 100
    """Episodes that score and success are taken over."""
    system: str | None = None
    """Class of the agent's system if that is none of the package's: script.py:Class, as its file names it."""
    out: Path = Path("agents")
    """Folder for NAME.png and NAME.gif."""

    def run(self, console: Console) -> None:
        """Evaluate."""
        from training.agents.picture import animate, draw

        if self.episodes < 1:
            raise ValueError(f"episodes must be positive, got {self.episodes}")
        agent = Agent.read(find(self.agent))
        task = agent.task
        if task.system not in SYSTEMS and task.system != self.system:  # no file makes us import what it names
            raise ValueError(f"the agent's system is {task.system!r}: if you trust that, give --system {task.system}")
        episodes = show(console, agent, self.episodes)
        system = get_system(task.system).name
        name = f"{system}-{agent.information}-{task.measurement_noise:g}-{agent.training.get('seed', 0)}"
        self.out.mkdir(parents=True, exist_ok=True)
        draw(task, episodes, self.out / f"{name}.png")
        animate(task, episodes, self.out / f"{name}.gif")
        console.print(f"wrote {name}.png and {name}.gif in {self.out}")


@dataclass(frozen=True)
class AgentCommand:
    """Agents that act on what an observer shows."""

    command: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Compare, tyro.conf.subcommand("compare")]
    ]

    def run(self, console: Console) -> None:
        """Run the chosen one."""
        self.command.run(console)


def show(console: Console, agent: Agent, n: int) -> Episodes:
    """Play n episodes, print score and success; returns the episodes."""
    task = agent.task
    system = get_system(task.system)
    episodes = play(agent.make(n), agent, task.steps, AGENT_EVALUATION_SEED)
    score, success = scores(system, episodes.x), successes(task, episodes.x)
    table = Table("system", "knows", "noise", "score", f"holds the target within {task.tolerance:g}", "escaped")
    table.add_row(
        task.system,
        agent.information,
        f"{task.measurement_noise:g}",
        f"{score.mean():.3f}",
        f"{100 * success.mean():.0f} %",
        f"{100 * episodes.escaped.mean():.0f} %",
    )
    console.print(table)
    return episodes


def find(name: str) -> Path:
    """The file of a shipped agent, or the path itself; raises AgentError if there is none."""
    if name.endswith(".safetensors"):
        return Path(name)
    shipped = {path.name.removesuffix(".safetensors"): Path(str(path)) for path in _shipped()}
    if name not in shipped:
        raise AgentError(
            f"no agent {name!r} ships; there are {', '.join(shipped) or 'none'}; a file ends in .safetensors"
        )
    return shipped[name]


def _shipped() -> list[Any]:
    folder = files("training.agents").joinpath("shipped")
    if not folder.is_dir():  # no agent ships yet
        return []
    return sorted((path for path in folder.iterdir() if path.name.endswith(".safetensors")), key=lambda path: path.name)
