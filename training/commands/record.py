"""``kkl-gym record ENV_ID``."""

import re
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium as gym
import tyro
from rich.console import Console

from training.commands.options import PlayOptions, hint, names_in
from training.progress import progress_bars

if TYPE_CHECKING:
    from training.rollouts.playing import Policy

_NAMES = hint(metavar="SIGNALS")


@dataclass(frozen=True)
class RecordCommand:
    """Play episodes of any environment, and write them as a Minari data set for `kkl-gym train --data minari:ID`."""

    env_id: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="ENV_ID", help="An environment as gym.make takes it, such as Pendulum-v1."),
    ]
    measured: Annotated[str, _NAMES] = ""
    """Signals that an observer will see, separated by commas: indices in the flattened observation, keys of a Dict,
    info[KEY], or cos(...) and sin(...) of a signal."""
    hidden: Annotated[str, _NAMES] = ""
    """Signals that the observer will estimate, in the same form."""
    policy: str = "random"
    """Policy that chooses the actions: random; wandering (random actions, each held for a while); a function from
    observation to action as script.py:function or module:function; an agent.safetensors of `kkl-gym agent train ENV_ID
    --information state`; or an agent of stable-baselines3 as ppo:FILE.zip. Loading such a zip may run its code."""
    seed: int = 0
    """Seed of the environment and of random actions."""
    dataset: Annotated[str, hint("from environment and policy", metavar="ID")] = ""
    """Name of the data set, as in pendulum/random-v0."""
    play: tyro.conf.OmitArgPrefixes[PlayOptions] = field(default_factory=PlayOptions)

    def run(self, console: Console) -> str:
        """Play and record the episodes, and write the data set."""
        from training.records.episodes import dataset_folder, write_dataset
        from training.rollouts import play, policy_of

        name = self.dataset or f"{_word(self.env_id)}/{_word(self.policy)}-v0"
        # An invalid name raises here, before any episode is played.
        dataset_folder(name)
        policy_in = partial(_player if self.policy.endswith(".safetensors") else policy_of, self.policy)
        with progress_bars(console) as progress:
            rollouts = play(
                self.env_id,
                policy_in,
                progress,
                env_kwargs=self.play.arguments,
                measured=names_in(self.measured),
                hidden=names_in(self.hidden),
                episodes=self.play.episodes,
                steps=self.play.steps,
                seed=self.seed,
                name=name,
            )
            with progress.phase("writing the data set"):
                folder = write_dataset(rollouts, policy=self.policy)
            lengths = [len(episode.rewards) for episode in rollouts.episodes]
            ended = sum(episode.terminated for episode in rollouts.episodes)
            progress.say(
                f"{len(lengths)} episodes of {min(lengths)} to {max(lengths)} steps of {rollouts.dt:g} s, "
                f"{sum(lengths)} together; {ended} terminated"
            )
            signals = rollouts.signals
            progress.say(f"measured {', '.join(signals.measured)}; hidden {', '.join(signals.hidden) or 'nothing'}")
            progress.say(f"wrote {folder}: kkl-gym train NAME --data minari:{name}")
        return name


def _player(path: str, env: gym.Env[Any, Any]) -> "Policy":
    """Return the policy of one of this package's agents, which must observe the whole state."""
    from training.agents.agent import Agent

    agent, here = Agent.read(path), env.spec.id if env.spec else ""
    if agent.information != "state" or agent.task.env_id != here:
        raise ValueError(
            f"{path} is an agent for {agent.task.env_id} that sees {agent.information}: name an agent for {here} "
            "that sees state"
        )
    policy = agent.policy(env.action_space)
    flatten: Any = gym.spaces.flatten
    return lambda observation: policy(flatten(env.observation_space, observation)[None])[0]


def _word(text: str) -> str:
    """Return a text as a part of a data set's name."""
    return re.sub(r"\W+", "-", text.rpartition("/")[2].lower().removesuffix(".safetensors")).strip("-") or "data"
