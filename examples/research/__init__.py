"""Comparisons and results of kkl-gym's pages: methods, agents, speed. Runs from a clone alone."""
