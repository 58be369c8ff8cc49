"""Comparisons of agents that see different information."""
