"""Agents of stable-baselines3 that act on measurements, memories or estimates."""

from typing import Any

__all__ = ["OnTask", "SB3VecEnv"]


def __getattr__(name: str) -> Any:
    """Import on first use: stable-baselines3 takes seconds to import, and playing an agent does not need it."""
    if name == "SB3VecEnv":
        from training.agents.bridge import SB3VecEnv

        return SB3VecEnv
    if name == "OnTask":
        from training.agents.on_task import OnTask

        return OnTask
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
