"""Comparisons and results of kkl-gym's pages: methods, certificates, agents, speed. Runs from a clone alone."""
