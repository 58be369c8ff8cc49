"""Error bars of random weights for any artifact that is told measurement noise."""

from dataclasses import replace

import numpy as np

from observers import MLP, Spread

LEVELS, AGES = np.array([0.0, 0.3, 1.0]), np.array([0.0, 0.1, 1.0])


def with_error_bars(artifact, seed=0, outputs=None, activation="tanh"):
    rng = np.random.default_rng(seed)

    def layer(inputs, outputs):
        return rng.normal(size=(outputs, inputs)) / inputs**0.5, rng.normal(size=outputs)

    def extended(inverse):
        count = outputs or artifact.nx * (artifact.nx + 1) // 2
        first, last = layer(inverse.mlp.inputs, 8), layer(8, count)
        tables = (2, 3, 3) if "process_noise" in inverse.features else (3, 3)
        mlp = MLP([first[0], last[0]], [first[1], last[1]], activation)
        return replace(inverse, spread=Spread(mlp, LEVELS, AGES, rng.uniform(0.5, 2.0, tables)))

    free = artifact.free_inverse
    return replace(artifact, inverse=extended(artifact.inverse), free_inverse=None if free is None else extended(free))
