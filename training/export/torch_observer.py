"""An observer's whole step as a module of Torch."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from observers import Artifact, KKLObserver
from observers.inverse import InverseMap
from training.export.torch_parts import Module, Network, between, evaluated
from training.export.torch_tracker import TorchTracker


class TorchObserver(Module):
    """An observer's step as a module of Torch: batched, differentiable, on any device.

    The state is explicit: ``state, x_hat = observer(state, y, u)`` does for n rows what
    :meth:`observers.KKLObserver.step` does. A row of zeros has seen nothing, and begins with the sample that it is
    given: :meth:`start` returns such rows, and ``state * ~done[:, None]`` restarts some. A NaN in ``y`` is a missing
    sample; only the first of a row must be whole. There is no monitor and no known start.

    Every row takes the same way through the step: T_inv and the relinearised steps of the first window are evaluated
    for all rows, and each takes what it needs. So nothing waits for the device, and ``torch.compile`` and
    ``torch.onnx.export`` see one graph. Gradients lead through filter, T_inv and tracker, to the weights as well;
    ``requires_grad_(False)`` freezes these.

    The filter's state and the tracker's covariance are float64 whatever ``dtype`` is: the filter's modes are nearly
    dependent. ``observer.float()`` makes all of it float32, for devices without float64. T_inv's estimates are then
    inaccurate.

    Parameters
    ----------
    artifact : Artifact
        The observer.
    measurement_noise : float or sequence of float, length ny, optional
        Standard deviation of the noise on each sample, as for :class:`observers.KKLObserver`.
    process_noise : float, optional
        Level of process noise, likewise.
    tracking : bool, optional
        Whether to track, likewise.
    dtype : torch.dtype, default torch.float32
        Type of the networks and of the estimates; float32 as in NumPy, or float64.

    Raises
    ------
    ValueError
        If an argument is invalid, as for :class:`observers.KKLObserver`, or ``dtype`` is not one of the two.

    Examples
    --------
    >>> import torch
    >>> import observers
    >>> from training import TorchObserver
    >>> observer = TorchObserver(observers.load("lorenz").artifact)
    >>> state, x_hat = observer(observer.start(1024), torch.zeros(1024, 1))
    >>> state, x_hat = observer(state, torch.full((1024, 1), 0.1), u=torch.zeros(1024, 1))
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
        linear, self.nx, self.nu, self.ny = artifact.filter, artifact.nx, artifact.nu, artifact.ny
        self.dt, self.nz = linear.dt, len(linear.A)
        self.driven = TorchMap(artifact.inverse, dtype)
        self.free = None if artifact.free_inverse is None else TorchMap(artifact.free_inverse, dtype)
        self.tracker = TorchTracker(artifact, dtype) if checked.tracking else None
        rest = len(artifact.inverse.x_offset) if self.tracker is None else self.tracker.width
        self.widths = [1, self.ny, linear.size, rest]
        self.h, several = artifact.h, artifact.inverse.noise_gain.ndim == 2
        level = np.broadcast_to(checked.measurement_noise, self.ny if several else 1)
        self.put(update=np.vstack([linear.transition.T, linear.drive]), equilibrium=linear.equilibrium.T)
        self.put(measurement_noise=np.reshape(level, (1, -1)), process_noise=np.reshape(checked.process_noise, (1, 1)))
        self.put(**({} if artifact.C is None else {"C": artifact.C.T}))

    def start(self, n: int) -> Tensor:
        """Return the state of n rows that have seen nothing: zeros, (n, width)."""
        return self.update.new_zeros(n, sum(self.widths))

    def estimate(self, state: Tensor) -> Tensor:
        """Return the estimates of states (n, width): (n, nx), with estimated parameters behind them."""
        x = torch.split(state, self.widths, 1)[3]
        if self.tracker is not None:
            x = self.tracker.states(x[:, : self.nx].T).T
        return x.to(self.driven.network.weights[0].dtype)

    def covariance(
        self, state: Tensor, measurement_noise: Tensor | None = None, process_noise: Tensor | None = None
    ) -> Tensor:
        """Return the calibrated covariances of the estimates' errors, as :attr:`observers.KKLObserver.covariance`.

        Parameters
        ----------
        state : Tensor, shape (n, width)
            States that a step has returned.
        measurement_noise, process_noise : Tensor, optional
            The levels of that step.

        Returns
        -------
        Tensor, shape (n, nx, nx)
            The covariances.
        """
        samples, _, z, rest = torch.split(state, self.widths, 1)
        age, (levels, process_noise) = (samples - 1.0) * self.dt, self._levels(measurement_noise, process_noise)
        if self.tracker is None:
            P = self._of_map(z, [each.covariance(age, levels) for each in self._maps]).expand(z.shape[0], -1)
        else:
            shares = self.driven.share(levels), process_noise / self.driven.process_noise_max
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
        """Take in the next sample.

        Parameters
        ----------
        state : Tensor, shape (n, width)
            What the last step returned, or :meth:`start`.
        y : Tensor, shape (n, ny)
            The samples, NaN where missing.
        u : Tensor, shape (n, nu), optional
            The inputs held since the samples before, by default zero.
        measurement_noise : Tensor, shape (n or 1, 1 or ny), optional
            Levels for each row in place of those of the observer: one, or one for each output if T_inv takes several.
        process_noise : Tensor, shape (n or 1, 1), optional
            Likewise.

        Returns
        -------
        state : Tensor, shape (n, width)
            The next state.
        x_hat : Tensor, shape (n, nx)
            The estimates, and behind the states estimated parameters.
        """
        begins = state[:, :1] == 0
        samples, before, z, rest = torch.split(torch.where(begins, 0.0, state), self.widths, 1)
        y, u = y.to(state.dtype), y.new_zeros(y.shape[0], self.nu) if u is None else u
        u, missing, age = u[:, : self.nu].to(state.dtype), y.isnan(), samples * self.dt
        levels = self._levels(measurement_noise, process_noise)
        if self.tracker is None:
            whole = self._filled(rest, y, before, missing)
            if self.h is not None or hasattr(self, "C"):  # once more, from T_inv of what the guess leads to
                x = self._inverted(self._filtered(z, before, u, whole, begins), age, *levels)
                whole = self._filled(x, y, before, missing)
        else:
            tracked, h = self.tracker.advance(rest.T, y.T, u.T, begins[:, 0], levels[0].T, levels[1].T)
            whole = torch.where(missing & ~begins, torch.where(h.T.isfinite(), h.T, before), y)
        z = self._filtered(z, before, u, whole, begins)
        rest = self._inverted(z, age, *levels)
        if self.tracker is not None:
            learned = tracked.seen.clamp(max=self.tracker.window)[:, None] * self.dt  # so much z knows for certain
            P = self._of_map(z, [each.covariance(learned, levels[0]) for each in self._maps])
            rest = self.tracker.supervise(tracked, rest.T, P.T).T
        state = torch.cat([samples + 1.0, whole, z, rest], 1)
        return state, self.estimate(state)

    @property
    def _maps(self) -> list["TorchMap"]:
        return [self.driven] if self.free is None else [self.driven, self.free]

    def _levels(self, measurement_noise: Tensor | None, process_noise: Tensor | None) -> tuple[Tensor, Tensor]:
        """Levels of noise, those of the observer where none are given; the first is cut at the largest in training."""
        levels = self.measurement_noise if measurement_noise is None else measurement_noise.to(self.update.dtype)
        process_noise = self.process_noise if process_noise is None else process_noise.to(self.update.dtype)
        return torch.minimum(levels, self.driven.measurement_noise_max), process_noise

    def _filtered(self, z: Tensor, y: Tensor, u: Tensor, y_next: Tensor, begins: Tensor) -> Tensor:
        """The filter's next state, (n, size)."""
        return torch.where(begins, y_next @ self.equilibrium, torch.cat([z, y, u, y_next], 1) @ self.update)

    def _filled(self, x: Tensor, y: Tensor, before: Tensor, missing: Tensor) -> Tensor:
        """Samples, and h(x) where these are missing; the samples before where h is unknown or undefined."""
        if self.h is None:
            h = x[:, : self.nx] @ self.C if hasattr(self, "C") else before
        else:
            h = evaluated(self.h, x=x.unbind(1)).T
        return torch.where(missing, torch.where(h.isfinite(), h, before), y)

    def _inverted(self, z: Tensor, age: Tensor, measurement_noise: Tensor, process_noise: Tensor) -> Tensor:
        """T_inv(z), (n, nx)."""
        free = z[:, : self.nz] if self.free is not None else z
        each = [m(z_of, age, measurement_noise, process_noise) for m, z_of in zip(self._maps, (z, free), strict=False)]
        return self._of_map(z, each)

    def _of_map(self, z: Tensor, values: list[Tensor]) -> Tensor:
        """In each row the value of the map that it is for: that of free motion until an input has acted."""
        driven, *free = values
        return torch.where((z[:, self.nz :] == 0).all(1, keepdim=True), free[0], driven) if free else driven


