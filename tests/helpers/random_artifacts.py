"""Observers with random weights."""

from itertools import pairwise

import numpy as np

from kkl_gym import get_system
from observers import MLP, Artifact, ForwardMap, InverseMap, LinearFilter


def random_mlp(rng, inputs, outputs, activation="silu", width=8):
    sizes = (inputs, width, width, outputs)
    weights = [rng.normal(size=(b, a)).astype(np.float32) / np.sqrt(a) for a, b in pairwise(sizes)]
    biases = [rng.normal(size=b).astype(np.float32) for b in sizes[1:]]
    return MLP(weights, biases, activation)


def random_artifact(
    system="van_der_pol",
    inputs=True,
    noise=True,
    age=True,
    dt=0.01,
    pair=False,
    forward=False,
    free_inverse=False,
    process=False,
    outputs=1,
    estimated=False,
):
    """A complete observer for a system with random weights; each of several outputs has its own noise level."""
    system = get_system(system)
    uncertain = system.parameters if estimated else {}
    scale = np.array([*system.scale, *uncertain.values()])
    rng = np.random.default_rng(0)
    nz = 2 * system.nx + 1
    A = -np.diag(np.linspace(1.0, 6.0, nz))
    if pair:
        A[:2, :2] = [[-1.0, 4.0], [-4.0, -1.0]]
    linear = LinearFilter(A, rng.normal(size=(nz, outputs)), dt, system.nu if inputs else 0)
    modes = linear.size - 1
    features = (
        "z_y",
        *(["z_u"] if linear.nu else []),
        *(["measurement_noise"] if noise else []),
        *(["process_noise"] if process else []),
        *(["age"] if age else []),
    )
    levels = {"process_noise_unit": 0.01, "process_noise_max": 0.2} if process else {}
    each, largest = (outputs,) * (outputs > 1), tuple(range(1, outputs + 1)) if outputs > 1 else 1.0
    inverse = InverseMap(
        mlp=random_mlp(rng, modes + noise * outputs + process + age, len(scale)),
        features=features,
        z_offset=rng.normal(size=linear.size),
        whiten=rng.normal(size=(modes, linear.size)),
        noise_gain=rng.uniform(0.1, 1.0, (*each, modes)),
        x_offset=rng.normal(size=len(scale)),
        x_scale=scale,
        measurement_noise_unit=0.1,
        measurement_noise_max=largest if noise else np.inf,
        **levels,
        age_unit=0.05,
        age_max=2.0 if age else 0.0,
    )
    ones, zeros = np.ones, np.zeros
    return Artifact(
        filter=linear,
        inverse=inverse,
        system=system.name,
        parameters=system.parameters,
        forward=ForwardMap(
            random_mlp(rng, system.nx, nz, "tanh"), zeros(system.nx), 2 * ones(system.nx), ones(nz), 3 * ones(nz)
        )
        if forward
        else None,
        free_inverse=InverseMap(
            mlp=random_mlp(rng, nz + noise * outputs + process, len(scale)),
            features=tuple(name for name in features if name not in ("z_u", "age")),
            z_offset=rng.normal(size=nz),
            whiten=rng.normal(size=(nz, nz)),
            noise_gain=rng.uniform(0.1, 1.0, (*each, nz)),
            x_offset=rng.normal(size=len(scale)),
            x_scale=scale,
            measurement_noise_unit=0.2,
            measurement_noise_max=inverse.measurement_noise_max,
            **levels,
        )
        if free_inverse
        else None,
        parameter_ranges={name: (0.9 * value, 1.1 * value) for name, value in uncertain.items()},
        estimated_parameters=tuple(uncertain),
        training={"preset": "none", "seed": 0},
        versions={"numpy": np.__version__},
    )
