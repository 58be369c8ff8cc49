"""An observer's step as machine code, where Numba is installed: its numbers, as the kernel orders them."""

import functools
from typing import Any

import numpy as np

from observers.artifact import Artifact
from observers.decoder import Decoder, Decoders
from observers.filter import LinearFilter
from observers.tracker import Tracker

_LANES = 8  # rows that are stepped together
MOST_OPERATIONS = 400  # of expressions; beyond, such as for a network as f, compiling takes many seconds


class CompiledStep:
    """The step of :class:`observers.kkl.KKL`, of rows of its state in place.

    Raises ImportError without Numba, and ValueError where an expression is too long to compile.
    """

    def __init__(self, artifact: Artifact, decoders: Decoders, tracker: Tracker | None) -> None:
        nx, ny, nu, linear = artifact.nx, artifact.ny, artifact.nu, artifact.filter
        motion = None if tracker is None else tracker.motion
        equations, flow = (None, None) if motion is None else (motion.equations, motion.flow)
        for expression in (None if equations is None else equations.field, artifact.h):
            if expression is not None and expression.operations > MOST_OPERATIONS:
                raise ValueError("the expression takes too long to compile")
        self._nothing = np.empty((1, 0, 0))
        driven, free = _of_map(decoders.driven, nx), _of_map(decoders.free or decoders.driven, nx)
        widest = max(driven[2], free[2], nx + nu)
        states, r, watched, limit = np.zeros((3, nx)), np.ones(ny), [0.0] * 7, 0.0
        if tracker is not None:
            watch = tracker.supervision
            states, r, limit = np.array([tracker.motion.low, tracker.motion.high, tracker.q]), tracker.r, watch.limit
            watched = [float(watch.window), watch.share, watch.trend_share, watch.trend_square_share]
            watched += [watch.trend_gain, watch.trend_limit, tracker.gate]
        scaling, of_flow, packed, shape = (
            np.zeros((4, nx + nu)),
            np.zeros((nx, 1)),
            np.zeros(0, np.float32),
            np.zeros(1, int),
        )
        if motion is not None and flow is not None:
            scaling[0, :nx], scaling[1, :nx], scaling[2, :nx] = motion.x_offset, motion.x_scale, flow.gain
            scaling[3, :nu], of_flow = 1.0 / flow.u_scale, flow.linear
            packed, shape = flow.mlp.packed()
            widest = max(widest, *shape[1:])
        self._equations, self._linear, self._h, self._sizes = equations, linear, artifact.h, (nx, ny, nu)
        self._flags, self._widest = (int(tracker is not None), int(artifact.knows_output), len(linear.A)), int(widest)
        self._seen = linear.size + ny + 1 + nx + nx**2 + 2  # where a row has the number of samples seen
        self._window, self._tracks_equations = watched[0], tracker is not None and equations is not None
        self._numbers = linear.dt, limit, *watched
        self._model = (
            states,
            r,
            np.zeros((ny, nx)) if artifact.C is None else np.array(artifact.C, dtype=float, order="C"),
        )
        self._networks = (
            (driven[0], free[0], driven[1], free[1]),
            (scaling, np.array(of_flow, order="C"), packed, shape),
        )
        self._usual, self._one, self._first = self._at(linear), self._code(1), np.zeros(1, int)

    @functools.cached_property
    def _many(self) -> tuple[Any, tuple[int, ...], Any]:
        return self._code(_LANES)

    def _code(self, W: int) -> tuple[Any, tuple[int, ...], Any]:
        """The kernel for W rows at once, and the motion and the output by their addresses."""
        from observers import kernel, kernel_functions

        nx, ny, nu = self._sizes
        move = measure = None
        if self._equations is not None:
            move = kernel_functions.motion(self._equations.field, nx, nu, W, not self._equations.substeps)
        if self._h is not None:
            measure = kernel_functions.output(self._h, nx, W)
        held = move, measure  # machine code is freed with the object that has its address
        return kernel.steps(nx, ny, nu, W), tuple(0 if each is None else each.address for each in held), held

    def _at(self, linear: LinearFilter) -> tuple[Any, ...]:
        """All that the kernel takes before rows and samples, at the sampling interval of a filter."""
        samples, h = linear.dt / self._linear.dt, 0.0
        substeps = -round(samples)  # of a flow
        if self._equations is not None:
            substeps = self._equations.steps(samples)
            h = linear.dt / substeps
        flags, numbers = (*self._flags, substeps, self._widest), (h, samples, *self._numbers)
        return flags, numbers, *self._model, _of_filter(linear.transition, linear.drive), *self._networks

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
        y, u = np.array(y, order="C"), np.array(u, order="C")  # Numba compiles anew for what is read-only
        usual = linear is None or linear is self._linear
        model = self._usual if linear is None or usual else self._at(linear)
        given = rows, y, u, self._nothing if record is None else record
        step, addresses, _ = self._one
        few = self._first if len(rows) == 1 else np.arange(len(rows))
        if len(rows) >= _LANES and self._tracks_equations:
            old = rows[:, self._seen] >= self._window
            few, many = few[~old], few[old]
            if len(many):
                self._many[0](self._many[1], *model, many, *given)
        if len(few):
            step(addresses, *model, few, *given)


def _of_map(decoder: Decoder, nx: int) -> tuple[Any, tuple[np.ndarray, np.ndarray], int]:
    """A map's network, its covariances by age, and its largest width."""
    error, network = decoder.error, decoder.network
    ages, table = np.zeros(1), np.zeros((1, nx * nx))
    if error is not None:
        ages, table = error.ages, np.ascontiguousarray(error.covariance.reshape(len(error.ages), -1))
    return network, (np.array(ages), table), int(max(*network[-1][1:], nx))


def _of_filter(transition: np.ndarray, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gains of z itself and of what drives it, and the few entries of the transition off its diagonal."""
    diagonal = transition.diagonal()
    places = np.array(np.nonzero(transition - np.diag(diagonal)))
    return np.vstack([diagonal, drive]), places, transition[*places]


__all__ = ["CompiledStep"]
