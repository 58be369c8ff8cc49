"""KalmanNet: a Kalman filter whose gain is the output of a recurrent network (Revach et al., 2022)."""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import nn

from examples.research.methods.base import Arrays, Configuration, Data, Method, Task
from examples.research.methods.chunks import Chunks, error, noise_feature, varying
from kkl_gym.simulate import SubstepsError, advance_batch
from kkl_gym.system import System
from observers.estimator import Estimate, Estimator
from training.evaluation.levels import Level
from training.maps.forward import on_tensors
from training.sources.simulated import unknown_start

ROWS = 64
LEARNING_RATE = 5e-3
FAINT = 1e-3  # of a standard deviation: features of innovations are linear below it and logarithmic above
TIMID = 0.1  # part of the usual first weights with which the gain begins
MOVED = 500_000  # states of which the size of a sample's motion is taken, at most twice as many
STEP = 1e-6  # of X's half-width, in numerical derivatives of the motion
STEEPEST = 1e3  # gradient that is led back through a sample; errors that explode say nothing of what came before


class State(NamedTuple):
    """What goes from one sample to the next.

    Shapes: ``x`` (n, nx), ``prior`` (n, nx), ``before`` (n, nx), ``y`` (n, ny), ``hidden`` (n, hidden).
    """

    x: torch.Tensor
    prior: torch.Tensor
    before: torch.Tensor
    y: torch.Tensor
    hidden: torch.Tensor

    def lost(self) -> torch.Tensor:
        """Rows that hold something that is not finite, of bool, (n, 1)."""
        return ~torch.stack([part.isfinite().all(-1) for part in self], -1).all(-1, keepdim=True)


class KalmanNet(Method[Arrays]):
    """The exact model predicts, a recurrent network computes the gain K, and x_hat = prior + K (y - h(prior)).

    G. Revach, N. Shlezinger, X. Ni, A. Lopez Escoriza, R. J. G. van Sloun and Y. C. Eldar, "KalmanNet: neural network
    aided Kalman filtering for partially known dynamics", IEEE Transactions on Signal Processing, 2022. This is their
    first architecture, one GRU between fully connected layers. It sees the differences of two samples, the innovation,
    the difference of two estimates, and the last correction. It knows f and h and no covariance. The noise level
    is an input too, as for the maps here and not in the authors' version: half of its training trajectories carry no
    noise, the others a level up to the system's own.

    The authors' code scales each of the four to unit length, which would leave the sign alone of a single output. Here
    they are scaled by their size in the data, and compressed by asinh. The loss is the mean length of the scaled error
    in place of its square, which transients dominate, at every sample: the model gives the states between the recorded
    ones.
    """

    name: ClassVar[str] = "kalmannet"
    label: ClassVar[str] = "KalmanNet"

    def configurations(self, system: System) -> tuple[Configuration, ...]:
        """Two sizes, two lengths of back-propagation."""
        return ({"hidden": 32, "chunk": 25}, {"hidden": 32, "chunk": 50}, {"hidden": 64, "chunk": 25})

    def train(self, task: Task, configuration: Configuration) -> Arrays:
        """The network and its scaling."""
        torch.manual_seed(task.seed)
        problem = _Problem(task, **configuration)
        try:
            task.fit("kalmannet", problem, problem.loss, LEARNING_RATE)
        except SubstepsError as found:  # estimates go where no motion does, and one of them may be too fast to follow
            raise FloatingPointError(str(found)) from found
        return {key: value.detach().numpy() for key, value in problem.filter.state_dict().items()}

    def observer(self, trained: Arrays, system: System, dt: float, noise: Level) -> Estimator[Any]:
        """The filter for a noise level."""
        return KalmanNetFilter(trained, system, dt, noise)


