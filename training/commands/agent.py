"""``kkl-gym agent``: train, evaluate and convert agents."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym import get_system
from observers.storage import replacing
from training.agents.agent import Agent, find
from training.agents.information import Information
from training.agents.play import Episodes, play
from training.agents.seeds import agent_evaluation_seed
from training.agents.tasks import TOLERANCE, Task, get_task, scores, successes
from training.commands.options import (
    EnvironmentArguments,
    NoiseLevel,
    RunOptions,
    hint,
    merged,
    names_in,
    set_threads,
    words,
)
from training.evaluation.levels import show_level
from training.files import locked
from training.progress import LOG, ProgressBars, progress_bars

TRANSIENT = 20  # number of steps at the start of an episode, in which errors do not count
Name = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="SYSTEM|ENV_ID",
        help="A shipped system, your own class as script.py:Class or module:Class, or an environment as gym.make "
        "takes it, such as Pendulum-v1.",
    ),
]
AgentFile = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(metavar="AGENT", help="A shipped agent, by its system's name, or an agent.safetensors file."),
]
Trust = Annotated[
    str | None,
    hint(
        metavar="NAME",
        help="Your own system or environment that the agent's file names, as script.py:Class, module:Class or "
        "module:ID, if you trust its code.",
    ),
]


def numbers(kind: type, form: str, count: int | None = None) -> Callable[[str], tuple[Any, ...]]:
    """Return a function that reads comma-separated numbers; ``form`` describes them in its error."""

    def read(text: str) -> tuple[Any, ...]:
        try:
            values = tuple(map(kind, names_in(text)))
        except ValueError:
            values = None
        if values is None or (count and len(values) != count):
            raise ValueError(f"expected {form}; got {text!r}")
        return values

    return read


_INDICES = words(numbers(int, "indices in the flattened observation, as in 0,1"), "INDICES", 1)
_PAIR = words(numbers(int, "the entries of a cosine and a sine, as in 0,1", 2), "PAIR", 1)
_STEPS = words(numbers(float, "numbers of steps, as in 1,2"), "STEPS", 1)
Measured = Annotated[tuple[int, ...], _INDICES, hint("the positions, in Pendulum-v1 and eight others")]


@dataclass(frozen=True)
class TaskOptions:
    """Options of a task; annotate fields of this type with ``tyro.conf.OmitArgPrefixes``."""

    measured: Measured = ()
    """Entries of the flattened observation that agents may see, as in 0,1. In systems, y is measured."""
    hidden: Annotated[tuple[int, ...], _INDICES, hint("all others; without --measured the velocities")] = ()
    """Entries of the flattened observation that an observer estimates."""
    env_kwargs: EnvironmentArguments = ()
    time_constants: Annotated[tuple[float, ...], _STEPS, hint("1,2,4,8")] = ()
    """Time constants, in actions, of the memory z and of traces (running means). Without noise, agents may
    learn more easily with 1 or 1,2."""
    frames: Annotated[int | None, hint("8")] = None
    """Number of stacked observations, each with the action before it."""
    no_past_actions: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave past actions out of z, traces and stacked observations."""
    angles: Annotated[tuple[Annotated[tuple[int, ...], _PAIR], ...], tyro.conf.UseAppendAction, hint("none")] = ()
    """Entries of the cosine and the sine of a measured angle, as in 0,1; repeat the option for each angle. z then holds
    the unwrapped angle."""

    def task(self, name: str, measurement_noise: Any = None) -> Task:
        """Return the task of a system or an environment with these options."""
        options = {name: value for name, value in vars(self).items() if value not in ((), None)}
        if self.env_kwargs:
            options["env_kwargs"] = merged("--env-kwargs", self.env_kwargs)
        if options.pop("no_past_actions"):
            options["past_actions"] = False
        return get_task(name, measurement_noise, **options)


