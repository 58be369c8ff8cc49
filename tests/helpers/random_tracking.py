"""Observers that track by a flow that is the truth, with a T_inv of random weights."""

import itertools
from dataclasses import replace

import numpy as np
from error_bars import with_error_bars
from random_artifacts import random_artifact

from observers import MLP, Factors, Flow
from observers.polynomial import count

JUMPS = (600, 605)  # samples that no motion explains
OFF = (1200, 1400)  # samples that swing, so that innovations agree with one another
# Options of :func:`tracking` that exports have to get right.
KINDS = (
    {},
    {"inputs": False},
    {"outputs": 2, "surer": 2.0, "process": True, "free_inverse": True, "bend": 0.5},
    {"system": "lorenz", "surer": 2.0, "age": False, "pair": True},
)


def a_flow(nx, nu, ny, seed=0, process=None):
    """A damped rotation, bent a little by a cubic and a network."""
    rng, factors = np.random.default_rng(seed), np.array([[[2.0, 1.0], [1.5, 0.7]], [[2.5, 1.5], [1.0, 0.9]]])
    sizes = (nx + nu, 13, 11, nx)
    mlp = MLP(
        [rng.normal(size=(b, a)) / a**0.5 for a, b in itertools.pairwise(sizes)],
        [rng.normal(size=b) for b in sizes[1:]],
        "tanh",
    )
    turn = rng.normal(size=(nx, nx))
    linear = np.hstack([0.05 * (turn - turn.T) - 0.02 * np.eye(nx), 0.1 * rng.normal(size=(nx, nu))])
    bent = 1e-4 * rng.normal(size=(nx, count(nx + nu, 3) - count(nx + nu, 1)))
    return Flow(
        mlp=mlp,
        x_offset=rng.normal(size=nx),
        x_scale=rng.uniform(0.5, 2.0, nx),
        u_scale=rng.uniform(0.5, 2.0, nu),
        gain=0.02 * rng.uniform(0.5, 1.0, nx),
        polynomial=np.column_stack([0.01 * rng.normal(size=nx), linear, bent]),
        low=np.full(nx, -8.0),
        high=np.full(nx, 8.0),
        error=np.full(nx, 2e-3),
        process_noise=np.full(nx, 1e-2),
        least_process_noise=0.1,
        least_measurement_noise=np.full(ny, 0.02),
        window=0.2,
        factors=Factors(np.array([0.0, 0.5]), np.array([0.0, 1.0]), factors[0] if process is None else factors),
    )


def tracking(outputs=1, inputs=True, surer=0.0, bend=None, **options):
    """An observer of two states whose T_inv nobody trained, however sure it is, but whose flow is the truth."""
    artifact = with_error_bars(random_artifact(inputs=inputs, outputs=outputs, **options))
    spread = artifact.inverse.spread
    bars = MLP(spread.mlp.weights, [spread.mlp.biases[0], spread.mlp.biases[1] - surer], "tanh")
    artifact = replace(artifact, inverse=replace(artifact.inverse, spread=replace(spread, mlp=bars)))
    C = np.random.default_rng(3).normal(size=(outputs, artifact.nx))
    flow = a_flow(artifact.nx, artifact.nu, outputs, process=artifact.process_noise_max)
    return replace(
        artifact, C=C, flow=replace(flow, bend=None if bend is None else np.linspace(bend, 2 * bend, flow.nx))
    )


def signals(artifact, steps, batch=()):
    """Outputs along the flow with noise, which jump once and swing later, and inputs."""
    rng, flow = np.random.default_rng(1), artifact.flow
    u = np.sin(np.cumsum(0.3 * rng.normal(size=(steps, *batch, artifact.nu)), axis=0))
    u[: steps // 10] = 0.0
    x, y = flow.x_offset + flow.x_scale * rng.normal(size=(*batch, artifact.nx)), []
    for k in range(steps):
        x = flow(x, u[k]) + 0.002 * rng.normal(size=x.shape)
        y.append(x @ artifact.C.T + 0.1 * rng.normal(size=(*batch, artifact.ny)))
    y = np.array(y)
    y[slice(*JUMPS)] += 6.0
    off = y[slice(*OFF)]
    off += np.sin(np.arange(len(off)) / 6).reshape(-1, *(1 for _ in off.shape[1:]))
    return y, u


def of_floats(artifact, steps):
    """The same as floats hold them exactly."""
    return (each.astype(np.float32).astype(float) for each in signals(artifact, steps))
