"""A Kalman filter in a learned latent space (Becker et al., 2019)."""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn.functional import elu, pad

from examples.research.methods.base import Arrays, Configuration, Method, Task
from examples.research.methods.chunks import Chunks, error, noise_feature
from kkl_gym.system import System
from observers.estimator import Estimate, Estimator
from training.evaluation.levels import Level
from training.maps.networks import Network

ROWS = 64
LEARNING_RATE = 1e-2
BASES, BAND = 16, 3  # transitions that are mixed, and their diagonals on each side of the main one
ENCODER, DECODER = 64, 128  # widths
SLOWEST, FASTEST = 0.003, 0.3  # rad per sample, by which upper and lower half of the latent state turn at first
PACE = 0.1  # of the learning rate: small changes of what moves a sample are large ones over many
UNEVEN = 0.003  # standard deviation of what first tells one transition from another
NOISE = 0.01  # first variance of the latent process noise
LEAST = 1e-6  # variance of an observation
LARGEST = 1e3  # latent state, so that an unstable transition yields a large error and not an infinite one


class Belief(NamedTuple):
    """A Gaussian in the latent space, of an upper and a lower half that covary component by component.

    Shapes: ``mean`` (n, 2, m), ``variance`` (n, 2, m), ``side`` (n, m).
    """

    mean: torch.Tensor
    variance: torch.Tensor
    side: torch.Tensor


