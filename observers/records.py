"""Estimates along whole records."""

from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.checks import real_array
from observers.kkl import KKL
from observers.samples import check_output, held_input, intervals, recorded_inputs


class RecordEstimates:
    """The methods of :class:`observers.KKLObserver` for whole records; they do not change the observer's state."""

    artifact: Artifact
    _kkl: KKL
    _delay: int
    _warn: Any
    _begin: Any

    def estimate(
        self, y: np.ndarray, u: np.ndarray | None = None, *, x0: np.ndarray | None = None, t: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the estimates along a whole record, as :meth:`reset` and :meth:`step` would return them row by row.

        The observer keeps its state. Raises ValueError like :meth:`reset` and :meth:`step`, and if there is a delay.

        Parameters
        ----------
        y : array_like, shape (steps, ..., ny)
            Outputs; the first row is y_0. Missing outputs in later rows are NaN.
        u : array_like, shape (steps - 1, ..., nu), optional
            The input held after each row except the last, by default zero. An additional last row is ignored.
        x0 : array_like, shape (..., nx), optional
            The state at y_0, if it is known, as for :meth:`reset`.
        t : array_like, shape (steps,), optional
            Increasing times of the samples in seconds. By default samples are one sampling interval of the map apart.

        Returns
        -------
        ndarray, shape (steps, ..., nx)
            Estimates.
        """
        return self._along(y, u, x0, of=self._kkl.decode, t=t)

    def estimate_parameters(self, y: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Return estimates (steps, ..., number) of uncertain parameters: :attr:`parameters_hat` along a whole record.

        ``y``, ``u`` and errors are as in :meth:`estimate`. Also raises ValueError if the map estimates no parameters.
        """
        return self._along(y, u, None, of=self._kkl.parameters_hat)

    def estimate_covariance(
        self, y: np.ndarray, u: np.ndarray | None = None, *, x0: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the error covariances (steps, ..., nx, nx) of :meth:`estimate`: :attr:`covariance` at each sample.

        Arguments and errors are as in :meth:`estimate`. Also raises ArtifactError if the map has no covariance.
        """
        self.artifact.require_covariance()
        return self._along(y, u, x0, of=self._kkl.covariance)

    def _along(
        self, y: np.ndarray, u: np.ndarray | None, x0: np.ndarray | None, *, of: Any, t: np.ndarray | None = None
    ) -> np.ndarray:
        """Return ``of`` at each sample; ``of`` maps the internal states (n, ...) of n observers to n rows of values."""
        if self._delay:
            raise ValueError("a record needs an observer without a delay: shift the recorded outputs by the delay")
        y = real_array("y", y)
        if y.ndim < 2 or not len(y):
            raise ValueError(f"y must be a record of shape (steps, ..., {self.artifact.ny}), got {y.shape}")
        check_output(self.artifact, y, y.shape[:-1], self._warn)
        check_output(self.artifact, y[:1], y[:1].shape[:-1])
        dts = None if t is None else intervals(t, len(y))
        u = held_input(self.artifact, recorded_inputs(u, len(y)), (len(y) - 1, *y.shape[1:-1]), self._warn)
        state = self._begin(y[0], x0)
        samples, inputs = (each.reshape(len(each), len(state), each.shape[-1]) for each in (y, u))
        values = self._kkl.along(state, samples, inputs, of, dts)
        return values.reshape(*y.shape[:-1], *values.shape[2:])
