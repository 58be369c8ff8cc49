"""Where a state is a sample later, as it was learned, and how sure of that an observer may be."""

import functools
from dataclasses import dataclass

import numpy as np

from observers.checks import is_finite
from observers.errors import ArtifactError, check_shapes
from observers.factors import Factors
from observers.network import MLP
from observers.polynomial import degree_of, monomials

_MOST_TERMS = 1000
_LARGEST = 1e12  # of a window and of a level of noise, whose squares and quotients by dt then stay finite


@dataclass(frozen=True)
class Flow:
    """The system's motion over one sample, for observers that track (:class:`observers.tracker.Tracker`).

    Scaled states are s = (x - x_offset) / x_scale, and scaled inputs v = u / u_scale. A sample later

        s_next = s + polynomial @ m([s, v]) + gain * mlp([s, v]),

    where m are the monomials of scaled states and inputs up to a degree (:func:`observers.polynomial.monomials`). Of a
    motion that is nearly a polynomial, the network has little left to say.

    All variances below are of scaled states, or of outputs in their own units.

    Parameters
    ----------
    mlp : MLP
        The network, of nx + nu inputs and nx outputs.
    x_offset, x_scale : ndarray, shape (nx,)
        Scaling of the states.
    u_scale : ndarray, shape (nu,)
        Scaling of the inputs.
    gain : ndarray, shape (nx,)
        As above.
    polynomial : ndarray, shape (nx, terms)
        As above; how many terms there are says the degree.
    low, high : ndarray, shape (nx,)
        Bounds of the motion, in units of the states, at which estimates are cut.
    error : ndarray, shape (nx,)
        Standard deviation of what the flow itself is off by, at each sample.
    process_noise : ndarray, shape (nx,)
        Standard deviation of what process noise of level 1 adds at each sample.
    least_process_noise : float
        Level of process noise that is assumed at least: a tracker that trusts its model wholly stops to listen.
    least_measurement_noise : ndarray, shape (ny,)
        Standard deviations of measurement noise that are assumed at least.
    window : float
        Seconds over which innovations are averaged, and within which T_inv may say again where to begin.
    factors : Factors
        What covariances are multiplied with, so that regions of 90 % hold 90 % of the errors.
    free_factors : Factors, optional
        The same as long as no input has acted since reset; by default there is no difference.
    bend : ndarray, shape (nx,), optional
        What the flow is off by where the state moves far within a sample: standard deviation beside ``error``, in
        multiples of the squared distance of scaled states. By default no more than elsewhere.

    Raises
    ------
    ArtifactError
        If a shape does not fit the network, a scale is not positive, or a bound or variance makes no sense.
    """

    mlp: MLP
    x_offset: np.ndarray
    x_scale: np.ndarray
    u_scale: np.ndarray
    gain: np.ndarray
    polynomial: np.ndarray
    low: np.ndarray
    high: np.ndarray
    error: np.ndarray
    process_noise: np.ndarray
    least_process_noise: float
    least_measurement_noise: np.ndarray
    window: float
    factors: Factors
    free_factors: Factors | None = None
    bend: np.ndarray | None = None

    def __post_init__(self) -> None:
        nx, nu = self.nx, self.nu
        if self.u_scale.ndim != 1 or nx + nu != self.mlp.inputs:
            raise ArtifactError(f"a flow of {nx} states and {nu} inputs needs as many of its network's inputs")
        of_states = ("x_offset", "x_scale", "gain", "low", "high", "error", "process_noise")
        check_shapes(self, dict.fromkeys((*of_states, *(() if self.bend is None else ("bend",))), (nx,)))
        shape = self.polynomial.shape
        if len(shape) != 2 or shape[0] != nx or shape[1] > _MOST_TERMS or not degree_of(shape[1], nx + nu):
            raise ArtifactError(
                f"the polynomial of a flow has shape {shape}, which is of no degree for {nx} states and {nu} inputs, "
                f"or has more than {_MOST_TERMS} terms"
            )
        if self.least_measurement_noise.ndim != 1:
            raise ArtifactError("least_measurement_noise must have shape (ny,)")
        for name in ("x_scale", "u_scale", "least_measurement_noise"):
            if not (getattr(self, name) > 0).all():
                raise ArtifactError(f"{name} of a flow must be positive, got {getattr(self, name)}")
        for name in ("error", "process_noise", "bend"):
            value = getattr(self, name)
            if value is not None and not (value >= 0).all():
                raise ArtifactError(f"{name} of a flow must not be negative, got {value}")
        if not (self.low < self.high).all():
            raise ArtifactError(f"bounds of a flow must go from low to high, got {self.low} and {self.high}")
        for name in ("least_process_noise", "window"):
            value = getattr(self, name)
            if not is_finite(value) or not 0 < value <= _LARGEST:
                raise ArtifactError(f"{name} of a flow must be positive and at most {_LARGEST:g}, got {value!r}")

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.mlp.outputs

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.u_scale)

    @property
    def scaled_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of scaled states, (nx,) each."""
        return (self.low - self.x_offset) / self.x_scale, (self.high - self.x_offset) / self.x_scale

    @functools.cached_property
    def degree(self) -> int:
        """Degree of the polynomial."""
        return degree_of(self.polynomial.shape[1], self.nx + self.nu) or 0

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Evaluate. Shapes: ``x`` (..., nx), ``u`` (..., nu); returns (..., nx)."""
        return self.x_offset + self.x_scale * self.scaled((x - self.x_offset) / self.x_scale, u / self.u_scale)

    def scaled(self, s: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The same of scaled states (..., nx) and scaled inputs (..., nu), which may be the same for many of them."""
        inputs = np.empty((*s.shape[:-1], s.shape[-1] + v.shape[-1]))
        inputs[..., : s.shape[-1]], inputs[..., s.shape[-1] :] = s, v
        change = monomials(inputs, self.degree) @ self.polynomial.T
        change += self.gain * self.mlp(inputs)
        return np.asarray(s + change)

    def variances(
        self, measurement_noise: float | tuple[float, ...], process_noise: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Variances that are assumed at levels of noise.

        Parameters
        ----------
        measurement_noise : float or tuple of float, length ny
            Standard deviations, of all outputs or each.
        process_noise : float
            Level in multiples of the system's scale per second.

        Returns
        -------
        Q : ndarray, shape (nx,)
            Of what is added to scaled states at each sample.
        R : ndarray, shape (ny,)
            Of the noise on each output.
        """
        level = max(process_noise, self.least_process_noise)
        return (
            (level * self.process_noise) ** 2 + self.error**2,
            np.maximum(measurement_noise, self.least_measurement_noise) ** 2,
        )


__all__ = ["Flow"]