def predict(belief: Belief, transition: torch.Tensor, noise: torch.Tensor) -> Belief:
    """Move a Gaussian by a linear transition, of whose covariance only the kept entries are computed.

    Shapes: ``transition`` (n, 2, 2, 2 band + 1, m), ``noise`` (2, m).
    """
    width = transition.shape[-2]
    held = torch.cat([belief.mean, belief.variance, belief.side[:, None]], 1)
    near = pad(held, (width // 2, width // 2)).unfold(-1, width, 1).transpose(-2, -1).contiguous()
    means, variances, sides = near[:, None, :2], near[:, None, 2:4], near[:, 4]
    mean = (transition * means).sum((2, 3))
    # Entries of A P A^T, of which P has four diagonal blocks, two of them the same.
    scaled = transition * variances
    (upper_upper, upper_lower), (lower_upper, lower_lower) = (half.unbind(1) for half in transition.unbind(1))
    crossed = (torch.stack([upper_upper * upper_lower, lower_upper * lower_lower], 1) * sides[:, None]).sum(2)
    variance = (scaled * transition).sum((2, 3)) + 2.0 * crossed + noise
    side = (scaled[:, 0] * transition[:, 1]).sum((1, 2))
    side = side + ((upper_upper * lower_lower + upper_lower * lower_upper) * sides).sum(1)
    kept = (LARGEST / variance).clamp(max=1.0)  # both halves are cut with what they share, which stays a covariance
    return Belief(mean.clamp(-LARGEST, LARGEST), kept * variance, kept.prod(1).sqrt() * side)


def update(belief: Belief, w: torch.Tensor, variance: torch.Tensor) -> Belief:
    """Condition a Gaussian on an observation of its upper half.

    Shapes: ``w`` (n, m), ``variance`` (n, m).
    """
    upper, lower = belief.variance.unbind(1)
    total = upper + variance
    covariance = torch.stack([upper, belief.side], 1)  # of both halves with the upper one
    gain = covariance / total[:, None]
    mean = belief.mean + gain * (w - belief.mean[:, 0])[:, None]
    left = variance / total
    return Belief(mean, torch.stack([left * upper, lower - gain[:, 1] * belief.side], 1), left * belief.side)


class RKN(Method[Arrays]):
    """A network makes an observation of y, a Kalman filter follows it in a latent space, another network reads x_hat.

    P. Becker, H. Pandya, G. Gebhardt, C. Zhao, C. J. Taylor and G. Neumann, "Recurrent Kalman networks: factorized
    inference in high-dimensional deep feature spaces", ICML 2019. The encoder gives m latent observations and their
    variances. The latent state has 2m components, of which the upper half is observed, with a variance for each and a
    covariance for each pair. Its transition is a mixture of banded ones, with coefficients that a network makes of its
    mean. It knows nothing of the model. The noise level is an input of the encoder, as for the maps here and not in the
    authors' version: half of its training trajectories carry no noise, the others a level up to the system's own.

    The authors train the likelihood or squared errors; here the loss is the mean length of the scaled error, since
    the estimate alone is measured, and transients dominate squares. Their transitions begin with one angle
    between the halves, here with one for each pair, since motions at 100 samples a second are slow.
    """

    name: ClassVar[str] = "rkn"
    label: ClassVar[str] = "RKN"

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Two sizes, two lengths of back-propagation."""
        return ({"latent": 16, "chunk": 25}, {"latent": 16, "chunk": 50}, {"latent": 32, "chunk": 50})

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """The networks and their scaling."""
        torch.manual_seed(task.seed)
        problem = _Problem(task, **configuration)
        task.fit("rkn", problem, problem.loss, LEARNING_RATE)
        chunks = problem.chunks
        arrays = {key: value.detach().cpu().numpy() for key, value in problem.cell.state_dict().items()}
        return {**arrays, "x_offset": chunks.x_offset, "x_scale": chunks.x_scale}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """The networks, one sample at a time."""
        return RKNObserver(trained, noise_feature(noise, system))


class Cell(nn.Module):
    """Encoder, transition and decoder."""

    def __init__(self, ny: int, nx: int, latent: int) -> None:
        super().__init__()
        self.encoder = Network(2 * ny, 2 * latent, width=ENCODER, depth=2, activation="tanh")
        self.coefficients = Network(2 * latent, BASES, width=ENCODER, depth=1, activation="tanh")
        self.decoder = Network(2 * latent, nx, width=DECODER, depth=2, activation="tanh")
        angle = torch.logspace(np.log10(SLOWEST), np.log10(FASTEST), latent)
        turn = torch.zeros(2, 2, 2 * BAND + 1, latent)
        turn[[0, 1], [0, 1], BAND] = angle.cos()
        turn[0, 1, BAND], turn[1, 0, BAND] = angle.sin(), -angle.sin()
        self.register_buffer("turn", turn)
        self.turn: torch.Tensor
        self.change = nn.Parameter(torch.randn(BASES, *turn.shape) * UNEVEN / PACE)
        self.log_noise = nn.Parameter(torch.full((2, latent), NOISE).log())
        self.log_start = nn.Parameter(torch.zeros(2, latent))
        self.register_buffer("y_offset", torch.zeros(ny))
        self.register_buffer("y_scale", torch.ones(ny))
        self.y_offset: torch.Tensor
        self.y_scale: torch.Tensor

    def observe(self, y: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latent observations (..., m) of outputs (..., ny) and the feature of their noise, and their variances."""
        seen = torch.cat([(y - self.y_offset) / self.y_scale, noise.expand_as(y)], -1)
        w, raw = self.encoder(seen).chunk(2, -1)
        return w, elu(raw) + 1.0 + LEAST

    def start(self, n: int) -> Belief:
        """Before the first sample, for n rows."""
        variance = self.log_start.exp().expand(n, -1, -1)
        return Belief(torch.zeros_like(variance), variance, torch.zeros_like(variance[:, 0]))

    def predicted(self, belief: Belief) -> Belief:
        """One sample later."""
        share = torch.softmax(self.coefficients(belief.mean.flatten(1)), -1)
        transition = self.turn + PACE * (share @ self.change.flatten(1)).reshape(-1, *self.turn.shape)
        return predict(belief, transition, self.log_noise.exp())

    def decode(self, mean: torch.Tensor) -> torch.Tensor:
        """Scaled estimates (n, nx) of latent means (n, 2, m)."""
        x: torch.Tensor = self.decoder(mean.flatten(1))
        return x


def _begun(cell: Cell, prior: Belief, rows: torch.Tensor) -> Belief:
    """A prediction, but the start in some rows, of bool, (n,), and in those that are no longer finite."""
    finite = torch.stack([part.flatten(1).isfinite().all(-1) for part in prior], -1).all(-1)
    rows, start = (rows | ~finite)[:, None], cell.start(len(rows))
    return Belief(
        torch.where(rows[..., None], start.mean, prior.mean),
        torch.where(rows[..., None], start.variance, prior.variance),
        torch.where(rows, start.side, prior.side),
    )


class _Problem(nn.Module):
    """The cell, and how far it has come along the trajectories: all of it is part of a checkpoint."""

    def __init__(self, task: Task, *, latent: int, chunk: int) -> None:
        super().__init__()
        data, device, noise = task.data, task.device, task.system.measurement_noise
        self.chunks = Chunks(data, noise, samples=chunk, rows=ROWS, device=device)
        self.cell = Cell(data.y.shape[-1], data.x.shape[-1], latent).to(device)
        self.cell.y_offset.copy_(torch.as_tensor(self.chunks.y_offset))
        self.cell.y_scale.copy_(torch.as_tensor(self.chunks.y_scale))
        self.register_buffer("mean", torch.zeros(ROWS, 2, latent, device=device))
        self.register_buffer("variance", torch.zeros(ROWS, 2, latent, device=device))
        self.register_buffer("side", torch.zeros(ROWS, latent, device=device))
        self.mean: torch.Tensor
        self.variance: torch.Tensor
        self.side: torch.Tensor

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Error at the recorded points of the next chunk."""
        chunk = self.chunks.draw(generator)
        belief = Belief(self.mean.clone(), self.variance.clone(), self.side.clone())
        means = []
        for k, (w, variance) in enumerate(zip(*self.cell.observe(chunk.y, chunk.noise), strict=True)):
            prior = self.cell.predicted(belief)
            belief = update(prior if k else _begun(self.cell, prior, chunk.fresh), w, variance)
            means.append(belief.mean)
        self.mean.copy_(belief.mean.detach())
        self.variance.copy_(belief.variance.detach())
        self.side.copy_(belief.side.detach())
        return {"loss": error(self.cell.decode(torch.stack(means)[chunk.recorded]) - chunk.x)}


class RKNObserver:
    """The trained networks as an observer. Rows that are no longer finite begin again with the next sample.

    Shapes: ``noise`` (ny,), a feature.
    """

    def __init__(self, arrays: Arrays, noise: torch.Tensor) -> None:
        self._noise = noise
        self._x_offset, self._x_scale = arrays["x_offset"], arrays["x_scale"]
        self._cell = Cell(len(arrays["y_scale"]), len(self._x_scale), arrays["log_noise"].shape[1])
        weights = {key: torch.as_tensor(value) for key, value in arrays.items() if not key.startswith("x_")}
        self._cell.load_state_dict(weights)

    @torch.no_grad()
    def start(self, n: int) -> Belief:
        """Rows that begin with the next sample, as those that are no longer finite."""
        return Belief(*(torch.full_like(each, torch.nan) for each in self._cell.start(n)))

    @torch.no_grad()
    def advance(self, state: Belief, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> Belief:
        """One sample."""
        prior = _begun(self._cell, self._cell.predicted(state), torch.zeros(len(y), dtype=torch.bool))
        return update(prior, *self._cell.observe(torch.as_tensor(y, dtype=torch.float32), self._noise))

    @torch.no_grad()
    def estimate(self, state: Belief) -> Estimate:
        """The mean, decoded."""
        mean = torch.where(state.mean.isfinite(), state.mean, 0.0)
        return Estimate(np.asarray(self._x_offset + self._x_scale * self._cell.decode(mean).numpy()))
