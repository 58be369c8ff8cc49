"""``kkl-gym agent``: train and evaluate agents."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import scipy
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym import SYSTEMS, System, get_system
from training.agents.agent import Agent
from training.agents.any_environment.player import KEY, Player
from training.agents.information import INFORMATION
from training.agents.play import Episodes, play
from training.agents.seeds import agent_evaluation_seed
from training.agents.tasks import get_task, scores, successes
from training.commands.agent_files import Export, Import, find
from training.commands.environment import EnvironmentOptions, is_environment, show_returns, train_in_environment
from training.commands.options import NoiseLevel
from training.evaluation.levels import as_name, show_level
from training.files import is_kind, require_writable
from training.jobs import locked
from training.progress import LOG, ProgressBars, progress_bars

Knows = Literal["state", "x_hat", "x_hat_std", "z", "y", "stacked", "ekf", "recurrent"]


@dataclass(frozen=True)
class Train:
    """Train an agent with stable-baselines3: to hold a system's target, or in any environment of which it sees a part.

    Writes agent.safetensors (the policy, with its task and observer) and progress.csv or curve.csv (the learning curve)
    into the run's folder. Hyperparameters are those of training/agents/hyperparameters, or of
    training/agents/any_environment/hyperparameters.
    """

    system: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="SYSTEM|ENV_ID",
            help="A shipped system, a class of yours as script.py:Class or module:Class, or an environment as gym.make "
            "takes it, such as Pendulum-v1.",
        ),
    ]
    information: Knows = "x_hat"
    """What the agent knows: docs/guides/agents.md explains each. In an environment: state, x_hat,
    z, stacked, recurrent or y (docs/results/partly_observed.md)."""
    seed: int = 0
    """Seed of networks, exploration and episodes."""
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each sample of y."""
    timesteps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: the hyperparameters')")] = None
    """Actions to learn from, in all environments together."""
    observer: Annotated[
        str | None,
        tyro.conf.arg(metavar="MAP", help_behavior_hint="(default: the one of the system's profile, else the newest)"),
    ] = None
    """A shipped map's name or a .safetensors file, for an agent that knows x_hat, x_hat_std or z."""
    algorithm: Annotated[
        Literal["ppo", "sac", "td3", "tqc", "dqn", "a2c", "ppo_lstm"] | None,
        tyro.conf.arg(help_behavior_hint="(default: sac for reverse_duffing and where it is tuned, else ppo)"),
    ] = None
    """What the agent is trained with; for systems ppo or sac, for an agent that remembers by itself ppo_lstm."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/agents/SYSTEM-INFORMATION-SEED)")] = (
        None
    )
    """The run's folder."""
    resume: bool = False
    """Go on from the checkpoint in the run's folder, if there is one. The agent is another than without a stop."""
    threads: int = 1
    """CPU threads of the networks."""
    observer_steps: Annotated[
        int | None, tyro.conf.arg(help_behavior_hint="(default: nine tenths of all, under noise one tenth)")
    ] = None
    """First steps of an agent in an environment, from the latest 100,000 of which its observer is learned, where none
    is named. Without noise the agent learns from them too: it is told the truth where estimates will be. Under noise
    actions are random."""
    environment: tyro.conf.OmitArgPrefixes[EnvironmentOptions] = field(default_factory=EnvironmentOptions)
    """Of an agent in an environment."""

    def run(self, console: Console) -> None:
        """Train, and play a hundred episodes."""
        import torch  # which takes seconds to import, as stable-baselines3 does

        from training.agents.learn import learn
        from training.checkpoints import SUFFIX

        elsewhere = is_environment(self.system)
        if not elsewhere:
            self.environment.refuse()
            task = get_task(self.system, self.measurement_noise)
        name = self.system.replace("/", "-") if elsewhere else get_system(task.system).name
        folder = self.out or Path("runs/agents") / f"{name}-{self.information}-{self.seed}"
        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        torch.set_num_threads(self.threads)
        with locked(folder), progress_bars(console, folder / LOG) as progress:
            if (folder / "agent.safetensors").exists() and not self.resume:
                raise FileExistsError(f"{folder} holds an agent already; choose another folder with --out")
            if (folder / f"agent{SUFFIX}").exists() and not self.resume:
                raise FileExistsError(
                    f"{folder} holds the checkpoint of a training: go on with it (--resume), remove it, or choose "
                    "another folder with --out"
                )
            progress.say(f"training an agent for {name} that knows {self.information}, in {folder}")
            if elsewhere:
                self._in_environment(folder, progress)
                return
            if self.information not in INFORMATION:
                raise ValueError(
                    f"an agent of a system knows {', '.join(INFORMATION)}; got {self.information!r}, which is for "
                    "environments, such as Pendulum-v1"
                )
            agent = learn(
                task,
                self.information,
                folder,
                seed=self.seed,
                timesteps=self.timesteps,
                observer=self.observer,
                algorithm=self.algorithm,
                resume=self.resume,
                progress=progress,
            )
            show(progress, agent, 100, trusted=agent.task.system)
            progress.say(f"wrote agent.safetensors, progress.csv and {LOG} in {folder}")

    def _in_environment(self, folder: Path, progress: ProgressBars) -> None:
        """Train in an environment of others."""
        noise = self.measurement_noise or 0.0
        if isinstance(noise, tuple):
            raise ValueError(f"the noise in an environment is one number for all that is measured, got {noise}")
        if self.resume:
            raise ValueError("the training of an agent in an environment begins anew: leave --resume out")
        train_in_environment(
            self.environment,
            self.system,
            self.information,
            folder=folder,
            measurement_noise=noise,
            progress=progress,
            algorithm=self.algorithm,
            timesteps=self.timesteps,
            seed=self.seed,
            observer=self.observer,
            observer_steps=self.observer_steps,
        )


