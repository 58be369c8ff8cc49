"""Judging an observer: errors on unseen trajectories, limits of monitors, faults, certificates, reports."""
