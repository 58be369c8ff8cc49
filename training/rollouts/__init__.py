"""Rollouts of environments, and observers that are learned from them."""

from training.rollouts.learning import learn
from training.rollouts.playing import Policy, make, policy_of, roll_out

__all__ = ["Policy", "learn", "make", "policy_of", "roll_out"]
