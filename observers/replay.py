"""Samples that are missing, filled by a map's own prediction, and T_inv along whole records."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoders
from observers.samples import checked_record, first_state, held_input

_CHUNK = 8192  # rows of a record that go through the network at once; more fall out of the cache


def filled(
    artifact: Artifact,
    states: Decoders,
    y: np.ndarray,
    gaps: np.ndarray,
    u: np.ndarray,
    *,
    z: np.ndarray,
    before: np.ndarray,
    age: Any,
) -> np.ndarray:
    """Samples y with gaps filled by h(T_inv(z)); z, ``before`` and ``age`` are those of the sample before."""
    linear, rows = artifact.filter, gaps.any(-1)
    if not artifact.knows_output:
        return np.where(gaps, before, y)
    if rows.ndim and not rows.all():  # the network is not evaluated in rows that are complete
        y, age = y.copy(), np.broadcast_to(age, rows.shape)[rows]
        y[rows] = filled(artifact, states, y[rows], gaps[rows], u[rows], z=z[rows], before=before[rows], age=age)
        return y

    def predicted(z: np.ndarray, age: Any) -> np.ndarray:
        h = artifact.output(states(z, age * linear.dt))
        return np.where(gaps, np.where(np.isfinite(h), h, before), y)

    return predicted(linear.advance(z, before, u, predicted(z, age)), age + 1)  # as it is now, corrected once


def along(
    artifact: Artifact,
    states: Decoders,
    y: np.ndarray,
    u: np.ndarray | None,
    *,
    of: Callable[[np.ndarray, Any], np.ndarray],
    x0: np.ndarray | None = None,
) -> np.ndarray:
    """A function of the filter's states and their ages at each sample of a record."""
    y, u, gaps = checked_record(artifact, y, u)
    steps, batch, linear = len(y), y.shape[1:-1], artifact.filter
    parts = []
    rows = max(1, _CHUNK // max(1, math.prod(batch)))
    z, age0 = first_state(artifact, y[0], x0)
    for first in range(0, steps, rows):
        record = np.empty((min(rows, steps - first), *z.shape))
        for i, k in enumerate(range(first, first + len(record))):
            if k > 0:
                held = held_input(artifact, None if u is None else u[k - 1], batch)
                if gaps is not None and gaps[k].any():
                    y[k] = filled(artifact, states, y[k], gaps[k], held, z=z, before=y[k - 1], age=age0 + k - 1)
                z = linear.advance(z, y[k - 1], held, y[k])
            record[i] = z
        age = (age0 + np.arange(first, first + len(record))) * linear.dt
        parts.append(of(record, age.reshape(len(record), *(1 for _ in batch))))
    return np.concatenate(parts)


class RecordEstimates:
    """The methods of :class:`observers.KKLObserver` that go along whole records, and leave its own state as it is."""

    artifact: Artifact
    _states: Decoders
    _tracker: Any
    _identifier: Any
    _twin: Any

    def estimate(self, y: np.ndarray, u: np.ndarray | None = None, *, x0: np.ndarray | None = None) -> np.ndarray:
        """Estimate along a whole record, as :meth:`reset` and :meth:`step` would row by row.

        The observer's own state is left as it was.

        Parameters
        ----------
        y : array_like, shape (steps, ..., ny)
            Outputs; the first row is y_0. Later ones are NaN where they are missing.
        u : array_like, shape (steps - 1, ..., nu), optional
            The input held after each row but the last, by default zero. A last row more is ignored.
        x0 : array_like, shape (..., nx), optional
            The state at y_0, where it is known, as for :meth:`reset`.

        Returns
        -------
        ndarray, shape (steps, ..., nx)
            Estimates.

        Raises
        ------
        ValueError
            As :meth:`reset` and :meth:`step`.
        """
        return self._along(y, u, x0, "decode", of=self._states)

    def estimate_parameters(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Estimate the system's uncertain parameters along a whole record: :attr:`parameters_hat` at each sample.

        Parameters
        ----------
        y, u
            As for :meth:`estimate`.

        Returns
        -------
        ndarray, shape (steps, ..., number)
            Estimates.

        Raises
        ------
        ValueError
            As :meth:`estimate`, and if the artifact estimates no parameters.
        """
        return along(self.artifact, self._states, y, u, of=self._identifier())

    def estimate_covariance(
        self, y: np.ndarray, u: np.ndarray | None = None, *, x0: np.ndarray | None = None
    ) -> np.ndarray:
        """Covariances of the errors of what :meth:`estimate` returns.

        Parameters
        ----------
        y, u, x0
            As for :meth:`estimate`.

        Returns
        -------
        ndarray, shape (steps, ..., nx, nx)
            What :attr:`covariance` would be at each sample.

        Raises
        ------
        ValueError
            As :meth:`estimate`, and if the artifact holds no covariance.
        """
        self.artifact.require_covariance()
        return self._along(y, u, x0, "decode_covariance", of=self._states.covariances)

    def _along(self, y: np.ndarray, u: np.ndarray | None, x0: np.ndarray | None, method: str, *, of: Any) -> np.ndarray:
        """What a method returns at each sample: step by step where the observer tracks, else of T_inv at once."""
        if self._tracker is None:
            return along(self.artifact, self._states, y, u, of=of, x0=x0)
        observer = self._twin(self.artifact)
        y, u, gaps = checked_record(observer.artifact, y, u)
        observer.reset(y[0], x0)
        first = getattr(observer, method)()
        out = np.empty((len(y), *first.shape))
        out[0] = first
        for k in range(1, len(y)):
            missing = gaps is not None and gaps[k].all()
            observer.advance(None if missing else y[k], None if u is None else u[k - 1])
            out[k] = getattr(observer, method)()
        return out