class TorchMap(Module):
    """T_inv, and the covariance of its error: rows (n, .)."""

    def __init__(self, inverse: InverseMap, dtype: torch.dtype) -> None:
        super().__init__()
        self.features, self.network = inverse.features, Network(inverse.mlp, dtype)
        self.process_noise_unit, self.process_noise_max = inverse.process_noise_unit, inverse.process_noise_max
        self.age_unit, self.age_max = inverse.age_unit, inverse.age_max
        takes_level = "measurement_noise" in inverse.features
        self.put(
            whiten=inverse.whiten.T,
            offset=inverse.z_offset @ inverse.whiten.T,
            squared_gain=np.atleast_2d(inverse.noise_gain) ** 2,
            measurement_noise_unit=np.atleast_1d(inverse.measurement_noise_unit),
            measurement_noise_max=np.atleast_1d(inverse.measurement_noise_max if takes_level else np.inf),
            x_offset=inverse.x_offset,
            x_scale=inverse.x_scale,
        )
        if (error := inverse.error_covariance) is not None:
            table = error.covariance.reshape(len(error.levels), -1)
            self.put(levels=error.levels, ages=error.ages, error=table)

    def forward(self, z: Tensor, age: Tensor, measurement_noise: Tensor, process_noise: Tensor) -> Tensor:
        """The estimates (n, nx), of filter states (n, size) at ages (n, 1) in seconds."""
        modes = (z @ self.whiten - self.offset) / (1.0 + measurement_noise**2 @ self.squared_gain)
        inputs = [modes]
        if "measurement_noise" in self.features:
            inputs.append(torch.log1p(measurement_noise / self.measurement_noise_unit))
        if "process_noise" in self.features:
            inputs.append(torch.log1p(process_noise.clamp(max=self.process_noise_max) / self.process_noise_unit))
        if "age" in self.features:
            inputs.append(torch.log1p(age.clamp(max=self.age_max) / self.age_unit))
        return self.x_offset + self.x_scale * self.network(torch.cat([one.expand(z.shape[0], -1) for one in inputs], 1))

    def share(self, measurement_noise: Tensor) -> Tensor:
        """Levels (n, 1) in multiples of the largest in training, of the noisiest output."""
        return (measurement_noise / self.measurement_noise_max).amax(1, keepdim=True)

    def covariance(self, age: Tensor, measurement_noise: Tensor) -> Tensor:
        """The covariances of its error, (n, nx^2), at ages (n, 1) in seconds."""
        by_age = between(self.share(measurement_noise), self.levels, self.error)
        return between(age, self.ages, by_age.reshape(by_age.shape[0], len(self.ages), -1))
