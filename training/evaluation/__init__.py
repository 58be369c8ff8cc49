"""Evaluation of an observer: errors on unseen trajectories, coverage of covariances, faults, reports."""
