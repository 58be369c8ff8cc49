"""An observer's whole step as a module of Torch."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from observers import Artifact, KKLObserver
from observers.inverse import FEATURES, InverseMap
from training.export.exported import output_expression
from training.export.torch_parts import Module, Network, TorchExpression, between
from training.export.torch_tracker import TorchTracker


class TorchObserver(Module):
    """An observer's step as a module of Torch: batched, differentiable, on any device.

    The caller keeps the state: ``state, x_hat = observer(state, y, u)`` does for n rows what
    :meth:`observers.KKLObserver.step` does, without monitor, gate, delay and known initial states. A state row of zeros
    marks a start: the next sample is the first, in which no output may be missing. :meth:`start` returns such rows, and
    ``state * ~done[:, None]`` restarts the rows of finished episodes. In later samples, NaN marks missing outputs.

    The whole step is differentiable, also with respect to the weights. The filter's state and the tracker's covariance
    are float64 whatever ``dtype`` is. ``observer.float()`` would make them float32, and T_inv's estimates inaccurate.

    Parameters
    ----------
    artifact : Artifact
        The observer.
    measurement_noise : float or sequence of float, optional
        Standard deviation of the noise on y, as for :class:`observers.KKLObserver`.
    process_noise : float, optional
        Level of the process noise, as for :class:`observers.KKLObserver`.
    tracking : bool, optional
        Whether to track, as for :class:`observers.KKLObserver`.
    dtype : torch.dtype, default torch.float32
        Type of the networks and of the estimates: float32 (as the networks of KKLObserver) or float64.

    Raises
    ------
    ValueError
        If an argument is invalid, as for :class:`observers.KKLObserver`, or ``dtype`` is neither float32 nor float64.

    Examples
    --------
    >>> import torch
    >>> import observers
    >>> from training import TorchObserver
    >>> observer = TorchObserver(observers.load("lorenz").artifact)
    >>> state, x_hat = observer(observer.start(1024), torch.zeros(1024, 1))
    >>> x_hat.shape
    torch.Size([1024, 3])
    """

    def __init__(
        self,
        artifact: Artifact,
        measurement_noise: float | Sequence[float] | None = None,
        *,
        process_noise: float | None = None,
        tracking: bool | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype!r}")
        checked = KKLObserver(artifact, measurement_noise, process_noise=process_noise, tracking=tracking)
        super().__init__()
        linear, inverse, h = artifact.filter, artifact.inverse, output_expression(artifact)
        self.nx, self.nu, self.ny, self.nz, self.dt = artifact.nx, artifact.nu, artifact.ny, len(linear.A), linear.dt
        self.h = None if h is None else TorchExpression(h.components)
        self.driven = TorchMap(inverse, dtype)
        self.free = None if artifact.free_inverse is None else TorchMap(artifact.free_inverse, dtype)
        self.tracker = TorchTracker(artifact, dtype) if checked.tracking else None
        self.widths = [1, self.ny, linear.size, self.tracker.width if self.tracker else len(inverse.x_offset)]
        level = np.broadcast_to(checked.measurement_noise, self.ny if inverse.noise_gain.ndim == 2 else 1)
        self.put(update=np.vstack([linear.transition.T, linear.drive]), equilibrium=linear.equilibrium.T)
        self.put(measurement_noise=level[None], process_noise=np.array([[checked.process_noise]]))

    def start(self, n: int) -> Tensor:
        """Return the state of n rows before their first sample: zeros, (n, width)."""
        return self.update.new_zeros(n, sum(self.widths))

    def estimate(self, state: Tensor) -> Tensor:
        """Return the estimates at states (n, width): in each row x_hat, then the estimated parameters, if any."""
        x = torch.split(state, self.widths, 1)[3]
        if self.tracker is not None:
            x = self.tracker.states(x[:, : self.nx].T).T
        return x.to(self.driven.network.layers[0].weight.dtype)

    def covariance(
        self, state: Tensor, measurement_noise: Tensor | None = None, process_noise: Tensor | None = None
    ) -> Tensor:
        """Return the calibrated covariances of the estimates' errors, as in :attr:`observers.KKLObserver.covariance`.

        Parameters
        ----------
        state : Tensor, shape (n, width)
            States that a step returned.
        measurement_noise, process_noise : Tensor, optional
            The noise levels of that step, as for :meth:`forward`.

        Returns
        -------
        Tensor, shape (n, nx, nx)
            The covariances.
        """
        samples, _, z, rest = torch.split(state, self.widths, 1)
        age, (level, process_level) = (samples - 1.0) * self.dt, self._levels(measurement_noise, process_noise)
        if self.tracker is None:
            P = self._of_map(z, TorchMap.covariance, age, level).expand(z.shape[0], -1)
        else:
            shares = self.driven.share(level), process_level / self.driven.process_noise_max
            P = self.tracker.covariance(rest.T, age, *shares)
        return P.reshape(-1, self.nx, self.nx)

    def forward(
        self,
        state: Tensor,
        y: Tensor,
        u: Tensor | None = None,
        measurement_noise: Tensor | None = None,
        process_noise: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Process the next sample.

        Parameters
        ----------
        state : Tensor, shape (n, width)
            The state that the last step returned, or :meth:`start`.
        y : Tensor, shape (n, ny)
            The samples, NaN where missing.
        u : Tensor, shape (n, nu), optional
            The inputs held since the previous samples, by default zero.
        measurement_noise, process_noise : Tensor, shapes (n or 1, 1 or ny) and (n or 1, 1), optional
            Noise levels of each row, by default the observer's. Measurement noise has one level, or one for each output
            if T_inv takes several.

        Returns
        -------
        state : Tensor, shape (n, width)
            The next state.
        x_hat : Tensor, shape (n, nx) or, with estimated parameters, (n, nx + their number)
            The estimates, followed by the estimated parameters, if any.
        """
        begins = state[:, :1] == 0
        samples, before, z, rest = torch.split(torch.where(begins, 0.0, state), self.widths, 1)
        u = (y.new_zeros(y.shape[0], self.nu) if u is None else u[:, : self.nu]).to(state.dtype)
        y, age, levels = y.to(state.dtype), samples * self.dt, self._levels(measurement_noise, process_noise)

        def filled(h: Tensor) -> Tensor:
            return torch.where(y.isnan() & ~begins, torch.where(h.isfinite(), h, before), y)

        def filtered(y: Tensor) -> Tensor:
            return torch.where(begins, y @ self.equilibrium, torch.cat([z, before, u, y], 1) @ self.update)

        if self.tracker is not None:
            tracked, expected = self.tracker.advance(rest.T, y.T, u.T, begins[:, 0], levels[0].T, levels[1].T)
            y = filled(expected.T)
        elif self.h is not None:  # fill gaps by h at the last estimate, then more exactly by h at T_inv(z)
            guess = filtered(filled(self.h(rest.T).T))
            y = filled(self.h(self._of_map(guess, TorchMap.__call__, age, *levels).T).T)
        else:
            y = filled(before)
        z = filtered(y)
        rest = self._of_map(z, TorchMap.__call__, age, *levels)
        if self.tracker is not None:
            rest = self.tracker.supervise(
                tracked, rest.T, lambda age: self._of_map(z, TorchMap.covariance, age, levels[0]).T
            ).T
        state = torch.cat([samples + 1.0, y, z, rest], 1)
        return state, self.estimate(state)

    def _levels(self, measurement_noise: Tensor | None, process_noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return noise levels, by default the observer's, with measurement noise limited to the largest in training."""
        level = self.measurement_noise if measurement_noise is None else measurement_noise.to(self.update.dtype)
        process_level = self.process_noise if process_noise is None else process_noise.to(self.update.dtype)
        return torch.minimum(level, self.driven.measurement_noise_max), process_level

    def _of_map(self, z: Tensor, method: Callable[..., Tensor], *arguments: Tensor) -> Tensor:
        """Call ``method`` of the map ``free`` in rows without an input so far, of the map ``driven`` in the others."""
        driven = method(self.driven, z, *arguments)
        if self.free is None:
            return driven
        return torch.where((z[:, self.nz :] == 0).all(1, True), method(self.free, z[:, : self.nz], *arguments), driven)


class TorchMap(Module):
    """T_inv and the covariance of its error, for a batch of n rows."""

    def __init__(self, inverse: InverseMap, dtype: torch.dtype) -> None:
        super().__init__()
        self.features, self.network = inverse.features, Network(inverse.mlp, dtype)
        self.put(whiten=inverse.whiten.T, offset=inverse.z_offset @ inverse.whiten.T, x_offset=inverse.x_offset)
        self.put(x_scale=inverse.x_scale, squared_gain=np.atleast_2d(inverse.noise_gain) ** 2)
        for name in (f"{condition}_{end}" for condition in FEATURES[2:] for end in ("unit", "max")):
            self.put(**{name: np.atleast_1d(getattr(inverse, name))})
        if "measurement_noise" not in inverse.features:
            self.put(measurement_noise_max=np.array([np.inf]))
        if (error := inverse.error_covariance) is not None:
            table = error.covariance.reshape(len(error.levels), -1)
            self.put(levels=error.levels, ages=error.ages, error=table)

    def forward(self, z: Tensor, age: Tensor, level: Tensor, process_level: Tensor) -> Tensor:
        """Return the estimates of T_inv from filter states (n, size) at ages (n, 1) in seconds."""
        inputs = [(z @ self.whiten - self.offset) / (1.0 + level**2 @ self.squared_gain)]
        for name, value in zip(FEATURES[2:], (level, process_level, age), strict=True):
            if name in self.features:
                value = torch.minimum(value, getattr(self, f"{name}_max"))
                inputs.append(torch.log1p(value / getattr(self, f"{name}_unit")).expand(z.shape[0], -1))
        return self.x_offset + self.x_scale * self.network(torch.cat(inputs, 1))

    def share(self, level: Tensor) -> Tensor:
        """Return the noisiest output's measurement noise (n, 1), in multiples of its largest level in training."""
        return (level / self.measurement_noise_max).amax(1, keepdim=True)

    def covariance(self, _: Tensor, age: Tensor, level: Tensor) -> Tensor:
        """Return the covariances (n, nx^2) of T_inv's errors at ages (n, 1) in seconds."""
        by_age = between(self.share(level), self.levels, self.error)
        return between(age, self.ages, by_age.reshape(by_age.shape[0], len(self.ages), -1))
