"""The compiled step of an observer that tracks. It needs Numba, and passes the observer's arrays to the kernel."""

import functools
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoder, Decoders
from observers.filter import LinearFilter
from observers.tracker import Tracker

_LANES = 8  # rows of the batch that the kernel steps together
MOST_OPERATIONS = 400  # in an expression; longer expressions, such as a network for f, take many seconds to compile
MOST_ROWS = 32  # of a covariance matrix; larger ones, for _LANES observers at once, would exceed a thread's stack


class CompiledStep:
    """The compiled step of :class:`observers.kkl.KKL` with a tracker; it changes rows of the state in place.

    It needs Numba. Raises ValueError if an expression is too long to compile, or a covariance too large.
    """

    def __init__(self, artifact: Artifact, decoders: Decoders, tracker: Tracker) -> None:
        motion, watch, linear = tracker.motion, tracker.supervision, artifact.filter
        nx, ny, nu = self._sizes = artifact.nx, artifact.ny, artifact.nu
        self._motion, self._linear, self._h = motion, linear, artifact.h
        expressions = None if motion.equations is None else motion.equations.field, artifact.h
        most = max(each.operations if each else 0 for each in expressions)
        if max(nx, ny) > MOST_ROWS or most > MOST_OPERATIONS:
            raise ValueError(f"too large to compile: {nx} states, {ny} outputs, {most} operations in an expression")
        maps = decoders.driven, decoders.free or decoders.driven
        scaling, affine = np.zeros((3, nx + nu)), np.zeros((nx, 1))
        network = np.zeros(0, np.float32), np.zeros(1, int)
        if (flow := motion.flow) is not None:
            scaling[0, :nx], scaling[1, :nx], scaling[2, :nx] = motion.x_offset, motion.x_scale, flow.gain
            scaling[1, nx:], affine, network = flow.u_scale, np.array(flow.linear, order="C"), flow.mlp.packed()
        widths = [width for *_, shape in (network, *(each.network for each in maps)) for width in shape[1:]]
        self._flags = len(linear.A), int(max(nx + nu, *widths))
        C = np.zeros((ny, nx)) if artifact.C is None else np.array(artifact.C, dtype=float, order="C")
        self._model = np.array([motion.low, motion.high, tracker.q]), tracker.r, C
        self._numbers = (
            *(linear.dt, watch.limit, float(watch.window), watch.share, watch.trend_share),
            *(watch.trend_square_share, watch.trend_gain, watch.trend_limit, tracker.gate),
        )
        self._parts = (*(each.network for each in maps), *_covariances(maps)), (scaling, affine, *network)
        self._usual, self._no_record = self._at(linear), np.empty((1, 0, 0))
        self._code = functools.cache(self._compiled)

    def _compiled(self, W: int) -> Any:
        """Return the kernel for groups of W rows, with the addresses of the compiled motion and output filled in."""
        from observers import kernel, kernel_functions

        (nx, ny, nu), equations, addresses = self._sizes, self._motion.equations, [0, 0]
        if equations is not None:
            move = kernel_functions.motion(equations.field, nx, nu, W, not equations.substeps)
            addresses[0] = move.address
        if self._h is not None:
            addresses[1] = kernel_functions.output(self._h, nx, W).address
        return functools.partial(kernel.steps(nx, ny, nu, W), tuple(addresses))

    def _at(self, linear: LinearFilter) -> tuple[Any, ...]:
        """Return the kernel's arguments from ``flags`` to ``flow``, for the sampling interval of a filter."""
        samples, h, equations = linear.dt / self._linear.dt, 0.0, self._motion.equations
        substeps = -round(samples)  # a negative number counts steps of a learned flow
        if equations is not None:
            substeps = equations.steps(samples)
            h = linear.dt / substeps
        return (*self._flags, substeps), (h, samples, *self._numbers), *self._model, _of_filter(linear), *self._parts

    def __call__(
        self, linear: LinearFilter, rows: np.ndarray, y: np.ndarray, u: np.ndarray, record: Any = None
    ) -> None:
        """Advance rows of the state in place by samples and inputs, at the sampling interval of ``linear``.

        The shape of ``record`` decides what it receives: rows (steps, n, width) or estimates (steps, n, nx).
        Shapes: ``rows`` (n, width), ``y`` (steps, n, ny), ``u`` (steps, n, nu).
        """
        # Numba would compile again for arrays that are read-only or not contiguous.
        y, u = (each if each.flags.carray else np.array(each, order="C") for each in (y, u))
        model = self._usual if linear is self._linear else self._at(linear)
        step = self._code(1 if len(rows) == 1 else _LANES)
        step(*model, rows, y, u, self._no_record if record is None else record)


def _covariances(maps: tuple[Decoder, Decoder]) -> tuple[np.ndarray, np.ndarray]:
    """Return ages in seconds since reset, and the covariances of both decoders at these ages, (2, ages, nx^2)."""
    errors = [each.error for each in maps if each.error is not None]  # both have a covariance if the observer tracks
    ages = np.unique([age for error in errors for age in error.ages])
    return ages, np.array([error(ages, ages.shape).reshape(len(ages), -1) for error in errors])


def _of_filter(linear: LinearFilter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition matrix's diagonal, stacked on ``drive``; places and values of its other nonzero entries."""
    diagonal = linear.transition.diagonal()
    places = np.array(np.nonzero(linear.transition - np.diag(diagonal)))
    return np.vstack([diagonal, linear.drive]), places, linear.transition[*places]
