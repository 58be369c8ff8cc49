"""A tracker's step as machine code, where Numba is installed: one call for a single sample, and one for a batch.

That of a single sample takes the linear filter along: a call takes about as long as what is computed in it.

It computes what :mod:`observers.unscented` does, on the flow of :mod:`observers.flow` and for outputs C x with noise of
each its own. :mod:`observers.tracker_kernels` has the kernels.
"""

import functools

import numpy as np

from observers.filter import LinearFilter
from observers.flow import Flow
from observers.sparse import without_zeros
from observers.supervision import Supervision
from observers.tracker_kernels import kernels
from observers.unscented import Gaussian

_NONE = np.empty((0, 0))


class CompiledTracker:
    """A step of an unscented Kalman filter on a learned flow, whose states are scaled.

    Where a method takes a state, that is an array (n, width) in memory without gaps, which is written over. A row holds
    the estimate (nx), its covariance (nx^2), the running mean square of the innovations, that of their trend, the
    number of samples of which anything was there, and the trend itself (ny). A single sample has a state of one row.
    """

    def __init__(
        self,
        flow: Flow,
        linear: LinearFilter,
        C: np.ndarray,
        watch: Supervision,
        *,
        variances: tuple[np.ndarray, np.ndarray],
    ) -> None:
        network, (q, r) = flow.mlp.compiled, variances
        if network is None:
            raise ImportError("machine code needs Numba: pip install kkl-gym[fast]")
        bend = np.zeros(flow.nx) if flow.bend is None else flow.bend
        states = _packed(*flow.scaled_bounds, flow.gain, q, flow.x_offset, flow.x_scale, bend)
        watched = [watch.share, watch.trend_share, watch.trend_square_share, watch.trend_gain, watch.trend_limit]
        outputs = _packed(C @ flow.x_offset, r, np.tile(watched, (len(r), 1)), C * flow.x_scale)
        scale = 1.0 / np.array(flow.u_scale, dtype=float)
        self._nx, self._ny = flow.nx, len(C)
        used = tuple(map(tuple, (flow.polynomial != 0).tolist()))
        one, many, take = kernels(network.activation, flow.nu, len(C), flow.degree, used)
        polynomial = np.ascontiguousarray(flow.polynomial, dtype=float)
        gains, places, mixing = without_zeros(linear.transition, linear.drive)
        # A few arrays of all there is: each that is handed over takes as long as a hundred multiplications.
        numbers = np.concatenate([part.ravel() for part in (states, outputs, scale, polynomial, gains, mixing)])
        whole = np.array([len(network.widths), *network.widths, *places.ravel()])
        self._one = functools.partial(one, numbers, whole, network.packed)
        self._told = flow.nx + 2 * len(C) + linear.size
        self._many = functools.partial(many, states, outputs, scale, polynomial, network.packed, network.widths)
        self._take = functools.partial(take, states)

    def advance(
        self, state: np.ndarray, u: np.ndarray, y: np.ndarray, rows: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict a sample, and take it in; returns ``x`` (n, nx) and the outputs that were expected, (n, ny)."""
        x, expected = np.empty((len(y), self._nx)), np.empty((len(y), self._ny))
        self._many(u, y, np.ones(len(y), dtype=bool) if rows is None else rows, state, x, expected)
        return x, expected

    def single(
        self, state: np.ndarray, z: np.ndarray, y: np.ndarray, u: np.ndarray, y_next: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predict a single sample, take it in, and take the filter along; returns ``x``, ``y_next``, ``z_next``."""
        told, nx, ny = np.empty(self._told), self._nx, self._ny
        self._one(z, y, u, y_next, state, told)
        return told[:nx], told[nx + ny : nx + 2 * ny], told[nx + 2 * ny :]

    def take(
        self, said: Gaussian, lost: np.ndarray, where: np.ndarray, state: np.ndarray, x: np.ndarray | None
    ) -> None:
        """Take what T_inv says, where it is surer by the traces of both covariances or the tracker is lost."""
        self._take(*said, lost, where, state, _NONE if x is None else x)


def _packed(*columns: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.column_stack(columns))


__all__ = ["CompiledTracker"]
