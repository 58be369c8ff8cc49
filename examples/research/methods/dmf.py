"""Discrete-time observer with a learned, Schur stable A (Peralez and Nadri, 2024)."""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import nn

from examples.research.methods.base import Arrays, Configuration, Method, Task
from examples.research.methods.kkl import SPECTRA, spectrum
from examples.research.methods.recurrent import SPECTRUM_PACE, Batches, Decoder, distance, rollout
from kkl_gym.system import System
from observers import MLP, LinearFilter
from observers.estimator import Estimate, Estimator
from observers.network import ACTIVATIONS
from observers.storage import get_mlp, put_mlp
from training.evaluation.levels import Level, multiple
from training.maps.networks import Network
from training.spectrum import Spectrum

SHARE = 0.6  # of the transient stage in the CPU time; the asymptotic stage has the rest
EPSILON = 1e-3  # 1/s at the pace of the shipped systems, no mode is slower
LEARNING_RATE = 1e-2
FORGET = 0.98  # of the filtered innovations, per sample


class DMF(Method[Arrays]):
    """z+ = A z + B y, x_hat = T_inv(z): A and T_inv trained through time, in two stages.

    J. Peralez and M. Nadri, "Deep model-free KKL observer: a switching approach", L4DC 2024. The transient stage starts
    from z0 = MLP(y0) and is trained by the error of x_hat from the first sample on. The asymptotic stage
    starts from z = T(x), with T learned so that T(x_k) = z_k, and so never sees a transient. Online both run side by
    side, and the estimate is that of the smaller filtered innovation |y - h(x_hat)|.

    The authors leave A free; here A = exp(dt M) with M = K - K^T - S S^T - eps I, which is Schur for every S and K and
    reaches every Schur matrix with a real logarithm up to a change of coordinates. B is dt, in every entry.
    """

    name: ClassVar[str] = "dmf"
    label: ClassVar[str] = "DMF"
    tuned_for: ClassVar[tuple[float, ...] | None] = (0.0,)
    noise: ClassVar[float] = 0.0
    """Standard deviation of the noise added to y in training, in multiples of the system's own."""

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Three initial spectra."""
        return tuple({"spectrum": list(interval)} for interval in SPECTRA)

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """Both stages."""
        torch.manual_seed(task.seed)
        system, budget = task.system, task.budget
        fastest, slowest = configuration["spectrum"]
        linear = Spectrum(spectrum(system, fastest, slowest)).filter(system.ny, budget.dt)

        def stage(inputs: int) -> _Stage:
            network = Network(
                linear.size, system.nx, width=budget.width, depth=budget.depth, activation=budget.activation
            )
            decoder = Decoder(network, linear, task.data, device=task.device)
            start = Network(inputs, linear.size, width=budget.width, depth=2, activation=budget.activation)
            return _Stage(decoder, start, linear, pace=system.pace, device=task.device)

        transient, asymptotic = stage(system.ny), stage(system.nx)
        batches = Batches(task.data, transient.decoder, noise=multiple(system, self.noise), device=task.device)
        y_offset, y_scale = task.data.y.mean((0, 1)), task.data.y.std((0, 1))
        offset, scale = torch.as_tensor(y_offset).double(), torch.as_tensor(y_scale).double()

        def from_output(generator: torch.Generator) -> dict[str, torch.Tensor]:
            y, ages, x = batches(generator)
            z = transient.run(transient.z0((y[:, 0] - offset.to(y)) / scale.to(y)), y, ages)
            return {"loss": distance(transient.decoder(z), x)}

        def from_state(generator: torch.Generator) -> dict[str, torch.Tensor]:
            y, ages, x = batches(generator)
            z = asymptotic.run(asymptotic.z0(x[0]), y[:, ages[0] :], ages - ages[0])
            consistent = distance(asymptotic.start(x), asymptotic.decoder.coordinates(z))
            return {"loss": distance(asymptotic.decoder(z), x) + consistent, "consistency": consistent.detach()}

        task.fit("transient", transient, from_output, LEARNING_RATE, SHARE)
        asymptotic.load_state_dict(
            {k: v for k, v in transient.state_dict().items() if not k.startswith("start.")}, strict=False
        )
        task.fit("asymptotic", asymptotic, from_state, LEARNING_RATE, 1 - SHARE)
        arrays = {"y_offset": y_offset, "y_scale": y_scale, **_pack("start", transient.start)}
        for name, found in (("transient", transient), ("asymptotic", asymptotic)):
            arrays |= {f"{name}.{key}": value for key, value in found.export().items()}
        return arrays

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """The switching observer."""
        return Switching(trained, system)


class DMFNoise(DMF):
    """The variant trained with noise on y."""

    name: ClassVar[str] = "dmf-noise"
    label: ClassVar[str] = "DMF, noise"
    tuned_for: ClassVar[tuple[float, ...] | None] = (1.0,)
    noise: ClassVar[float] = 1.0


class _Stage(nn.Module):
    """One filter with its decoder, and the network that gives its start. Its time is in units of the system's pace."""

    def __init__(
        self, decoder: Decoder, start: Network, linear: LinearFilter, *, pace: float, device: torch.device
    ) -> None:
        super().__init__()
        self.decoder, self.start, self.dt = decoder, start.to(device), linear.dt / pace
        self._S = torch.diag(torch.as_tensor(np.sqrt(-pace * linear.A.diagonal()), device=device))
        self.S = nn.Parameter(torch.zeros_like(self._S))
        self.K = nn.Parameter(torch.zeros_like(self.S))
        self.B = torch.as_tensor(linear.dt * linear.B, device=device)
        self._offset = torch.as_tensor(decoder.z_offset, device=device)
        self._unwhiten = torch.as_tensor(np.linalg.inv(decoder.whiten), device=device)

    def A(self) -> torch.Tensor:
        """Schur stable, (nz, nz)."""
        eye = torch.eye(len(self.S), dtype=self.S.dtype, device=self.S.device)
        S, K = self._S + SPECTRUM_PACE * self.S, SPECTRUM_PACE * self.K
        M = K - K.T - S @ S.T - EPSILON * eye
        A: torch.Tensor = torch.linalg.matrix_exp(self.dt * M)
        return A

    def z0(self, known: torch.Tensor) -> torch.Tensor:
        """The start that the network gives for a scaled y0 or x0, in double precision."""
        z0: torch.Tensor = self._offset + self.start(known.float()).double() @ self._unwhiten.T
        return z0

    def run(self, z0: torch.Tensor, y: torch.Tensor, ages: np.ndarray) -> torch.Tensor:
        """Filter states at ``ages``, (m, n, nz)."""
        return rollout(self.A(), self.B, torch.zeros_like(self.B), z0=z0, y=y, ages=ages)

    def export(self) -> Arrays:
        """What the observer needs at run time."""
        arrays = {"A": self.A().detach().cpu().numpy(), "B": self.B.cpu().numpy()}
        arrays |= {name: getattr(self.decoder, name) for name in ("z_offset", "whiten", "x_offset", "x_scale")}
        return {**arrays, **_pack("network", self.decoder.network)}


