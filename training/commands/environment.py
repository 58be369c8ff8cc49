"""Agents in any environment as options of a command, and their training and evaluation."""

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import tyro
from rich.table import Table

from kkl_gym import SYSTEMS
from training.agents.any_environment.player import Player
from training.agents.any_environment.task import HIDDEN_VELOCITIES, HiddenTask
from training.agents.information import STACKED
from training.agents.seeds import agent_evaluation_seed
from training.commands.record import EnvironmentArguments
from training.progress import ProgressBars

TRANSIENT = 20  # steps of an episode whose estimates are not judged


@dataclass(frozen=True)
class EnvironmentOptions:
    """Options of agents in any environment; to be annotated with ``tyro.conf.OmitArgPrefixes``."""

    measured: Annotated[
        str, tyro.conf.arg(metavar="INDICES", help_behavior_hint="(default: the positions, of environments known here)")
    ] = ""
    """Entries of the flattened observation that agents may see, with commas between them, as in 0,1."""
    hidden: Annotated[str, tyro.conf.arg(metavar="INDICES", help_behavior_hint="(default: all others)")] = ""
    """Entries that an observer estimates."""
    env_kwargs: EnvironmentArguments = ()
    """An argument of the environment, once for each; values are JSON, or text."""
    aggregate: int = 0
    """How often an observer is fitted again, to the agent's own steps, while the agent learns on estimates. The last
    twentieth of all steps is then without exploration, and followed by one more fit."""

    time_constants: Annotated[str, tyro.conf.arg(metavar="STEPS", help_behavior_hint="(default: 1,2,4,8)")] = ""
    """Of the memory that agents on z have, in steps. Where there is no noise, 1 or 1,2 may be easier to learn with."""
    frames: int = STACKED
    """How many observations, each with the action before it, are stacked for agents on those."""
    no_past_actions: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave past actions out of what z and stacked hold; of these two alone."""
    angles: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PAIR", help_behavior_hint="(default: none)")
    ] = ()
    """Measured entries that are the cosine and the sine of an angle, once for each angle, as in 0,1. Then z holds how
    far it has turned, and so do stacked, in place of earlier cosines and sines; these two alone."""

    def refuse(self) -> None:
        """Raise ValueError if options are given, although nobody acts in an environment."""
        given = [
            f"--{field.name.replace('_', '-')}" for field in fields(self) if getattr(self, field.name) != field.default
        ]
        if given:
            raise ValueError(f"{', '.join(given)}: this is for agents in an environment, and none is named")

    def task(self, env_id: str, measurement_noise: float = 0.0) -> HiddenTask:
        """The task that these options describe."""
        known = HIDDEN_VELOCITIES.get(env_id)
        if known is None and not self.measured:
            raise ValueError(
                f"say what is measured of {env_id}, as in --measured 0,1; it is known of {', '.join(HIDDEN_VELOCITIES)}"
            )
        measured = _indices("measured", self.measured) if self.measured or known is None else known.measured
        hidden = known.hidden if known is not None and not self.measured else None
        return HiddenTask(
            env_id,
            measured,
            hidden=_indices("hidden", self.hidden) if self.hidden else hidden,
            measurement_noise=measurement_noise,
            env_kwargs=dict(self.env_kwargs),
            frames=self.frames,
            past_actions=not self.no_past_actions,
            angles=tuple(map(_pair, self.angles)),
            **({"time_constants": _steps("time-constants", self.time_constants)} if self.time_constants else {}),
        )


def _indices(name: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(int(entry) for entry in text.split(",") if entry.strip())
    except ValueError:
        raise ValueError(f"--{name} takes indices in the flattened observation, as in 0,1; got {text!r}") from None


def _pair(text: str) -> tuple[int, int]:
    entries = _indices("angles", text)
    if len(entries) != 2:
        raise ValueError(
            f"--angles takes the cosine's entry and the sine's, once for each angle, as in 0,1; got {text!r}"
        )
    return entries[0], entries[1]


def _steps(name: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(entry) for entry in text.split(",") if entry.strip())
    except ValueError:
        raise ValueError(f"--{name} takes numbers of steps, as in 1,2; got {text!r}") from None


def is_environment(name: str) -> bool:
    """Whether a name is that of an environment, rather than of a system or a file."""
    return name not in SYSTEMS and (name in gym.registry or re.search(r"-v\d+$", name) is not None)


def train_in_environment(
    options: EnvironmentOptions,
    env_id: str,
    information: Any,
    *,
    folder: Path,
    measurement_noise: float,
    progress: ProgressBars,
    **how: Any,
) -> None:
    """Train an agent in an environment and play a hundred episodes."""
    from training.agents.any_environment.learning import learn_to_play

    task = options.task(env_id, measurement_noise)
    learn_to_play(task, information, folder, aggregate=options.aggregate, progress=progress, **how)
    path = folder / "agent.safetensors"
    if path.exists():  # recurrent policies are no perceptrons, and leave the learning curve alone
        show_returns(progress, Player.read(path), 100, trusted=env_id)
    progress.say(f"wrote {', '.join(sorted(p.name for p in folder.glob('[!.]*')))} in {folder}")


def show_returns(
    progress: ProgressBars, player: Player, episodes: int, seed: int = 0, *, trusted: str | None = None
) -> np.ndarray:
    """Play episodes; print their mean return, and how good estimates were where the truth is shown."""
    first, returns = agent_evaluation_seed(seed, episodes), []
    states, estimates = list[np.ndarray](), list[np.ndarray]()
    with player.make(env_id=trusted) as env, progress.phase(f"playing {episodes} episodes", episodes) as report:
        for episode in range(episodes):
            observation, _ = env.reset(seed=first + episode)
            total, ended, steps = 0.0, False, 0
            while not ended:
                observation, reward, terminated, truncated, info = env.step(player.act(observation, env.action_space))
                total, ended, steps = total + float(reward), terminated or truncated, steps + 1
                if steps > TRANSIENT and {"x", "x_hat"} <= set(info):
                    states.append(info["x"])
                    estimates.append(info["x_hat"])
            returns.append(total)
            report(episode + 1)
    table = Table(show_header=False)
    for label, value in (
        ("environment", player.task.name),
        ("shown", player.information),
        ("episodes", str(episodes)),
        ("return", f"{np.mean(returns):.5g} ± {np.std(returns):.3g}"),
    ):
        table.add_row(label, value)
    if states:
        x, x_hat = np.array(states), np.array(estimates)
        errors = np.sqrt(np.mean((x_hat - x) ** 2, axis=0)) / np.maximum(np.std(x, axis=0), 1e-300)
        names = env.get_wrapper_attr("observer").artifact.signals["hidden"]
        text = ", ".join(f"{name} {error:.2%}" for name, error in zip(names, errors, strict=True))
        table.add_row(f"error of x_hat over standard deviation, after {TRANSIENT} steps", text)
    progress.console.print(table)
    return np.array(returns)
