"""A tracker's step as machine code, where Numba is installed: its numbers, as the kernel orders them."""

import functools
from typing import Any, cast

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoder, Decoders
from observers.filter import LinearFilter
from observers.tracker import Tracker

_LANES = 8  # rows that are stepped together
MOST_OPERATIONS = 400  # of expressions; beyond, such as for a network as f, compiling takes many seconds


class CompiledStep:
    """The step of :class:`observers.kkl.KKL` with a tracker, of rows of its state in place.

    Raises ImportError without Numba, and ValueError where an expression is too long to compile.
    """

    def __init__(self, artifact: Artifact, decoders: Decoders, tracker: Tracker) -> None:
        motion, watch, linear = tracker.motion, tracker.supervision, artifact.filter
        nx, ny, nu = self._sizes = artifact.nx, artifact.ny, artifact.nu
        self._motion, self._linear, self._h = motion, linear, artifact.h
        for expression in (None if motion.equations is None else motion.equations.field, artifact.h):
            if expression is not None and expression.operations > MOST_OPERATIONS:
                raise ValueError("the expression takes too long to compile")
        maps = [_of_map(each) for each in (decoders.driven, decoders.free or decoders.driven)]
        scaling, affine, network = (
            np.zeros((4, nx + nu)),
            np.zeros((nx, 1)),
            (np.zeros(0, np.float32), np.zeros(1, int)),
        )
        if (flow := motion.flow) is not None:
            scaling[0, :nx], scaling[1, :nx], scaling[2, :nx] = motion.x_offset, motion.x_scale, flow.gain
            scaling[3, :nu], affine, network = 1.0 / flow.u_scale, np.array(flow.linear, order="C"), flow.mlp.packed()
        widths = [width for *_, shape in (network, *(of for of, _ in maps)) for width in shape[1:]]
        self._flags = len(linear.A), int(max(nx + nu, *widths))
        C = np.zeros((ny, nx)) if artifact.C is None else np.array(artifact.C, dtype=float, order="C")
        self._model = np.array([motion.low, motion.high, tracker.q]), tracker.r, C
        self._numbers = (
            *(linear.dt, watch.limit, float(watch.window), watch.share, watch.trend_share),
            *(watch.trend_square_share, watch.trend_gain, watch.trend_limit, tracker.gate),
        )
        self._parts = tuple(of for each in zip(*maps, strict=True) for of in each), (scaling, affine, *network)
        self._window, self._seen = (
            watch.window,
            linear.size + ny + 1 + tracker.nis + 2,
        )  # where a row has the number of samples seen
        self._usual, self._first = self._at(linear), np.zeros(1, int)
        self._one, self._many = self._code(1), cast(Any, None)

    def _code(self, W: int) -> Any:
        """The kernel for W rows at once, with the addresses of the motion and of the output."""
        from observers import kernel, kernel_functions

        (nx, ny, nu), equations, addresses = self._sizes, self._motion.equations, [0, 0]
        if equations is not None:
            move = kernel_functions.motion(equations.field, nx, nu, W, not equations.substeps)
            addresses[0] = move.address
        if self._h is not None:
            addresses[1] = kernel_functions.output(self._h, nx, W).address
        return functools.partial(kernel.steps(nx, ny, nu, W), tuple(addresses))

    def _at(self, linear: LinearFilter) -> tuple[Any, ...]:
        """All that the kernel takes before rows and samples, at the sampling interval of a filter."""
        samples, h, equations = linear.dt / self._linear.dt, 0.0, self._motion.equations
        substeps = -round(samples)  # of a flow
        if equations is not None:
            substeps = equations.steps(samples)
            h = linear.dt / substeps
        of_filter = _of_filter(linear.transition, linear.drive)
        return (*self._flags, substeps), (h, samples, *self._numbers), *self._model, of_filter, *self._parts

    def __call__(
        self,
        rows: np.ndarray,
        y: np.ndarray,
        u: np.ndarray,
        record: np.ndarray | None = None,
        *,
        linear: LinearFilter | None = None,
    ) -> None:
        """Take samples and inputs into rows, which a record keeps at each sample.

        Shapes: ``rows`` (n, width), ``y`` (steps, n, ny), ``u`` (steps, n, nu), ``record`` (steps, n, width).
        """
        y, u = np.array(y, order="C"), np.array(u, order="C")  # Numba would compile again for read-only arrays
        model = self._usual if linear is None or linear is self._linear else self._at(linear)
        given = rows, y, u, np.empty((1, 0, 0)) if record is None else record
        few = self._first if len(rows) == 1 else np.arange(len(rows))
        if len(rows) >= _LANES and self._motion.equations is not None:
            if self._many is None:
                self._many = self._code(_LANES)
            settled = rows[:, self._seen] >= self._window
            few, many = few[~settled], few[settled]
            self._many(*model, many, *given)  # even of no rows: the first batch compiles both, and no later one waits
        self._one(*model, few, *given)


def _of_map(decoder: Decoder) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, np.ndarray]]:
    """A map's network, and its covariances by age."""
    error = decoder.error
    assert error is not None  # of a map that tracks
    return decoder.network, (np.array(error.ages), error.covariance.reshape(len(error.ages), -1).copy())


def _of_filter(transition: np.ndarray, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gains of z itself and of what drives it, and the few entries of the transition off its diagonal."""
    diagonal = transition.diagonal()
    places = np.array(np.nonzero(transition - np.diag(diagonal)))
    return np.vstack([diagonal, drive]), places, transition[*places]
