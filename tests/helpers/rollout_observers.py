"""Observers with random weights for any Gymnasium environment."""

from itertools import pairwise

import numpy as np

from observers import MLP, Artifact, InverseMap, LinearFilter


def observer_of(env_id, measured, hidden, inputs, *, dt=1.0, kwargs=None, rates=(0.3, 1.0, 3.0)):
    """A complete observer; only its signals fit the environment."""
    rng, rates = np.random.default_rng(0), np.array(rates) / dt
    ny = len(measured)
    A, B = -np.diag(np.tile(rates, ny)), np.kron(np.eye(ny), rates[:, None])
    linear = LinearFilter(A, B, dt, len(inputs))
    sizes = (linear.size, 8, len(hidden))
    weights = [rng.normal(size=(b, a)) for a, b in pairwise(sizes)]
    mlp = MLP([w.astype(np.float32) for w in weights], [np.zeros(n, np.float32) for n in sizes[1:]], "tanh")
    zeros, nx = np.zeros(linear.size), len(hidden)
    inverse = InverseMap(
        mlp, ("z_y", "z_u")[: 1 + bool(inputs)], zeros, np.eye(linear.size), zeros, np.zeros(nx), np.ones(nx)
    )
    return Artifact(
        filter=linear,
        inverse=inverse,
        system="any",
        parameters={},
        measurement_noise=0.0,
        signals={"measured": measured, "inputs": inputs, "hidden": hidden},
        environment={"id": env_id, "kwargs": kwargs or {}},
    )