class Motion:
    """The exact model over one sample, within the system's declared bounds."""

    def __init__(self, system: System, dt: float) -> None:
        self._system, self._dt = system, dt
        self._low, self._high = (np.array(bound, dtype=float) for bound in zip(*system.bounds, strict=True))
        low, high = system.box()
        self._steps = np.diag(STEP * (high - low) / 2)
        self.start, _ = unknown_start(system)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """States (n, nx) one sample later; where the motion escapes, the start."""
        return self._kept(self._moved(x))

    def linearised(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, and its derivative by x, (n, nx, nx): zero where a bound holds a state or the motion escapes."""
        n, nx = x.shape
        moved, *beside = self._moved(np.concatenate([x, *(x + step for step in self._steps)])).reshape(-1, n, nx)
        Phi = np.stack([(one - moved) / step.sum() for one, step in zip(beside, self._steps, strict=True)], -1)
        free = (moved > self._low) & (moved < self._high) & np.isfinite(Phi).all((1, 2))[:, None]
        return self._kept(moved), np.where(free[..., None], Phi, 0.0)

    def _moved(self, x: np.ndarray) -> np.ndarray:
        at = np.ascontiguousarray(x.T)
        return advance_batch(self._system, at, np.zeros((self._system.nu, len(x))), np.zeros_like(at), self._dt).T

    def _kept(self, x: np.ndarray) -> np.ndarray:
        lost = ~np.isfinite(x).all(-1, keepdims=True)
        return np.where(lost, self.start, np.clip(x, self._low, self._high))


class _Advance(torch.autograd.Function):
    """A motion on tensors, with its derivative for torch."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, motion: Motion) -> torch.Tensor:
        moved, Phi = motion.linearised(x.numpy())
        ctx.Phi = torch.as_tensor(Phi)
        return torch.as_tensor(moved)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        (gradient,) = gradients
        length = gradient.norm(dim=-1, keepdim=True)
        back = (gradient * (STEEPEST / length.clamp(min=STEEPEST)))[:, None] @ ctx.Phi
        return back[:, 0], None


class Gain(nn.Module):
    """The filter: prediction by the model, correction by the network's gain."""

    def __init__(self, system: System, dt: float, *, hidden: int) -> None:
        super().__init__()
        nx, ny = system.nx, system.ny
        self._h, self.motion = system.h, Motion(system, dt)
        self.inlet = nn.Linear(3 * ny + 2 * nx, hidden)
        self.gru = nn.GRUCell(hidden, hidden)
        self.outlet = nn.Linear(hidden, hidden)
        self.gain = nn.Linear(hidden, nx * ny)
        with torch.no_grad():
            self.gain.weight.mul_(TIMID)
            self.gain.bias.zero_()
        self.hidden = nn.Parameter(torch.zeros(hidden))
        self.register_buffer("units", torch.ones(2 * (ny + nx), dtype=torch.float64))
        self.register_buffer("ratio", torch.ones(nx, ny, dtype=torch.float64))
        self.units: torch.Tensor
        self.ratio: torch.Tensor
        self._start = torch.as_tensor(self.motion.start)
        self._low, self._high = torch.tensor(system.bounds, dtype=torch.float64).T

    def scale(self, data: Data) -> None:
        """Take units from training data."""
        x, y = data.x.reshape(-1, data.x.shape[-1]), data.y.astype(float)
        x_scale, y_scale = varying(x.std(0)), varying(y.std((0, 1)))
        x = x[:: max(1, len(x) // MOVED)]
        y_units = np.maximum(np.diff(y, axis=0).std((0, 1)), FAINT * y_scale)
        x_units = np.maximum((self.motion(x) - x).std(0), FAINT * x_scale)
        units = np.concatenate([y_units, FAINT * y_scale, x_units, FAINT * x_scale])
        self.units.copy_(torch.as_tensor(units))
        self.ratio.copy_(torch.as_tensor(x_scale[:, None] / y_scale))

    def fresh(self, y: torch.Tensor) -> State:
        """Before the first samples, (n, ny)."""
        x = self._start.expand(len(y), -1)
        return State(x, x, x, y, self.hidden.expand(len(y), -1))

    def predicted(self, state: State) -> torch.Tensor:
        """Prior of the next sample, (n, nx)."""
        if torch.is_grad_enabled():
            prior: torch.Tensor = _Advance.apply(state.x, self.motion)  # type: ignore[no-untyped-call]
            return prior
        return torch.as_tensor(self.motion(state.x.numpy()))

    def corrected(self, state: State, prior: torch.Tensor, y: torch.Tensor, noise: torch.Tensor) -> State:
        """Take in samples (n, ny), given their prior and the feature of their noise, (n, ny)."""
        innovation = y - on_tensors(self._h, prior)
        seen = torch.cat([y - state.y, innovation, state.x - state.before, state.x - state.prior], -1)
        features = torch.cat([torch.asinh(seen / self.units).float(), noise], -1)
        hidden = self.gru(self.inlet(features).relu(), state.hidden)
        gain = self.gain(self.outlet(hidden).relu()).double()
        K = self.ratio * gain.reshape(-1, *self.ratio.shape)
        x = prior + (K @ innovation[..., None])[..., 0]
        # minimum and maximum keep NaN, by which the row is found and begins again.
        return State(torch.minimum(torch.maximum(x, self._low), self._high), prior, state.x, y, hidden)

    def begun(self, state: State, y: torch.Tensor, rows: torch.Tensor) -> tuple[State, torch.Tensor]:
        """Predict the next samples (n, ny), and begin with them in some rows, of bool, (n, 1)."""
        fresh = self.fresh(y)
        state = State(*(torch.where(rows, new, old) for new, old in zip(fresh, state, strict=True)))
        return state, torch.where(rows, fresh.x, self.predicted(state))


class _Problem(nn.Module):
    """The filter, and how far it has come along the trajectories: all of it is part of a checkpoint."""

    def __init__(self, task: Task, *, hidden: int, chunk: int) -> None:
        super().__init__()
        data, system = task.data, task.system
        # The model moves states in NumPy, so that a device of torch's would only wait.
        self.chunks = Chunks(data, system.measurement_noise, samples=chunk, rows=ROWS)
        self.filter = Gain(system, task.budget.dt, hidden=hidden)
        self.filter.scale(data)
        self._motion, self._x0 = self.filter.motion, torch.as_tensor(data.x[0])
        self._x_scale = torch.as_tensor(self.chunks.x_scale)
        self._parts = [system.nx, system.nx, system.nx, system.ny]
        self.register_buffer("state", torch.zeros(ROWS, sum(self._parts), dtype=torch.float64))
        self.register_buffer("memory", torch.zeros(ROWS, hidden))
        self.register_buffer("truth", torch.zeros(ROWS, system.nx, dtype=torch.float64))
        self.truth: torch.Tensor
        self.state: torch.Tensor
        self.memory: torch.Tensor

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean error over the next chunk."""
        chunk = self.chunks.draw(generator)
        y = chunk.y.double()
        x, prior, before, last = torch.split(self.state.clone(), self._parts, -1)
        kept = State(x, prior, before, last, self.memory.clone())
        state, prior = self.filter.begun(kept, y[0], chunk.fresh[:, None] | kept.lost())
        truth = np.where(chunk.fresh[:, None], self._x0[self.chunks.trajectory], self._motion(self.truth.numpy()))
        estimates, truths = [], []
        for k, sample in enumerate(y):
            if k:
                prior, truth = self.filter.predicted(state), self._motion(truth)
            state = self.filter.corrected(state, prior, sample, chunk.noise)
            estimates.append(state.x)
            truths.append(torch.as_tensor(truth))
        self.state.copy_(torch.cat(state[:-1], -1).detach())
        self.memory.copy_(state.hidden.detach())
        self.truth.copy_(truths[-1])
        return {"loss": error((torch.cat(estimates) - torch.cat(truths)) / self._x_scale)}


class KalmanNetFilter:
    """The trained filter as an observer. Rows that are no longer finite begin again with the next sample.

    Shapes: ``noise`` of length ny.
    """

    def __init__(self, arrays: Arrays, system: System, dt: float, noise: Level) -> None:
        self._noise = noise_feature(noise, system)
        self._filter, self._ny = Gain(system, dt, hidden=len(arrays["hidden"])), system.ny
        self._filter.load_state_dict({key: torch.as_tensor(value) for key, value in arrays.items()})

    def start(self, n: int) -> State:
        """Rows that begin with the next sample, as those that are no longer finite."""
        state = self._filter.fresh(torch.zeros(n, self._ny, dtype=torch.float64))
        return state._replace(x=torch.full_like(state.x, torch.nan))

    @torch.no_grad()
    def advance(self, state: State, y: np.ndarray, u: np.ndarray | None = None, dt: float | None = None) -> State:
        """One sample."""
        sample = torch.as_tensor(y, dtype=torch.float64)
        state, prior = self._filter.begun(state, sample, state.lost())
        return self._filter.corrected(state, prior, sample, self._noise.expand(len(y), -1))

    @torch.no_grad()
    def estimate(self, state: State) -> Estimate:
        """The corrected state, or the centre of X where that is not finite."""
        return Estimate(torch.where(state.lost(), self._filter.fresh(state.y).x, state.x).numpy())
