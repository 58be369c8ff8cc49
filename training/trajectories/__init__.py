"""Simulated motions: inputs, noise, policies, and what follows from a system's equations."""
