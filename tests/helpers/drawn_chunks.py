"""Chunks that a training draws, and what its observer is to make of them."""

import numpy as np
import torch


def two_chunks(problem):
    """Train on two chunks; returns the generator, and of rows that go on: which, outputs, what is told of noise."""
    drawn, draw = [], problem.chunks.draw

    def spy(generator):
        drawn.append(draw(generator))
        return drawn[-1]

    problem.chunks.draw, generator = spy, torch.Generator().manual_seed(0)
    for _ in range(2):
        problem.loss(generator)["loss"].backward()
    kept = ~drawn[1].fresh.numpy()
    y = torch.cat([chunk.y for chunk in drawn]).numpy()[:, kept]
    return generator, kept, np.ascontiguousarray(y), drawn[1].told[kept]
