"""Agents from stable-baselines3 that act on what an observer shows."""

from typing import Any

__all__ = ["OnTask", "SB3VecEnv"]


def __getattr__(name: str) -> Any:
    """What is imported when it is asked for: stable-baselines3 takes seconds, and playing an agent needs none."""
    if name == "SB3VecEnv":
        from training.agents.bridge import SB3VecEnv

        return SB3VecEnv
    if name == "OnTask":
        from training.agents.on_task import OnTask

        return OnTask
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
