"""Models of a state's motion over a sampling interval: a system's equations, or a learned flow."""

import math
from dataclasses import dataclass, field

import numpy as np

from observers.checks import ArtifactError, check_shapes, is_finite
from observers.expression import Expression
from observers.factors import Factors, check_positive_definite
from observers.network import MLP

_MAX_LEVEL = 1e30  # largest least_process_noise, and largest window in s, so that squares are finite
_MAX_SUBSTEPS = 1024  # largest number of Runge-Kutta steps in a sampling interval


@dataclass(frozen=True)
class Equations:
    """Motion by equations: x' = f(x) + g(x) u under held u, or x_next = field(x, u) in discrete time.

    Parameters
    ----------
    field : Expression
        f(x) + g(x) u, or the next state in discrete time; nx components.
    substeps : int, default 1
        Fourth-order Runge-Kutta steps in an interval, at most 1024 (else ArtifactError). 0: a system in discrete time.
    """

    field: Expression
    substeps: int = 1

    def __post_init__(self) -> None:
        if type(self.substeps) is not int or not 0 <= self.substeps <= _MAX_SUBSTEPS:
            raise ArtifactError(f"substeps must be an integer from 0 to {_MAX_SUBSTEPS}, got {self.substeps!r}")

    def __call__(self, x: np.ndarray, u: np.ndarray, dt: float, samples: float = 1.0) -> np.ndarray:
        """Return the states after ``samples * dt``. Shapes: ``x`` (..., nx), ``u`` (..., nu); returns (..., nx)."""
        f, substeps = self.field, self.steps(samples)
        if not self.substeps:
            for _ in range(substeps):
                x = f(x, u)
            return x
        h = samples * dt / substeps
        for _ in range(substeps):
            k1 = f(x, u)
            k2 = f(x + h / 2 * k1, u)
            k3 = f(x + h / 2 * k2, u)
            k4 = f(x + h * k3, u)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return x

    def steps(self, samples: float) -> int:
        """Return the number of Runge-Kutta steps, or of steps in discrete time, in ``samples`` sampling intervals."""
        return round(samples) if not self.substeps else max(1, math.ceil(self.substeps * samples - 1e-9))


