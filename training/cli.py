"""The command line, ``kkl-gym`` (or ``python -m training``)."""

import sys
from collections.abc import Callable
from typing import Any

import tyro
from rich.console import Console

from training.commands.evaluate import Evaluate
from training.commands.maps import Maps
from training.commands.train import Train


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the ``kkl-gym`` command."""
    from training.commands.agent import AgentCommand
    from training.commands.benchmark import Benchmark
    from training.commands.certify import Certify
    from training.commands.compare import Compare
    from training.commands.demo import Demo
    from training.commands.faults import Faults
    from training.commands.speed import Speed
    from training.commands.tune import Tune

    commands: dict[str, Callable[..., Any]] = {
        "train": Train,
        "evaluate": Evaluate,
        "benchmark": Benchmark,
        "agent": AgentCommand,
        "certify": Certify,
        "tune": Tune,
        "faults": Faults,
        "maps": Maps,
        "demo": Demo,
        "speed": Speed,
    }
    console = Console()
    command: Any = tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="kkl-gym",
        description="Learned KKL observers for Gymnasium environments.",
        args=arguments,
    )
    try:
        command.run(console)
    except ModuleNotFoundError as error:
        sys.exit(f"kkl-gym: {error}; pip install 'kkl-gym[agents]' has everything")
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"kkl-gym: {error}")
    except KeyboardInterrupt:
        hint = "; --resume goes on from the last checkpoint" if isinstance(command, Train) else ""
        goes_on = isinstance(command, Benchmark) or isinstance(getattr(command, "command", None), Compare)
        hint = "; the same command goes on" if goes_on else hint
        sys.exit(f"kkl-gym: interrupted{hint}")
