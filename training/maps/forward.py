"""The forward map T as a physics-informed network (paper, sec. 5)."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from kkl_gym.system import System
from observers import ForwardMap, LinearFilter
from training.maps.coordinates import spread
from training.maps.least_squares import output_layer
from training.maps.networks import Network, compiled, tensor
from training.maps.pde import along, on_tensors, residual
from training.maps.scaling import StateScale

SOLVED = 20_000  # pairs, and points, from which the output layer is solved for in the end


def truncation_time(linear: LinearFilter, z0_norm: float, epsilon: float) -> float:
    """Time t* after which at most epsilon is left of a start z0.

    t* = ln(cond(V) |z0| / epsilon) / min |Re lambda| (paper, sec. 5.2, where the logarithm's argument is
    printed upside down).
    """
    poles, V = np.linalg.eig(linear.A)
    return float(max(0.0, np.log(np.linalg.cond(V) * z0_norm / epsilon)) / np.abs(poles.real).min())


class ForwardProblem(nn.Module):
    """The physics-informed risk R_S1(theta) (paper, eq. emp-risk-theta) of a forward network.

    mean |z - T(x)|^2 over simulated pairs + nu * mean |dT/dx f(x) - A T(x) - B h(x)|^2 over collocation points. Each z
    counts in units of its standard deviation, in both terms. The residual of each component is divided by the local
    speed of the scaled motion plus the rate of its mode, so that fast regions do not drown the rest (the authors'
    released code weights by the speed as well).

    Shapes: ``pairs`` (n, nx) and (n, nz), ``points`` (m, nx).
    """

    capturable = True

    def __init__(
        self,
        network: Network,
        system: System,
        *,
        linear: LinearFilter,
        pairs: tuple[np.ndarray, np.ndarray],
        points: np.ndarray,
        scale: StateScale,
        physics_weight: float,
        batch: int,
        device: torch.device,
    ) -> None:
        super().__init__()
        x, z = pairs
        self.network, self.system, self.linear = network.to(device), system, linear
        self.scale = scale
        self.z_offset, self.z_scale = z.mean(0), spread(z)
        self._xo, self._xs = tensor(scale.offset, device), tensor(scale.scale, device)
        self._zo, self._zs = tensor(self.z_offset, device), tensor(self.z_scale, device)
        self._A, self._B = tensor(linear.A, device), tensor(linear.B, device)
        self._x = tensor(scale(x), device)
        self._z = tensor((z - self.z_offset) / self.z_scale, device)
        self._points = tensor(points, device)
        self._rates = tensor(np.linalg.norm(linear.A, axis=1), device)
        self._physics_weight, self._batch = physics_weight, batch
        self._risk = compiled(self.risk, device)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """The risk on a batch of pairs and as many collocation points."""
        device = self._x.device
        rows = torch.randint(len(self._x), (self._batch,), generator=generator, device=device)
        points = torch.randint(len(self._points), (self._batch,), generator=generator, device=device)
        loss, data, physics = self._risk(self._x[rows], self._z[rows], self._points[points])
        return {"loss": loss, "data": data.detach(), "physics": physics.detach(), "error": data.detach().sqrt()}

    def risk(self, x: torch.Tensor, z: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The risk, and the terms of pairs and of points that it is made of."""
        data = ((self.network(x) - z) ** 2).mean()
        residual, speed = self.residual(points)
        physics = ((residual / self._zs / (speed[:, None] + self._rates)) ** 2).mean()
        return data + self._physics_weight * physics, data, physics

    def residual(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """PDE residual (n, nz) in units of z per second, and the speed |f| in scaled states (n,), at states (n, nx)."""
        f, h = on_tensors(self.system.f, x) / self._xs, on_tensors(self.system.h, x)
        value, derivative = along(self.network, (x - self._xo) / self._xs, f)
        T, derivative = self._zo + self._zs * value, self._zs * derivative
        return residual(T, derivative, h=h, A=self._A, B=self._B), f.norm(dim=-1)

    @torch.no_grad()
    def solve_output_layer(self, rng: np.random.Generator, report: Callable[[int], object] = lambda done: None) -> None:
        """Put the output layer where it minimises the risk for the features that the other layers have learned.

        That is linear least squares, in float64 and on more samples than a batch has; gradients come close to it.
        """
        *hidden, last = self.network.to(device="cpu", dtype=torch.float64)
        assert isinstance(last, nn.Linear)
        features = nn.Sequential(*hidden)
        some = torch.as_tensor(rng.permutation(len(self._x))[:SOLVED])
        at = torch.as_tensor(rng.permutation(len(self._points))[:SOLVED])
        device, x = self._x.device, self._points.cpu()[at].double()
        q, f = (x - self._xo.cpu()) / self._xs.cpu(), on_tensors(self.system.f, x) / self._xs.cpu()
        value, derivative = along(features, q, f)
        weights = output_layer(
            self.linear,
            equation=(value.numpy(), derivative.numpy(), on_tensors(self.system.h, x).numpy()),
            speed=f.norm(dim=-1).numpy(),
            pairs=(
                features(self._x.cpu()[some].double()).numpy(),
                self.z_offset + self.z_scale * self._z.cpu()[some].double().numpy(),
            ),
            physics_weight=self._physics_weight,
            report=report,
        )
        weights[:, -1] -= self.z_offset
        weights /= self.z_scale[:, None]
        last.weight.copy_(torch.as_tensor(weights[:, :-1]))
        last.bias.copy_(torch.as_tensor(weights[:, -1]))
        self.network.to(device=device, dtype=torch.float32)

    def forward_map(self) -> ForwardMap:
        """The learned map for NumPy."""
        return ForwardMap(self.network.export(), self.scale.offset, self.scale.scale, self.z_offset, self.z_scale)


def truncation_step(system: System, linear: LinearFilter, *, steps: int, epsilon: float, box_factor: float) -> int:
    """First sample k* by which the filter has forgotten its start along every trajectory."""
    x0 = system.draw_starts(np.random.default_rng(0), 10_000, box_factor)
    z0 = float(np.linalg.norm(linear.start(system.output(x0)), axis=-1).max())
    t = truncation_time(linear, z0, epsilon)
    if t >= steps * linear.dt:
        raise ValueError(
            f"trajectories of {steps * linear.dt:g} s end before the filter has forgotten its start, t* = {t:.3g} s; "
            "make them longer"
        )
    return math.ceil(t / linear.dt)


def transients(T: np.ndarray, z0: np.ndarray, *, linear: LinearFilter, ages: np.ndarray) -> np.ndarray:
    """What the filter holds along trajectories by T alone: z(t) = T(x(t)) + e^{At} (z_0 - T(x_0)).

    For an exact T this is the filter's own state at every age, so that none needs to be simulated (paper, sec. 3).

    Shapes: ``T`` (m, n, nz), ``z0`` (n, nz), ``ages`` (m,); returns (m, n, nz).
    """
    poles, V = np.linalg.eig(linear.A)
    left = np.exp(ages[:, None] * linear.dt * poles)  # of each mode
    start = np.linalg.solve(V, (z0 - T[0]).T).T
    return T + np.real((left[:, None] * start) @ V.T)
