"""The forward map T as a physics-informed network (paper, sec. 5): its risk and its output layer."""

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.linalg import qr, solve_triangular
from torch import nn

from kkl_gym.equations import components
from kkl_gym.system import Components, System
from observers import ForwardMap, LinearFilter
from training.config import Config
from training.maps.coordinates import StateScale, spread
from training.maps.networks import Network, compiled, tensor

SOLVED = 20_000  # largest number of pairs, and of collocation points, in the least squares for the output layer
RIDGE = 1e-5  # ridge of the least squares, as a fraction of the root mean square column norm of their matrix


def on_tensors(equations: Callable[[Components], Components], x: torch.Tensor) -> torch.Tensor:
    """Evaluate a system's f or h, which are written for components, on states (n, nx); return (n, components)."""
    values = components(equations, x.unbind(-1))
    return torch.stack([(x.new_zeros(len(x)) + value).to(x.dtype) for value in values], -1)


def along(network: nn.Sequential, x: torch.Tensor, f: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a network's values at x and derivatives along f, by formulas: torch.compile lacks forward autodiff."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            x, f = layer(x), f @ layer.weight.T
        elif isinstance(layer, nn.Tanh):
            x = torch.tanh(x)
            f = (1 - x * x) * f
        else:  # SiLU
            gate = torch.sigmoid(x)
            f = gate * (1 + x * (1 - gate)) * f
            x = gate * x
    return x, f


class ForwardProblem(nn.Module):
    """The physics-informed risk R_S1(theta) (paper, eq. emp-risk-theta) of a forward network.

    It is mean |z - T(x)|^2 over simulated pairs + ``physics_weight`` * mean |dT/dx f(x) - A T(x) - B h(x)|^2
    over collocation points. Both terms measure each component of z in units of its standard deviation. Each component's
    residual is divided by the local speed of the scaled motion plus the rate of the component's mode, so that fast
    regions do not dominate (the authors' released code weights by the speed as well).

    Shapes: ``pairs`` (n, nx) and (n, nz), ``points`` (m, nx).
    """

    def __init__(
        self,
        system: System,
        linear: LinearFilter,
        config: Config,
        *,
        pairs: tuple[np.ndarray, np.ndarray],
        points: np.ndarray,
        device: torch.device,
    ) -> None:
        super().__init__()
        x, z = pairs
        self.network = Network.of(config, system.nx, linear.size).to(device)
        self.system, self.linear, self.config = system, linear, config
        self.scale = StateScale.of(points, config.scaling)
        self.z_offset, self.z_scale = z.mean(0), spread(z)
        self._A, self._B = tensor(linear.A, device), tensor(linear.B, device)
        self._x_offset, self._x_scale = tensor(self.scale.offset, device), tensor(self.scale.scale, device)
        self._z_offset, self._z_scale = tensor(self.z_offset, device), tensor(self.z_scale, device)
        self._x, self._z = tensor(self.scale(x), device), tensor((z - self.z_offset) / self.z_scale, device)
        self._points = tensor(points, device)
        self._rates = tensor(np.linalg.norm(linear.A, axis=1), device)
        self._risk = compiled(self.risk, device)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Return the risk on a batch of pairs and as many collocation points."""
        shape, device = (self.config.batch,), self._x.device
        rows = torch.randint(len(self._x), shape, generator=generator, device=device)
        points = torch.randint(len(self._points), shape, generator=generator, device=device)
        risk, error = self._risk(self._x[rows], self._z[rows], self._points[points])
        return {"loss": risk, "error": error}

    def risk(self, x: torch.Tensor, z: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the risk, and the root mean square error on the pairs alone."""
        data = ((self.network(x) - z) ** 2).mean()
        residual, speed = self.residual(points)
        physics = ((residual / self._z_scale / (speed[:, None] + self._rates)) ** 2).mean()
        return data + self.config.physics_weight * physics, data.sqrt()

    def residual(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return dT/dx f - A T - B h (n, nz) at x (n, nx), in units of z per second, and |f| (n,) of scaled states."""
        f, h = on_tensors(self.system.f, x) / self._x_scale, on_tensors(self.system.h, x)
        value, derivative = along(self.network, (x - self._x_offset) / self._x_scale, f)
        T, derivative = self._z_offset + self._z_scale * value, self._z_scale * derivative
        return derivative - T @ self._A.T - h @ self._B.T, f.norm(dim=-1)

    @torch.no_grad()
    def solve_output_layer(self, rng: np.random.Generator, report: Callable[[int], object] = lambda done: None) -> None:
        """Minimise the risk over the output layer, given the features phi that the other layers have learned.

        In the coordinates of A's eigenvectors, dT/dx f = A T + B h is one linear equation for each component of T: with
        T_i = w . phi it becomes (dphi/dx f - lambda_i phi) . w = (B h)_i at every collocation point. Each pair adds
        w . phi = z_i. A QR factorisation with a small ridge solves the least squares in float64, on more samples than a
        batch has.
        """
        *hidden, last = self.network.to(device="cpu", dtype=torch.float64)
        assert isinstance(last, nn.Linear)
        features, linear, device = nn.Sequential(*hidden), self.linear, self._x.device
        some = torch.as_tensor(rng.permutation(len(self._x))[:SOLVED])
        at = torch.as_tensor(rng.permutation(len(self._points))[:SOLVED])
        x, offset, scale = self._points.cpu()[at].double(), self._x_offset.cpu(), self._x_scale.cpu()
        f, h = on_tensors(self.system.f, x) / scale, on_tensors(self.system.h, x).numpy()
        value, derivative = (each.numpy() for each in along(features, (x - offset) / scale, f))
        phi = np.column_stack([value, np.ones(len(at))])
        phi_along = np.column_stack([derivative, np.zeros(len(at))])
        pairs = np.column_stack([features(self._x.cpu()[some].double()).numpy(), np.ones(len(some))])
        z = self.z_offset + self.z_scale * self._z.cpu()[some].double().numpy()
        poles, V = np.linalg.eig(linear.A)
        driven, target = (np.linalg.solve(V, each.T).T for each in (h @ linear.B.T, z / np.sqrt(len(some))))
        solved = np.empty((len(poles), phi.shape[1]), dtype=V.dtype)
        for i, pole in enumerate(poles):
            report(i)
            row = np.sqrt(self.config.physics_weight / len(at)) / (f.norm(dim=-1).numpy() + abs(pole))
            matrix = np.vstack([(phi_along - pole * phi) * row[:, None], pairs / np.sqrt(len(some))])
            ridge = RIDGE * np.linalg.norm(matrix) / np.sqrt(phi.shape[1]) * np.eye(phi.shape[1])
            right = np.concatenate([driven[:, i] * row, target[:, i]])
            Q, R = qr(np.vstack([matrix, ridge]), mode="economic", overwrite_a=True, check_finite=False)
            solved[i] = solve_triangular(R, Q[: len(right)].conj().T @ right)
        weights = np.real(V @ solved)
        weights[:, -1] -= self.z_offset
        weights /= self.z_scale[:, None]
        last.weight.copy_(torch.as_tensor(weights[:, :-1]))
        last.bias.copy_(torch.as_tensor(weights[:, -1]))
        self.network.to(device=device, dtype=torch.float32)

    def forward_map(self) -> ForwardMap:
        """Return the learned map as artifacts hold it."""
        return ForwardMap(self.network.export(), self.scale.offset, self.scale.scale, self.z_offset, self.z_scale)


def truncation_step(system: System, linear: LinearFilter, *, steps: int, epsilon: float, box_factor: float) -> int:
    """Return the first sample k* from which on the filter's start changes z by at most ``epsilon`` in every trajectory.

    t* = ln(cond(V) |z0| / epsilon) / min |Re lambda| (paper, sec. 5.2, which prints the logarithm's argument inverted).
    """
    x0 = system.draw_starts(np.random.default_rng(0), 10_000, box_factor)
    z0 = float(np.linalg.norm(linear.start(system.output(x0)), axis=-1).max())
    poles, V = np.linalg.eig(linear.A)
    t = max(0.0, np.log(np.linalg.cond(V) * z0 / epsilon)) / np.abs(poles.real).min()
    if t >= steps * linear.dt:
        raise ValueError(
            f"trajectories of {steps * linear.dt:g} s end before the filter has forgotten its start, t* = {t:.3g} s; "
            "make them longer"
        )
    return math.ceil(t / linear.dt)


def transients(T: np.ndarray, z0: np.ndarray, *, linear: LinearFilter, ages: np.ndarray) -> np.ndarray:
    """Return z(t) = T(x(t)) + e^{At} (z_0 - T(x_0)) along trajectories, which is exact for an exact T (paper, sec. 3).

    Shapes: ``T`` (m, n, nz), ``z0`` (n, nz), ``ages`` (m,) in samples; returns (m, n, nz).
    """
    poles, V = np.linalg.eig(linear.A)
    left = np.exp(ages[:, None] * linear.dt * poles)  # remaining share of each mode
    start = np.linalg.solve(V, (z0 - T[0]).T).T
    return T + np.real((left[:, None] * start) @ V.T)
