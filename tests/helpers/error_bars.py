"""Random covariances of T_inv's error, for artifacts that depend on the measurement noise."""

from dataclasses import replace

import numpy as np

from observers import ErrorCovariance

LEVELS, AGES = np.array([0.0, 0.3, 1.0]), np.array([0.0, 0.1, 1.0])


def covariances(nx, seed=0, factor=1.0):
    """Random covariances by level and age, times a factor."""
    root = np.random.default_rng(seed).normal(size=(len(LEVELS), len(AGES), nx, nx))
    return ErrorCovariance(LEVELS, AGES, factor * (root @ root.mT + 0.5 * np.eye(nx)))


def with_error_bars(artifact, seed=0, factor=1.0):
    def extended(inverse, seed):
        return inverse and replace(inverse, error_covariance=covariances(artifact.nx, seed, factor))

    return replace(
        artifact, inverse=extended(artifact.inverse, seed), free_inverse=extended(artifact.free_inverse, seed + 100)
    )
