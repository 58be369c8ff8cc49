"""Tracking observers with the true motion and a T_inv of random weights."""

import itertools
from dataclasses import replace

import numpy as np
from error_bars import with_error_bars
from random_artifacts import random_artifact

from observers import MLP, Equations, Expression, Factors, Flow, Motion

JUMPS = (600, 605)  # samples with an offset, after which the tracker diverges
OFF = (1200, 1400)  # samples with a slow oscillation: correlated innovations
# Options of :func:`tracking` for which compiled and exported steps are compared.
KINDS = (
    {},
    {"by": "flow"},
    {"by": "discrete", "age": False},
    {"by": "flow", "inputs": False},
    {"system": "lorenz", "inputs": False, "surer": 1.0},
    {"outputs": 2, "surer": -1.0, "process": True, "free_inverse": True},
    {"by": "flow", "system": "lorenz", "outputs": 2, "surer": -1.0, "age": False, "pair": True},
    {"system": "lorenz", "nonlinear": True, "outputs": 2},
)


def an_equation(nx, nu, dt, discrete=False):
    """A damped pendulum with a position-dependent input gain; a third state if nx is 3; Euler steps if `discrete`."""
    angle, speed = ["x", 0], ["x", 1]
    pushed = ["*", ["+", 2.0, ["cos", angle]], ["u", 0]] if nu else 0.0
    field = [["*", 4.0, speed], ["+", ["*", -4.0, ["sin", angle]], ["*", -0.5, speed], pushed]]
    if nx == 3:
        field.append(["+", ["*", -1.5, ["tanh", ["x", 2]]], ["*", 0.8, angle, speed]])
    if discrete:
        field = [["+", ["x", i], ["*", dt, part]] for i, part in enumerate(field)]
    return Equations(Expression(field), substeps=0 if discrete else 2)


def a_flow(nx, nu, seed=0):
    """A damped rotation plus a small network."""
    rng, sizes = np.random.default_rng(seed), (nx + nu, 13, 11, nx)
    mlp = MLP(
        [rng.normal(size=(b, a)) / a**0.5 for a, b in itertools.pairwise(sizes)],
        [rng.normal(size=b) for b in sizes[1:]],
        "tanh",
    )
    turn = rng.normal(size=(nx, nx))
    linear = np.hstack([0.05 * (turn - turn.T) - 0.02 * np.eye(nx), 0.1 * rng.normal(size=(nx, nu))])
    return Flow(
        mlp=mlp,
        linear=np.column_stack([0.01 * rng.normal(size=nx), linear]),
        gain=0.02 * rng.uniform(0.5, 1.0, nx),
        u_scale=rng.uniform(0.5, 2.0, nu),
    )


def tracking(by="equations", outputs=1, inputs=True, nonlinear=False, surer=0.0, **options):
    """An observer with a T_inv of random weights; its motion is by "equations", "discrete" equations or a "flow".

    ``surer`` divides T_inv's standard deviation by e^surer; options are those of random_artifact.
    """
    artifact = random_artifact(inputs=inputs, outputs=outputs, **options)
    artifact = with_error_bars(artifact, factor=np.exp(-2.0 * surer))
    rng, nx, nu, dt = np.random.default_rng(3), artifact.nx, artifact.nu, artifact.filter.dt
    moved = (
        {"flow": a_flow(nx, nu)} if by == "flow" else {"equations": an_equation(nx, nu, dt, discrete=by == "discrete")}
    )
    factors = np.array([[[2.0, 1.0], [1.5, 0.7]], [[2.5, 1.5], [1.0, 0.9]]])[: 1 + bool(artifact.process_noise_max)]
    root = rng.normal(size=(nx, nx))
    motion = Motion(
        **moved,
        x_offset=rng.normal(size=nx),
        x_scale=rng.uniform(0.5, 2.0, nx),
        low=np.full(nx, -8.0),
        high=np.full(nx, 8.0),
        mean=0.1 * rng.normal(size=nx),
        covariance=0.1 * root @ root.T + 0.5 * np.eye(nx),
        error=np.full(nx, 2e-3),
        process_noise=np.full(nx, 1e-2),
        least_process_noise=0.1,
        least_measurement_noise=np.full(outputs, 0.02),
        window=0.2,
        factors=Factors(np.array([0.0, 0.5]), np.array([0.0, 1.0]), factors),
    )
    C = rng.normal(size=(outputs, nx))
    h = [
        ["+", *(["*", c, ["sin" if i else "x", ["x", i] if i else 0]] for i, c in enumerate(row))] for row in C.tolist()
    ]
    return replace(artifact, motion=motion, **({"h": Expression(h)} if nonlinear else {"C": C}))


def signals(artifact, steps, batch=()):
    """Noisy outputs along the motion, with an offset in JUMPS and an oscillation in OFF, and inputs."""
    rng, motion, dt = np.random.default_rng(1), artifact.motion, artifact.filter.dt
    u = np.sin(np.cumsum(0.3 * rng.normal(size=(steps, *batch, artifact.nu)), axis=0))
    u[: steps // 10] = 0.0
    x, y = motion.mean + 0.5 * rng.normal(size=(*batch, artifact.nx)), []
    for k in range(steps):
        x = motion.step(x, u[k], dt) + 0.002 * rng.normal(size=x.shape)
        y.append(artifact.output(x) + 0.1 * rng.normal(size=(*batch, artifact.ny)))
    y = np.array(y)
    y[slice(*JUMPS)] += 6.0
    off = y[slice(*OFF)]
    off += np.sin(np.arange(len(off)) / 6).reshape(-1, *(1 for _ in off.shape[1:]))
    return y, u


def of_floats(artifact, steps):
    """The signals rounded to float32."""
    return (each.astype(np.float32).astype(float) for each in signals(artifact, steps))
