"""The method of Miao and Gatsis (2023): a diagonal filter and T_inv are trained together."""

from typing import ClassVar

import numpy as np
import torch
from torch import nn
from torch.nn.functional import smooth_l1_loss

from examples.research.methods.base import Configuration, Task
from examples.research.methods.kkl import SPECTRA, KKLMethod, spectrum
from kkl_gym.system import System
from observers import Artifact, InverseMap
from training.evaluation.levels import multiple
from training.maps.coordinates import spread
from training.maps.networks import Network, tensor
from training.spectrum import Spectrum
from training.trajectories.equations import output_matrix
from training.trajectories.motions import filter_states

TRAJECTORIES_PER_BATCH = 128
AGES_PER_BATCH = 32
SOFT_FLOOR = 1e-4  # directions in which z varies by less than this share of the largest spread get one common scale
# The loss is the absolute error, quadratic only below this share of a state's standard deviation. Peaks would
# dominate a quadratic loss: Rössler's x3 stays near 0.02 between peaks of 20.
ROUNDING = 0.01
SPECTRUM_PACE = 0.1  # ratio of the spectrum's learning rate to the network's; the network has to follow the spectrum
LEARNING_RATE = 1e-2


class NODE(KKLMethod):
    """z' = diag(theta) z + B y, theta < 0; theta and T_inv are learned together from errors of x_hat on trajectories.

    K. Miao and K. Gatsis, "Learning robust state observers using neural ODEs", L4DC 2023. The filter is
    linear and diagonal, so it is integrated exactly between samples instead of by an ODE solver.
    """

    name: ClassVar[str] = "node"
    label: ClassVar[str] = "NODE"
    tuned_for: ClassVar[tuple[float, ...] | None] = (0.0,)
    noise: ClassVar[float] = 0.0
    """Standard deviation of the noise added to y in training, in multiples of the system's default level."""

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Return three initial spectra."""
        return tuple({"spectrum": list(interval)} for interval in SPECTRA)

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """Learn spectrum and inverse together."""
        torch.manual_seed(task.seed)
        system, problem = task.system, _Problem(task, self.noise, *configuration["spectrum"])
        task.fit("node", problem, problem.loss, LEARNING_RATE)
        linear = Spectrum(tuple(problem.theta().tolist())).filter(system.ny, task.budget.dt)
        return Artifact(
            filter=linear,
            inverse=InverseMap(
                mlp=problem.network.export(),
                features=("z_y",),
                z_offset=problem.z_offset,
                whiten=problem.whiten,
                noise_gain=np.zeros(linear.size),
                x_offset=problem.x_offset,
                x_scale=problem.x_scale,
            ),
            system=system.name,
            parameters=system.parameters,
            C=output_matrix(system),
            training={"method": self.name, **configuration, "seed": task.seed},
        )


class NODENoise(NODE):
    """The robust variant, with noise on y in training."""

    name: ClassVar[str] = "node-noise"
    label: ClassVar[str] = "NODE, noise"
    tuned_for: ClassVar[tuple[float, ...] | None] = (1.0,)
    noise: ClassVar[float] = 1.0


class _Problem(nn.Module):
    """The trained parts: T_inv, and the logarithms of the rates -theta, which all outputs share.

    The components of z are nearly collinear. The principal directions of z under the initial spectrum are scaled to
    unit variance, except those of least variance (``SOFT_FLOOR``), which change most as the spectrum is learned.
    """

    def __init__(self, task: Task, noise: float, fastest: float, slowest: float) -> None:
        super().__init__()
        system, budget, data, cpu = task.system, task.budget, task.data, torch.device("cpu")
        linear = Spectrum(spectrum(system, fastest, slowest)).filter(system.ny, budget.dt)
        y = data.y[:, :500].astype(float)
        z = filter_states(linear, y, np.zeros((len(y) - 1, y.shape[1], 0)), data.ages).reshape(-1, linear.size)
        self.z_offset, scale = z.mean(0), spread(z)
        _, singular, directions = np.linalg.svd((z - self.z_offset) / scale, full_matrices=False)
        self.whiten = (np.sqrt(len(z)) / np.hypot(singular, SOFT_FLOOR * singular[0]))[:, None] * directions / scale
        self._offset, self._whiten = torch.as_tensor(self.z_offset), torch.as_tensor(self.whiten)
        self.x_offset, self.x_scale = data.x.mean((0, 1)), data.x.std((0, 1))
        self.network = Network(
            linear.size, system.nx, width=budget.width, depth=budget.depth, activation=budget.activation
        )
        self._log_rates = torch.as_tensor(np.log(-linear.A.diagonal()[: linear.size // system.ny]))
        self.change = nn.Parameter(torch.zeros_like(self._log_rates))
        self._ages, self._ny, self._dt = data.ages, system.ny, budget.dt
        self._y = tensor(data.y.transpose(1, 0, 2), cpu)
        self._x = tensor((data.x - self.x_offset) / self.x_scale, cpu)
        self._noise = tensor(np.broadcast_to(multiple(system, noise), system.ny), cpu)

    def theta(self) -> torch.Tensor:
        """Return the eigenvalues in 1/s, (nz / ny,)."""
        return -(self._log_rates + SPECTRUM_PACE * self.change).exp()

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Return the error of the scaled estimate at random ages of random trajectories; z starts at -A^-1 B y0."""
        rows = torch.randint(len(self._y), (TRAJECTORIES_PER_BATCH,), generator=generator)
        chosen = torch.randperm(len(self._ages), generator=generator)[:AGES_PER_BATCH].sort().values
        ages = self._ages[chosen.numpy()]
        y = self._y[rows, : ages[-1] + 1]
        if self._noise.any():
            y = y + self._noise * torch.randn(y.shape, generator=generator)
        y, s = y.double(), self.theta() * self._dt
        eye = torch.eye(self._ny, dtype=s.dtype)

        def block(values: torch.Tensor) -> torch.Tensor:
            return torch.kron(eye, values[:, None])

        hold = torch.expm1(s) / self.theta()  # first-order hold on y, as in observers.LinearFilter
        late = (torch.expm1(s) - s) / (self.theta() * s)
        z0 = y[:, 0] @ block(-1.0 / self.theta()).T
        transition = torch.kron(eye, torch.diag(s.exp()))
        z = rollout(transition, block(hold - late), block(late), z0=z0, y=y, ages=ages)
        x_hat = self.network(((z - self._offset) @ self._whiten.T).float())
        return {"loss": smooth_l1_loss(x_hat, self._x[chosen[:, None], rows], beta=ROUNDING)}


