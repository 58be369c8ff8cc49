"""Rows of one observer at several levels of noise, stepped as one batch."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from observers import Artifact
from observers.decoder import Decoders
from observers.tracker import Tracker

Level = float | tuple[float, ...]
Group = tuple[Level, float, int]
"""Level of measurement noise, level of process noise, number of rows."""


def decoders(artifact: Artifact, level: Level, process_noise: float) -> Decoders:
    """T_inv of the states at levels of noise."""
    return Decoders(artifact, slice(artifact.nx), measurement_noise=level, process_noise=process_noise)


class Together:
    """An observer whose rows fall into groups of like noise, one group after the other."""

    def __init__(self, artifact: Artifact, groups: Sequence[Group]) -> None:
        self._linear, self._age = artifact.filter, 0
        self._decoders = [decoders(artifact, level, noise) for level, noise, _ in groups]
        self._owner = np.repeat(np.arange(len(groups)), [n for _, _, n in groups])
        self._tracker = None if artifact.motion is None else _Stacked(artifact, groups, self._decoders, self._owner)

    def reset(self, y: np.ndarray) -> np.ndarray:
        """Begin. Shapes: ``y`` (n, ny); returns (n, nx)."""
        self._z, self._y, self._age = self._linear.start(y), y, 0
        if self._tracker is not None:
            self._rows = self._tracker.begin(y)
        return self._decoded()

    def step(self, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Take in the next samples, all of them present. Shapes: ``u`` (n, nu); returns (n, nx)."""
        if self._tracker is not None:
            self._rows, _ = self._tracker.advance(self._rows, y, u)
        self._z, self._y, self._age = self._linear.advance(self._z, self._y, u, y), y, self._age + 1
        return self._decoded()

    @property
    def covariance(self) -> np.ndarray:
        """That of the tracker, (n, nx, nx)."""
        assert self._tracker is not None
        return self._tracker.covariance(self._rows, self._ages)

    @property
    def _ages(self) -> np.ndarray:
        return np.full(len(self._z), float(self._age))

    def _decoded(self) -> np.ndarray:
        if self._tracker is None:
            age = self._age * self._linear.dt
            parts = [each(self._z[self._owner == i], age) for i, each in enumerate(self._decoders)]
            return np.concatenate(parts)
        self._rows = self._tracker.supervise(self._rows, self._z, self._ages)
        return self._rows[:, self._tracker.x]


class _Stacked(Tracker):
    """A tracker whose rows have levels of their own."""

    def __init__(self, artifact: Artifact, groups: Sequence[Group], of: Sequence[Decoders], owner: np.ndarray) -> None:
        (level, noise, _), self._each, self._owner = groups[0], of, owner
        super().__init__(artifact, of[0], measurement_noise=level, process_noise=noise)
        q, r = zip(*(self.motion.variances(level, noise) for level, noise, _ in groups), strict=True)
        q = [each * self.motion.x_scale**2 for each in q]
        self._Q, self._R = (np.array([np.diag(one) for one in each])[owner] for each in (q, r))

    def _map_estimates(self, z: np.ndarray, age: np.ndarray, where: np.ndarray) -> np.ndarray:
        return self._by_group(z, age, where, Decoders.__call__)

    def _map_covariances(self, z: np.ndarray, age: np.ndarray, where: np.ndarray) -> np.ndarray:
        return self._by_group(z, age, where, Decoders.covariances)

    def _by_group(self, z: np.ndarray, age: np.ndarray, where: np.ndarray, of: Any) -> np.ndarray:
        owner = self._owner[where]
        parts = {i: of(self._each[i], z[owner == i], age[owner == i]) for i in np.unique(owner)}
        found = np.empty((len(z), *next(iter(parts.values())).shape[1:]))
        for i, part in parts.items():
            found[owner == i] = part
        return found