@dataclass(frozen=True)
class Train:
    """Train an agent with stable-baselines3, to hold a system at its target or to act in a partly observed environment.

    Writes agent.safetensors (the policy, its task, and its observer's name), curve.csv (steps, CPU seconds and return
    of each episode) and any learned observer into the run's folder. Hyperparameters are those of
    training/agents/hyperparameters. A resumed training does not reproduce an uninterrupted one.
    """

    name: Name
    information: Information = "x_hat"
    """The agent's observation; docs/guides/agents.md explains the choices."""
    seed: int = 0
    """Seed of networks, exploration and episodes."""
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each measured sample; in environments, the default is 0."""
    timesteps: Annotated[int | None, hint("from the hyperparameters")] = None
    """Number of actions in the training, over all environments."""
    observer: Annotated[str | None, hint("the system's map; else one is learned for x_hat", metavar="MAP")] = None
    """A shipped map's name or a .safetensors file, for an agent that sees x_hat, x_hat_std or z."""
    algorithm: Annotated[
        Literal["ppo", "sac", "td3", "tqc", "dqn", "a2c", "ppo_lstm"] | None,
        hint("ppo_lstm for recurrent; sac for reverse_duffing, Pendulum-v1, MountainCarContinuous-v0; else ppo"),
    ] = None
    """The algorithm of stable-baselines3. Recurrent agents need ppo_lstm."""
    observer_steps: Annotated[int | None, hint("nine tenths of all steps; with noise one tenth; z: none")] = None
    """For environments without --observer: number of steps at the start, from which an observer is learned. Without
    noise the agent also learns in them, from true hidden signals; only the last 100,000 of these steps serve the
    observer. With noise the actions in them are random. For --information z with noise: number of steps with random
    actions at the start, from which the memory learns weights, so that z predicts the next outputs."""
    aggregate: int = 0
    """Number of refits of the observer to the agent's own steps while the agent learns from estimates. With refits,
    the agent neither learns nor explores in the last twentieth of all steps, and a last refit follows."""
    options: tyro.conf.OmitArgPrefixes[TaskOptions] = field(default_factory=TaskOptions)
    folder: tyro.conf.OmitArgPrefixes[RunOptions] = field(default_factory=RunOptions)

    def run(self, console: Console) -> None:
        """Train an agent, and evaluate it on a hundred episodes."""
        # These imports take seconds.
        from training.agents.learning import learn
        from training.run import CHECKPOINT

        task = self.options.task(self.name, self.measurement_noise)
        folder = self.folder.out or Path("runs/agents") / f"{task.name}-{self.information}-{self.seed}"
        set_threads(self.folder.threads)
        with locked(folder), progress_bars(console, folder / LOG) as progress:
            if (folder / "agent.safetensors").exists() and not self.folder.resume:
                raise FileExistsError(f"{folder} already holds an agent; choose another folder with --out")
            if (folder / f"agent{CHECKPOINT}").exists() and not self.folder.resume:
                raise FileExistsError(
                    f"{folder} holds the checkpoint of a training: continue the training (--resume), remove the "
                    "checkpoint, or choose another folder with --out"
                )
            progress.say(f"training an agent for {task.name} that sees {self.information}, in {folder}")
            agent = learn(
                task,
                self.information,
                folder,
                algorithm=self.algorithm,
                timesteps=self.timesteps,
                seed=self.seed,
                observer=self.observer,
                observer_steps=self.observer_steps,
                aggregate=self.aggregate,
                resume=self.folder.resume,
                progress=progress,
            )
            evaluate(progress, agent, 100, trusted=task.system or task.env_id)
            progress.say(f"wrote {', '.join(sorted(path.name for path in folder.glob('[!.]*')))} in {folder}")


@dataclass(frozen=True)
class Evaluate:
    """Play an agent on unseen episodes, and print means with 95 % intervals."""

    agent: AgentFile
    episodes: int = 500
    """Number of episodes."""
    seed: int = 0
    """Seed of the episodes. They differ from those of every training."""
    trust: Trust = None

    def run(self, console: Console) -> None:
        """Play the episodes, and print the results."""
        with progress_bars(console) as progress:
            evaluate(progress, Agent.read(find(self.agent)), self.episodes, self.seed, trusted=self.trust)