@dataclass(frozen=True)
class Evaluate:
    """Play an agent on unseen episodes; draw closed-loop trajectories and an animated phase portrait.

    Score and success are means over the episodes, with bootstrap 95 % intervals.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="AGENT")]
    """An agent that ships, by its system's name, or an agent.safetensors file."""
    episodes: int = 500
    """Number of episodes."""
    seed: int = 0
    """Seed of the episodes; no seed gives any that training draws."""
    system: Annotated[str | None, tyro.conf.arg(metavar="CLASS", help_behavior_hint="")] = None
    """The agent's system or environment if it is one of your own: script.py:Class, module:Class or module:ID, as the
    agent's file names it."""
    out: Path = Path("runs/agents")
    """Folder for NAME.png and NAME.gif."""

    def run(self, console: Console) -> None:
        """Evaluate."""
        from training.agents.picture import animate, draw

        path = find(self.agent)
        if is_kind(path, KEY):
            with progress_bars(console) as progress:
                show_returns(progress, Player.read(path), self.episodes, self.seed, trusted=self.system)
            return
        agent = Agent.read(path)
        task = agent.task
        if task.system not in SYSTEMS and task.system != self.system:  # no file makes us import what it names
            raise ValueError(f"the agent's system is {task.system!r}: if you trust that, give --system {task.system}")
        require_writable(self.out)
        with progress_bars(console) as progress:
            episodes = show(progress, agent, self.episodes, self.seed, trusted=self.system)
            system = get_system(task.system).name
            name = f"{system}-{agent.information}-{as_name(task.measurement_noise)}-{agent.seed}"
            with progress.phase("drawing", 2) as report:
                draw(task, episodes, self.out / f"{name}.png")
                report(1)
                animate(task, {system.replace("_", " "): episodes}, self.out / f"{name}.gif")
            progress.say(f"wrote {name}.png and {name}.gif in {self.out}")


@dataclass(frozen=True)
class AgentCommand:
    """Train, evaluate and convert agents that act on what an observer shows."""

    command: Annotated[
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Import, tyro.conf.subcommand("import")],
        tyro.conf.arg(name=""),
    ]

    def run(self, console: Console) -> None:
        """Run the chosen one."""
        self.command.run(console)


def show(
    progress: ProgressBars, agent: Agent, n: int, seed: int = 0, *, trusted: str | System | None = None
) -> Episodes:
    """Play episodes; print score and success."""
    first = agent_evaluation_seed(seed, n)
    task = agent.task
    system = get_system(task.system)
    env = agent.make(n, system=trusted)
    with progress.phase(f"playing {n} episodes", task.steps) as report:
        episodes = play(env, agent, steps=task.steps, seed=first, report=report)
    score, success = scores(system, episodes.x), successes(task, episodes.x)
    table = Table(show_header=False)
    for label, value in (
        ("system", system.name),
        ("information", agent.information),
        ("measurement noise", show_level(task.measurement_noise)),
        ("episodes", str(n)),
        ("score", "{:.3f} [{:.3f}, {:.3f}]".format(*interval(score))),
        (f"holds the target within {task.tolerance:g}", "{:.0f} % [{:.0f}, {:.0f}]".format(*interval(100.0 * success))),
        ("escaped", f"{100 * episodes.escaped.mean():.0f} %"),
    ):
        table.add_row(label, value)
    progress.console.print(table)
    return episodes


def interval(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    """Mean of what episodes gave, with a bootstrap 95 % interval over the episodes. Shapes: ``values`` (n,)."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, np.nan, np.nan
    ends = scipy.stats.bootstrap((values,), np.mean, method="percentile", rng=0).confidence_interval
    return mean, float(ends.low), float(ends.high)