@dataclass(frozen=True)
class Flow:
    """A learned step of scaled states s under scaled inputs v: s + linear @ [1, s, v] + gain * mlp([s, v]).

    Parameters
    ----------
    mlp : MLP
        A network with nx + nu inputs and nx outputs. Raises ArtifactError if the other arrays do not fit it.
    linear : ndarray, shape (nx, 1 + nx + nu)
        The affine part.
    gain : ndarray, shape (nx,)
        Scale of the network's outputs.
    u_scale : ndarray, shape (nu,)
        Scale of the inputs, positive: v = u / u_scale.
    """

    mlp: MLP
    linear: np.ndarray
    gain: np.ndarray
    u_scale: np.ndarray

    def __post_init__(self) -> None:
        nx = self.mlp.outputs
        if self.mlp.inputs < nx:
            raise ArtifactError(f"a flow's network must have at least {nx} inputs, got {self.mlp.inputs}")
        check_shapes(self, {"linear": (nx, 1 + self.mlp.inputs), "gain": (nx,), "u_scale": (self.mlp.inputs - nx,)})
        if not (self.u_scale > 0).all():
            raise ArtifactError(f"u_scale of a flow must be positive, got {self.u_scale}")

    def __call__(self, s: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the scaled states one sample later. Shapes: ``s`` (..., nx), ``u`` (..., nu); returns (..., nx)."""
        q = np.concatenate([s, np.broadcast_to(u / self.u_scale, (*s.shape[:-1], len(self.u_scale)))], -1)
        return np.asarray(s + self.linear[:, 0] + q @ self.linear[:, 1:].T + self.gain * self.mlp(q))


@dataclass(frozen=True)
class Motion:
    """The model by which a tracker predicts: the motion of the states, its uncertainty and its calibration.

    Scaled states are s = (x - x_offset) / x_scale. Standard deviations of states refer to scaled states, and standard
    deviations of outputs are in the outputs' units. Raises ArtifactError if the parts do not fit each other.

    Parameters
    ----------
    equations : Equations, optional
        The system's equations, in units of the states.
    flow : Flow, optional
        A learned step. A motion has either equations or a flow.
    x_offset, x_scale : ndarray, shape (nx,)
        Scaling of the states; scales are positive.
    low, high : ndarray, shape (nx,)
        Bounds of the states, to which estimates are limited.
    mean : ndarray, shape (nx,)
        Mean of the initial states in training: the estimate before the first sample.
    covariance : ndarray, shape (nx, nx)
        Covariance of the initial states in training, in units of the states.
    error : ndarray, shape (nx,)
        Standard deviation of the model's error over one sample.
    process_noise : ndarray, shape (nx,)
        Standard deviation that process noise of level 1 adds over one sample.
    least_process_noise : float
        Lower bound of the assumed level of process noise: with Q = 0 the gain would vanish.
    least_measurement_noise : ndarray, shape (ny,)
        Lower bounds of the assumed standard deviations of the measurement noise.
    window : float
        Seconds over which innovations are averaged. For this time after a reset, T_inv's estimate may replace the
        tracker's even without a divergence.
    factors : Factors, optional
        Calibration factors of the Kalman filter's covariance.
    """

    x_offset: np.ndarray
    x_scale: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    error: np.ndarray
    process_noise: np.ndarray
    least_process_noise: float
    least_measurement_noise: np.ndarray
    window: float
    factors: Factors = field(default_factory=Factors.ones)
    equations: Equations | None = None
    flow: Flow | None = None

    def __post_init__(self) -> None:
        nx = len(self.x_offset) if self.x_offset.ndim == 1 else 0
        if (self.equations is None) == (self.flow is None):
            raise ArtifactError("a Motion needs either equations or a flow")
        field = None if self.equations is None else self.equations.field
        fits = self.flow is not None if field is None else len(field.components) == nx and field.states <= nx
        if not nx or not fits or (self.flow is not None and self.flow.mlp.outputs != nx):
            raise ArtifactError(f"a Motion of {nx} states does not fit its equations or its flow")
        check_shapes(self, dict.fromkeys(("x_scale", "low", "high", "mean", "error", "process_noise"), (nx,)))
        check_shapes(self, {"covariance": (nx, nx)})
        if self.least_measurement_noise.ndim != 1:
            raise ArtifactError(f"least_measurement_noise must be (ny,), got {self.least_measurement_noise.shape}")
        for name in ("x_scale", "least_measurement_noise"):
            if not (getattr(self, name) > 0).all():
                raise ArtifactError(f"{name} of a Motion must be positive, got {getattr(self, name)}")
        for name in ("error", "process_noise"):
            if not (getattr(self, name) >= 0).all():
                raise ArtifactError(f"{name} of a Motion must not be negative, got {getattr(self, name)}")
        check_positive_definite(self.covariance)
        if not (self.low < self.high).all():
            raise ArtifactError(f"bounds of a Motion must go from low to high, got {self.low} and {self.high}")
        for name in ("least_process_noise", "window"):
            value = getattr(self, name)
            if not is_finite(value) or not 0 < value <= _MAX_LEVEL:
                raise ArtifactError(f"{name} of a Motion must be positive and at most {_MAX_LEVEL:g}, got {value!r}")

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.x_offset)

    def fits_inputs(self, nu: int) -> bool:
        """Whether the motion takes ``nu`` inputs."""
        if self.flow is not None:
            return len(self.flow.u_scale) == nu
        assert self.equations is not None
        return self.equations.field.inputs <= nu

    def step(self, x: np.ndarray, u: np.ndarray, dt: float, samples: float = 1.0) -> np.ndarray:
        """Return the states after ``samples * dt``. Shapes: ``x`` (..., nx), ``u`` (..., nu); returns (..., nx)."""
        if self.equations is not None:
            return self.equations(x, u, dt, samples)
        assert self.flow is not None
        s = (x - self.x_offset) / self.x_scale
        for _ in range(round(samples)):
            s = self.flow(s, u)
        return self.x_offset + self.x_scale * s

    def check_samples(self, samples: float) -> None:
        """Raise ValueError if the motion cannot predict over ``samples`` sampling intervals."""
        continuous = self.equations is not None and self.equations.substeps
        # A tolerance, because clocks jitter and floats resolve seconds since 1970 only to 2e-7 s.
        if not continuous and abs(samples - max(1, round(samples))) > 1e-3:
            what = "a learned flow" if self.flow is not None else "a Motion in discrete time"
            raise ValueError(
                f"{what} predicts over whole sampling intervals, got a dt of {samples:g} intervals; pass a whole "
                "multiple of the interval, or tracking=False"
            )

    def variances(
        self, measurement_noise: float | tuple[float, ...], process_noise: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the assumed variances at noise levels: the diagonals of Q (nx,), for scaled states, and R (ny,)."""
        level = max(process_noise, self.least_process_noise)
        return (
            (level * self.process_noise) ** 2 + self.error**2,
            np.maximum(measurement_noise, self.least_measurement_noise) ** 2,
        )