def rollout(
    transition: torch.Tensor,
    early: torch.Tensor,
    late: torch.Tensor,
    *,
    z0: torch.Tensor,
    y: torch.Tensor,
    ages: np.ndarray,
) -> torch.Tensor:
    """Run z_k+1 = transition z_k + early y_k + late y_k+1, and return z at the increasing sample numbers ``ages``.

    One power of the transition advances the filter to the next of these samples, however many samples lie between.

    Shapes: ``transition`` (nz, nz), ``early``, ``late`` (nz, ny), ``z0`` (n, nz), ``y`` (n, steps + 1, ny), ``ages``
    (m,); returns (m, n, nz).
    """
    gaps = np.diff(ages, prepend=0)
    powers = torch.eye(len(transition), dtype=transition.dtype)[None]
    square = transition
    while len(powers) <= gaps.max():  # all powers of the transition up to the largest gap, by doubling
        powers = torch.cat([powers, powers @ square])
        square = square @ square
    # w = z - late y follows w_k+1 = transition w_k + (early + transition late) y_k, with one sample of y in each step.
    response = (powers @ (early + transition @ late)).flip(0).transpose(1, 2)  # oldest sample first
    w, out, age = z0 - y[:, 0] @ late.T, [], 0
    for gap, jump in zip(gaps.tolist(), powers[torch.as_tensor(gaps)].mT.unbind(), strict=True):
        if gap:
            kernel = response[len(response) - gap :].reshape(-1, len(transition))
            w = w @ jump + y[:, age : age + gap].reshape(len(y), -1) @ kernel
            age += gap
        out.append(w + y[:, age] @ late.T)
    return torch.stack(out)
