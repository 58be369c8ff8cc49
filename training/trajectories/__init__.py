"""Simulated motions: inputs, noise, policies, closed loops, and what follows from a system's equations."""
