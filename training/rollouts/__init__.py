"""Rollouts of environments: who acts, and what is recorded."""

from training.rollouts.playing import make, roll_out
from training.rollouts.policies import Policy, policy_of

__all__ = ["Policy", "make", "policy_of", "roll_out"]
