"""Agents from stable-baselines3 that act on what an observer shows."""

from typing import Any

__all__ = ["SB3VecEnv"]


def __getattr__(name: str) -> Any:
    """The bridge, imported when it is asked for: stable-baselines3 takes seconds, and playing an agent needs none."""
    if name == "SB3VecEnv":
        from training.agents.bridge import SB3VecEnv

        return SB3VecEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
