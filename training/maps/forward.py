"""The forward map T as a physics-informed network (paper, sec. 5)."""

import math

import numpy as np
import torch
from torch import nn

from kkl_gym.system import System
from observers import ForwardMap, LinearFilter
from training.maps.networks import Network, tensor
from training.maps.pde import on_tensors, residual


def truncation_time(linear: LinearFilter, z0_norm: float, epsilon: float) -> float:
    """Time t* after which at most epsilon is left of a start z0.

    t* = ln(cond(V) |z0| / epsilon) / min |Re lambda| (paper, sec. 5.2, where the logarithm's argument is
    printed upside down).

    Parameters
    ----------
    linear : LinearFilter
        The filter.
    z0_norm : float
        Norm of the start.
    epsilon : float
        What may be left, in units of z.

    Returns
    -------
    float
        t* in seconds.
    """
    poles, V = np.linalg.eig(linear.A)
    return float(max(0.0, np.log(np.linalg.cond(V) * z0_norm / epsilon)) / np.abs(poles.real).min())


class ForwardProblem(nn.Module):
    """The physics-informed risk R_S1(theta) (paper, eq. emp-risk-theta) of a forward network.

    mean |z - T(x)|^2 over simulated pairs + nu * mean |dT/dx f(x) - A T(x) - B h(x)|^2 over collocation points, drawn
    anew for every batch, uniformly from the training box. States are scaled to [-1, 1] and each z to unit
    variance, in both terms; the residual at each point is divided by the local speed of the scaled motion plus the
    filter's slowest rate, so that fast corners of the box do not drown the rest (the authors' released code
    weights by the speed as well).

    Parameters
    ----------
    network : Network
        From nx scaled states to nz scaled values, the map to be trained.
    system : System
        Its equations.
    linear : LinearFilter
        The filter.
    x : ndarray, shape (n, nx)
        States of the pairs.
    z : ndarray, shape (n, nz)
        Filter states of the pairs.
    physics_weight : float
        Weight nu of the residual.
    batch : int
        Number of pairs, and of collocation points, in a batch.
    device : torch.device
        Where the network is trained.
    """

    def __init__(
        self,
        network: Network,
        system: System,
        *,
        linear: LinearFilter,
        x: np.ndarray,
        z: np.ndarray,
        physics_weight: float,
        batch: int,
        device: torch.device,
    ) -> None:
        super().__init__()
        low, high = system.box()
        lowest, highest = np.minimum(low, x.min(0)), np.maximum(high, x.max(0))
        self.network, self.system, self.linear = network.to(device), system, linear
        self.x_offset, self.x_scale = (lowest + highest) / 2, (highest - lowest) / 2
        self.z_offset, self.z_scale = z.mean(0), np.maximum(z.std(0), 1e-12)
        self._xo, self._xs = tensor(self.x_offset, device), tensor(self.x_scale, device)
        self._zo, self._zs = tensor(self.z_offset, device), tensor(self.z_scale, device)
        self._A, self._B = tensor(linear.A, device), tensor(linear.B, device)
        self._x = tensor((x - self.x_offset) / self.x_scale, device)
        self._z = tensor((z - self.z_offset) / self.z_scale, device)
        self._low, self._span = tensor(low, device), tensor(high - low, device)
        self._slowest = float(np.abs(np.linalg.eigvals(linear.A).real).min())
        self._physics_weight, self._batch = physics_weight, batch

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """The risk on a batch of data and as many fresh collocation points."""
        device = self._x.device
        rows = torch.randint(len(self._x), (self._batch,), generator=generator, device=device)
        data = ((self.network(self._x[rows]) - self._z[rows]) ** 2).mean()
        x = self._low + self._span * torch.rand((self._batch, len(self._low)), generator=generator, device=device)
        residual, speed = self.residual(x)
        physics = ((residual / self._zs / (speed + self._slowest)[:, None]) ** 2).mean()
        return {"loss": data + self._physics_weight * physics, "data": data.detach(), "physics": physics.detach()}

    def residual(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """PDE residual (n, nz) in units of z per second, and the speed |f| in scaled states (n,), at states (n, nx)."""
        f, h = on_tensors(self.system.f, x), on_tensors(self.system.h, x)
        return residual(self.T, x, f=f, h=h, A=self._A, B=self._B), (f / self._xs).norm(dim=-1)

    def T(self, x: torch.Tensor) -> torch.Tensor:
        """The learned map at states (n, nx), (n, nz)."""
        z: torch.Tensor = self._zo + self._zs * self.network((x - self._xo) / self._xs)
        return z

    @torch.no_grad()
    def error(self, n: int = 100_000) -> np.ndarray:
        """Misfit z - T(x) on up to n of the data pairs, (n, nz)."""
        rows = np.random.default_rng(0).permutation(len(self._x))[:n]
        difference = self._zs * (self._z[rows] - self.network(self._x[rows]))
        return np.asarray(difference.cpu().numpy(), dtype=float)

    def forward_map(self) -> ForwardMap:
        """The learned map for NumPy."""
        return ForwardMap(self.network.export(), self.x_offset, self.x_scale, self.z_offset, self.z_scale)


def truncation_step(system: System, linear: LinearFilter, *, steps: int, epsilon: float) -> int:
    """First sample k* by which the filter has forgotten its start along every trajectory from X.

    Parameters
    ----------
    system : System
        What the filter observes.
    linear : LinearFilter
        The filter.
    steps : int
        Length of the trajectories in sampling intervals.
    epsilon : float
        What may be left of the start, in units of z.

    Returns
    -------
    int
        k*.

    Raises
    ------
    ValueError
        If the trajectories end before.
    """
    x0 = np.random.default_rng(0).uniform(*system.box(), (10_000, system.nx))
    z0 = float(np.linalg.norm(linear.start(system.output(x0)), axis=-1).max())
    t = truncation_time(linear, z0, epsilon)
    if t >= steps * linear.dt:
        raise ValueError(
            f"trajectories of {steps * linear.dt:g} s end before the filter has forgotten its start, t* = {t:.3g} s; "
            "make them longer"
        )
    return math.ceil(t / linear.dt)