@dataclass(frozen=True)
class Export:
    """Write an agent as a zip of stable-baselines3, for PPO.load, SAC.load and so on.

    The agent in the zip has untrained value functions, so that it can play but not continue to learn.
    """

    agent: AgentFile
    out: Path
    """Zip file to write."""
    trust: Trust = None

    def run(self, console: Console) -> None:
        """Write the zip file."""
        from training.agents.sb3_files import to_sb3

        model = to_sb3(Agent.read(find(self.agent)), trusted=self.trust)
        with replacing(self.out) as path:
            model.save(path)
        console.print(f"wrote {self.out}: {type(model).__name__}.load reads it")


@dataclass(frozen=True)
class Import:
    """Convert an agent of stable-baselines3 or rl-zoo3. Agents of systems must have learned in training.agents.OnTask.

    Writes agent.safetensors for kkl-gym agent evaluate. Nothing is unpickled.
    """

    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="AGENT.zip")]
    """Zip file of an agent that was trained without VecNormalize."""
    name: Name
    information: Information = "x_hat"
    """The agent's observation."""
    out: Path = Path("agent.safetensors")
    """File to write."""
    observer: Annotated[str | None, hint("the system's", metavar="MAP")] = None
    """The shipped map or .safetensors file with which the agent was trained."""
    measured: Measured = ()
    """Entries of the flattened observation that the agent may see, as in 0,1."""

    def run(self, console: Console) -> None:
        """Convert the agent, and write its file."""
        from training.agents.sb3_files import from_sb3

        from_sb3(self.path, TaskOptions(self.measured).task(self.name), self.information, self.observer).save(self.out)
        console.print(f"wrote {self.out}")


@dataclass(frozen=True)
class AgentCommand:
    """Train, evaluate and convert agents that see a part of the state, a memory, or an observer's estimate."""

    command: Annotated[
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Import, tyro.conf.subcommand("import")],
        tyro.conf.arg(name=""),
    ]

    def run(self, console: Console) -> None:
        """Run the chosen command."""
        self.command.run(console)


def evaluate(progress: ProgressBars, agent: Agent, n: int, seed: int = 0, *, trusted: str | None = None) -> Episodes:
    """Play episodes, and print the return and, where they exist, scores at a target or errors of x_hat."""
    first, task = agent_evaluation_seed(seed, n), agent.task
    env = agent.make(n, trusted=trusted)
    try:
        with progress.phase(f"playing {n} episodes", n) as report:
            played = play(env, agent.policy(env.single_action_space), seed=first, report=report)
    finally:
        env.close()
    rows = [
        ("system" if task.system else "environment", task.name),
        ("sees", agent.information),
        ("measurement noise", show_level(task.measurement_noise)),
        ("episodes", str(n)),
        ("return (sum of the environment's rewards)", _mean(played.returns)),
    ]
    system = None if task.system is None else get_system(task.system)
    if system is not None and not system.states_task:
        x = played.signals("x")
        rows += [
            ("score (mean of exp(-4 cost) - 1, at best 0)", _mean(scores(system, x))),
            (f"holds the target within {TOLERANCE:g} scales", f"{_mean(100.0 * successes(system, x))} %"),
            ("escaped", f"{100 * played.escaped.mean():.0f} %"),
        ]
    elif played.x is not None and played.x_hat is not None:
        steps = np.arange(len(played.x))[:, None]
        judged = (steps > TRANSIENT) & (steps <= played.lengths)
        x, x_hat = played.x[judged], played.x_hat[judged]
        if len(x):
            errors = np.sqrt(np.mean((x_hat - x) ** 2, axis=0)) / np.maximum(np.std(x, axis=0), 1e-300)
            text = ", ".join(f"{error:.2%}" for error in errors)
            rows.append((f"rms error of x_hat / standard deviation of x, after {TRANSIENT} steps", text))
    table = Table(show_header=False)
    for label, value in rows:
        table.add_row(label, value)
    progress.console.print(table)
    return played


def _mean(values: Sequence[float] | np.ndarray) -> str:
    """Return the mean over episodes with its 95 % interval. Shapes: ``values`` (n,)."""
    half = 1.96 * np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{np.mean(values):.4g}" + ("" if np.isnan(half) else f" ± {half:.2g}")
