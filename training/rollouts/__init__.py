"""Rollouts of environments: who acts, what is recorded, and observers that are learned from it."""

from training.rollouts.learning import learn
from training.rollouts.playing import make, roll_out
from training.rollouts.policies import Policy, policy_of

__all__ = ["Policy", "learn", "make", "policy_of", "roll_out"]
