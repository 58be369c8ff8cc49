"""Judging an observer: errors on unseen trajectories, coverage, faults, reports."""
