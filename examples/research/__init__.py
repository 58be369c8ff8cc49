"""Comparisons and results of kkl-gym's pages: methods, agents, speed. It runs only in a clone."""
