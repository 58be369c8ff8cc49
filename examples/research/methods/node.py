"""Learned diagonal spectrum, T_inv trained through the filter (Miao and Gatsis, 2023)."""

from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from examples.research.methods.base import Configuration, Task
from examples.research.methods.kkl import SPECTRA, KKLMethod, spectrum
from examples.research.methods.recurrent import SPECTRUM_PACE, Batches, Decoder, distance, rollout
from kkl_gym.system import System
from observers import Artifact, InverseMap
from training.evaluation.levels import multiple
from training.maps.networks import Network
from training.spectrum import Spectrum
from training.trajectories.equations import output_matrix


class NODE(KKLMethod):
    """z' = diag(theta) z + B y with theta < 0 learned together with T_inv, by the error of x_hat along trajectories.

    K. Miao and K. Gatsis, "Learning robust state observers using neural ODEs", L4DC 2023. The filter is
    linear and diagonal, so it is integrated exactly between samples instead of by an ODE solver.
    """

    name: ClassVar[str] = "node"
    label: ClassVar[str] = "NODE"
    tuned_for: ClassVar[tuple[float, ...] | None] = (0.0,)
    noise: ClassVar[float] = 0.0
    """Standard deviation of the noise added to y in training, in multiples of the system's own."""

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Three initial spectra."""
        return tuple({"spectrum": list(interval)} for interval in SPECTRA)

    def train(self, task: Task, configuration: Configuration) -> Artifact:
        """Spectrum and inverse together."""
        torch.manual_seed(task.seed)
        system, budget = task.system, task.budget
        fastest, slowest = configuration["spectrum"]
        linear = Spectrum(spectrum(system, fastest, slowest)).filter(system.ny, budget.dt)
        network = Network(linear.size, system.nx, width=budget.width, depth=budget.depth, activation=budget.activation)
        decoder = Decoder(network, linear, task.data, device=task.device)
        rates = -linear.A.diagonal()[: linear.size // system.ny]
        problem = _Problem(decoder, rates, ny=system.ny, dt=budget.dt, device=task.device)
        batches = Batches(task.data, decoder, noise=multiple(system, self.noise), device=task.device)
        task.fit("node", problem, lambda generator: problem.loss(*batches(generator)), learning_rate=1e-2)
        eigenvalues = tuple(problem.theta().tolist())
        return Artifact(
            filter=Spectrum(eigenvalues).filter(system.ny, budget.dt),
            inverse=InverseMap(
                mlp=network.export(),
                features=("z_y",),
                z_offset=decoder.z_offset,
                whiten=decoder.whiten,
                noise_gain=np.zeros(linear.size),
                x_offset=decoder.x_offset,
                x_scale=decoder.x_scale,
            ),
            system=system.name,
            parameters=system.parameters,
            C=output_matrix(system),
            training={"method": self.name, **configuration, "seed": task.seed},
        )


class NODENoise(NODE):
    """The variant made robust by noise on y in training."""

    name: ClassVar[str] = "node-noise"
    label: ClassVar[str] = "NODE, noise"
    tuned_for: ClassVar[tuple[float, ...] | None] = (1.0,)
    noise: ClassVar[float] = 1.0


class _Problem(nn.Module):
    """The decoder and the logarithms of the rates -theta, the same for each output."""

    def __init__(self, decoder: Decoder, rates: np.ndarray, *, ny: int, dt: float, device: torch.device) -> None:
        super().__init__()
        self.decoder, self.ny, self.dt = decoder, ny, dt
        self._log_rates = torch.as_tensor(np.log(rates), device=device)
        self.change = nn.Parameter(torch.zeros_like(self._log_rates))

    def theta(self) -> torch.Tensor:
        """Eigenvalues in 1/s, (nz / ny,)."""
        return -(self._log_rates + SPECTRUM_PACE * self.change).exp()

    def loss(self, y: torch.Tensor, ages: np.ndarray, x: torch.Tensor) -> dict[str, Any]:
        """Error of the scaled estimate, from z0 = -A^-1 B y0."""
        s = self.theta() * self.dt
        eye = torch.eye(self.ny, dtype=s.dtype, device=s.device)

        def block(values: torch.Tensor) -> torch.Tensor:
            return torch.kron(eye, values[:, None])

        hold = torch.expm1(s) / self.theta()  # as in observers.LinearFilter: first-order hold on y
        late = (torch.expm1(s) - s) / (self.theta() * s)
        z0 = y[:, 0] @ block(-1.0 / self.theta()).T
        transition = torch.kron(eye, torch.diag(s.exp()))
        z = rollout(transition, block(hold - late), block(late), z0=z0, y=y, ages=ages)
        return {"loss": distance(self.decoder(z), x)}
