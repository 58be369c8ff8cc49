"""Agents from stable-baselines3 that act on what an observer shows."""

from training.agents.bridge import SB3VecEnv

__all__ = ["SB3VecEnv"]
