"""Research commands, run in this process."""

from examples.research.__main__ import COMMANDS
from training.cli import main


def research(*arguments):
    """Run ``python -m examples.research ARGUMENTS``."""
    main([*arguments], prog="python -m examples.research", commands=COMMANDS)