def _pack(name: str, network: Network) -> Arrays:
    mlp = network.export()
    arrays = {f"{name}.{mlp.activation}": np.ones(1)}
    put_mlp(arrays, f"{name}.", mlp)
    return arrays


def _unpack(arrays: Arrays, name: str) -> MLP:
    return get_mlp(arrays, f"{name}.", next(kind for kind in ACTIVATIONS if f"{name}.{kind}" in arrays))


class Both(NamedTuple):
    """Both filters' states (2, n, nz), last outputs (n, ny), which are NaN at first, filtered innovations (n, 2)."""

    z: np.ndarray
    y: np.ndarray
    innovation: np.ndarray


class Switching:
    """Both observers side by side; the estimate is that of the smaller filtered innovation."""

    def __init__(self, arrays: Arrays, system: System) -> None:
        self._system = system
        self._start = _unpack(arrays, "start")
        self._y_offset, self._y_scale = arrays["y_offset"], arrays["y_scale"]
        self._stages = []
        for name in ("transient", "asymptotic"):
            own = {key.removeprefix(f"{name}."): value for key, value in arrays.items() if key.startswith(f"{name}.")}
            self._stages.append((own, _unpack(own, "network")))

    def start(self, n: int) -> Both:
        """Rows before their first sample."""
        (first, _), ny = self._stages[0], len(self._y_offset)
        return Both(np.zeros((2, n, len(first["A"]))), np.full((n, ny), np.nan), np.zeros((n, 2)))

    def advance(self, state: Both, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> Both:
        """Advance both, compare their filtered innovations; first both from the learned start."""
        new = np.isnan(state.y).any(-1, keepdims=True)
        first, _ = self._stages[0]
        start = self._start((y - self._y_offset) / self._y_scale)
        z0 = first["z_offset"] + start @ np.linalg.inv(first["whiten"]).T
        z = [z @ own["A"].T + state.y @ own["B"].T for z, (own, _) in zip(state.z, self._stages, strict=True)]
        state = Both(np.where(new, z0, z), y, state.innovation)
        apart = np.linalg.norm(y[:, None] - self._system.output(self._both(state)), axis=-1)
        return state._replace(innovation=np.where(new, 0.0, FORGET * state.innovation + (1 - FORGET) * apart))

    def estimate(self, state: Both) -> Estimate:
        """That of the smaller filtered innovation, first the transient observer's."""
        chosen = state.innovation.argmin(1)
        return Estimate(np.asarray(self._both(state)[np.arange(len(chosen)), chosen]))

    def _both(self, state: Both) -> np.ndarray:
        return np.stack([self._decode(0, state.z[0]), self._decode(1, state.z[1])], axis=1)

    def _decode(self, i: int, z: np.ndarray) -> np.ndarray:
        own, network = self._stages[i]
        x_hat = network((z - own["z_offset"]) @ own["whiten"].T)
        return np.asarray(own["x_offset"] + own["x_scale"] * x_hat)
