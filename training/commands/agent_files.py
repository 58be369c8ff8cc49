"""``kkl-gym agent export`` and ``import``: agents as stable-baselines3's files, and where agents lie."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from observers.storage import replacing
from training.agents.agent import Agent, AgentError


@dataclass(frozen=True)
class Export:
    """Write an agent of a system as stable-baselines3's zip, which PPO.load or SAC.load reads.

    Its value functions are not trained: it is for playing.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="AGENT")]
    """An agent that ships, by its system's name, or an agent.safetensors file."""
    out: Path
    """The zip."""
    system: Annotated[str | None, tyro.conf.arg(metavar="CLASS", help_behavior_hint="")] = None
    """The agent's system if it is one of your own, as the agent's file names it."""

    def run(self, console: Console) -> None:
        """Export."""
        from training.agents.sb3_files import to_sb3

        model = to_sb3(Agent.read(find(self.agent)), system=self.system)
        with replacing(self.out) as path:
            model.save(path)
        console.print(f"wrote {self.out}: {type(model).__name__}.load reads it")


@dataclass(frozen=True)
class Import:
    """Read an agent that stable-baselines3 or rl-zoo3 has trained on training.agents.OnTask; nothing is unpickled.

    Writes agent.safetensors, which kkl-gym agent evaluate plays.
    """

    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="AGENT.zip")]
    """The zip of a PPO or SAC agent."""
    system: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SYSTEM")]
    """The system on whose task it was trained."""
    out: Path = Path("agent.safetensors")
    """The agent's file."""
    observer: Annotated[str | None, tyro.conf.arg(metavar="MAP", help_behavior_hint="(default: the task's)")] = None
    """The shipped map or .safetensors file that it was trained on."""

    def run(self, console: Console) -> None:
        """Import."""
        from training.agents.sb3_files import from_sb3

        from_sb3(self.path, self.system, self.observer).save(self.out)
        console.print(f"wrote {self.out}")


def find(name: str) -> Path:
    """Find the file of an agent."""
    if name.endswith(".safetensors"):
        return Path(name)
    folder = files("training.agents").joinpath("shipped")
    names = sorted(entry.name for entry in folder.iterdir())
    shipped = [entry.removesuffix(".safetensors") for entry in names if entry.endswith(".safetensors")]
    if name not in shipped:
        raise AgentError(f"no agent {name!r} ships; there are {', '.join(shipped)}; a file ends in .safetensors")
    return Path(str(folder.joinpath(f"{name}.safetensors")))
