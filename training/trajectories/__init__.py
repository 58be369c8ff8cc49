"""Simulated data: inputs, noise, recorded trajectories, closed loops, controllers and derivatives of the equations."""
