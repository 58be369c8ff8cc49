"""A flow over many samples: where motions are then, and what its training minimises."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from kkl_gym.simulate import SubstepsError, simulate
from kkl_gym.system import System
from observers import Flow
from observers.polynomial import products
from training.maps.networks import Network
from training.maps.optimise import optimise_at_once
from training.progress import ProgressBars

SAMPLES = 100  # of a course, at most
EVERY = 10  # samples between looks at the errors
COURSES = 20_000  # at most
BATCH, LEARNING_RATE = 128, 2e-4
LEAST = 0.01  # of the mean square of the steps, added to it: where a motion hardly moves, errors are not relative to it
TAIL = 30.0  # times the usual square, from which errors count less: near a watershed the least one grows without end
ENOUGH = 2e-4  # of a sample: a flow that is late by no more is left as it is
JUDGED = 1000  # courses that are not learned from


@dataclass(frozen=True)
class Courses:
    """Motions (samples + 1, n, nx) from many states, over up to ``SAMPLES`` samples, under inputs that are held."""

    x: np.ndarray
    u: np.ndarray


def draw_courses(system: System, x: np.ndarray, u: np.ndarray, dt: float, *, samples: int = SAMPLES) -> Courses:
    """Simulate motions. Shapes: ``x`` (n, nx), ``u`` (n, nu)."""
    x, u, samples = x[:COURSES], u[:COURSES], min(samples, SAMPLES)
    try:
        later = simulate(system, x, samples, dt, u=np.broadcast_to(u, (samples, *u.shape)) if u.shape[1] else None)
    except SubstepsError:
        return Courses(np.empty((samples + 1, 0, system.nx)), u[:0])
    inside = np.isfinite(later).all((0, 2))
    return Courses(later[:, inside], u[inside])


def learn_ahead(
    flow: Flow, courses: Courses, *, steps: int, seed: int, progress: ProgressBars, device: torch.device | None = None
) -> Flow:
    """Teach a flow that knows single samples what many of them add up to."""
    if courses.x.shape[1] < 2 * JUDGED:
        return flow
    problem = AheadProblem(flow, courses, device=device or torch.device("cpu"))
    if problem.before <= ENOUGH:
        return flow
    try:
        optimise_at_once("ahead", problem, problem.loss, progress, steps=steps, learning_rate=LEARNING_RATE, seed=seed)
    except (FloatingPointError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]  # gradients overflowed
        return flow
    return problem.flow() if problem.judged() < problem.before else flow


class AheadProblem(nn.Module):
    """A flow, on what it makes of many samples in a row.

    What a flow is off by in a sample may be tiny, and still always point the same way: on a limit cycle it is then
    ahead of the motion, or late, by more and more. So errors are taken along courses. They are relative to how far the
    motion moves in a sample, which is what being late by one costs, and to the root of the number of samples.

    The network is trained, and the polynomial: its terms that are 0 stay so. Both in double precision, as rounding adds
    up too.
    """

    def __init__(self, flow: Flow, courses: Courses, *, device: torch.device) -> None:
        super().__init__()

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float64, device=device)

        self._flow = flow
        self.network = Network.of(flow.mlp).double().to(device)
        self.correction = nn.Parameter(torch.zeros(flow.polynomial.shape, dtype=torch.float64, device=device))
        self._polynomial, self._gain = tensor(flow.polynomial), tensor(flow.gain)
        self._low, self._high = (tensor(bound) for bound in flow.scaled_bounds)
        self._s, self._v = tensor((courses.x - flow.x_offset) / flow.x_scale), tensor(courses.u / flow.u_scale)
        moved = self._s.diff(dim=0).square().mean(-1)
        self._weight = 1.0 / (moved + LEAST * moved.mean()).clamp(min=torch.finfo(torch.float64).tiny)
        made_of = products(flow.nx + flow.nu, flow.degree)
        self._products = [tuple(torch.tensor(each, device=device) for each in part[1:]) for part in made_of]
        self.before = self.judged()

    def flow(self) -> Flow:
        """The flow as it is now."""
        with torch.no_grad():
            polynomial = self._corrected().cpu().numpy()
        return dataclasses.replace(self._flow, mlp=self.network.export(), polynomial=polynomial)

    def judged(self) -> float:
        """Root of the median squared error, on courses that are not learned from."""
        with torch.no_grad():
            return float(self._squares(torch.arange(JUDGED, device=self._s.device)).median().sqrt())

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean logarithm of the squared errors of a batch, which large ones hardly move."""
        rows = torch.randint(JUDGED, self._s.shape[1], (BATCH,), generator=generator, device=self._s.device)
        squares = self._squares(rows)
        loss = torch.log1p(squares / (TAIL * self.before**2)).mean()
        return {"loss": loss, "error": squares.detach().median().sqrt()}

    def _corrected(self) -> torch.Tensor:
        return self._polynomial + (self._polynomial != 0) * self._gain[:, None] * self.correction

    def _squares(self, rows: torch.Tensor) -> torch.Tensor:
        """Squared errors along courses, (samples that are looked at, rows)."""
        s, v, polynomial, found = self._s[0, rows], self._v[rows], self._corrected(), []
        for k in range(1, len(self._s)):
            inputs = torch.cat([s, v], -1)
            s = s + self._monomials(inputs) @ polynomial.T + self._gain * self.network(inputs)
            s = s.clamp(self._low, self._high)  # as a tracker does
            if k == 1 or k % EVERY == 0:
                found.append(self._weight[k - 1, rows] * (s - self._s[k, rows]).square().mean(-1) / k)
        return torch.stack(found)

    def _monomials(self, q: torch.Tensor) -> torch.Tensor:
        """What :func:`observers.polynomial.monomials` is to NumPy."""
        terms = torch.cat([torch.ones_like(q[..., :1]), q], -1)
        for earlier, by in self._products:
            terms = torch.cat([terms, terms[..., earlier] * q[..., by]], -1)
        return terms


__all__ = ["AheadProblem", "Courses", "draw_courses", "learn_ahead"]
