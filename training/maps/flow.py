"""The system's motion over one sample, as a polynomial and a network: its data, and what its training minimises."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import Factors, Flow
from observers.polynomial import count, monomials
from training.maps.networks import Network, tensor
from training.maps.optimise import optimise_at_once
from training.progress import ProgressBars
from training.trajectories.controllers import Controller
from training.trajectories.record import Motions, trajectories
from training.trajectories.signals import DRIVEN

REACH = 1.5  # of X, from which motions start
RUNS = 300  # of motions without input, and as many under inputs
STATES = 200_000  # along them, at most
PAIRS = 400_000
# States are moved off the motions, as estimates are off: by this many standard deviations of the states, log-uniform,
# most of them near and some far. That a tracker does not leave the motions it is the near ones that decide.
NEAR, FAR, FAR_SHARE = (1e-4, 0.05), (0.05, 0.3), 0.25
STILL = 0.5  # share of the pairs without input, where there are inputs
BATCH, LEARNING_RATE = 1024, 3e-3
# A polynomial of higher degree is taken where it alone is usually off by less than that part of a state's standard
# deviation. The network then has little to say. Elsewhere it would have to make up for powers that grow without end:
# then it is a wide one, beside a linear fit.
LITTLE = 1e-4
MOST_TERMS, HIGHEST_DEGREE = 60, 5  # of polynomials
# Where those leave more, higher degrees are tried. Most of their terms do not matter, and are left out.
MOST_OF_HIGHER, HIGHEST = 120, 7
NARROW, WIDE = (8, 2), (24, 2)  # neurons in each hidden layer, and how many there are
SMALL_NARROW, SMALL_WIDE = (4, 1), (12, 2)  # of small flows; those of higher degrees have the usual one
# The polynomials of small flows, and those of higher degrees, lack terms that move a state by less than that part of
# what they leave, or than that many standard deviations. The others are then fitted again (S. L. Brunton et al., Proc.
# Natl. Acad. Sci. 113, 2016).
NEGLIGIBLE, INVISIBLE = 0.3, 1e-6
OF_MEDIAN = 1.4826  # a normal distribution's standard deviation, over the median of its absolute values
FARTHEST = 0.1  # share of the increments, of the longest, from which it is found how errors grow with them
LEAST_BEND = 0.1  # of that: less would hardly change a covariance, unless a state crosses its range in a sample
TINY = np.finfo(float).tiny
LEAST = 0.01  # of the mean square of scaled increments, added to it: errors of smaller ones are not taken relative


@dataclass(frozen=True)
class Increments:
    """States (n, nx), inputs (n, nu), and how states change over a sample."""

    x: np.ndarray
    u: np.ndarray
    change: np.ndarray
    x_offset: np.ndarray
    x_scale: np.ndarray

    def part(self, rows: slice) -> "Increments":
        """Some of them."""
        return replace(self, x=self.x[rows], u=self.u[rows], change=self.change[rows])


def draw_increments(
    system: System, dt: float, *, duration: float, nu: int, rng: np.random.Generator, policy: Controller | None = None
) -> Increments:
    """Simulate motions, and from states about them one sample further."""
    steps = round(duration / dt)
    kinds: list[Motions] = [] if policy and nu else [Motions(box_factor=REACH)]
    if nu:
        kinds.append(Motions(kinds=DRIVEN, box_factor=REACH, policy=policy))
    every = max(1, steps * RUNS * len(kinds) // STATES)
    along = np.concatenate(
        [
            x[::every].reshape(-1, system.nx)
            for motions in kinds
            for x, _, _ in trajectories(system, n=RUNS, steps=steps, dt=dt, rng=rng, motions=motions)
        ]
    )
    offset, scale = along.mean(0), along.std(0)
    scale = np.where(scale > 0, scale, 1.0)
    low, high = (np.array(bound) for bound in zip(*system.bounds, strict=True))
    far = rng.random((PAIRS, 1)) < FAR_SHARE
    size = np.where(far, _log_uniform(rng, FAR), _log_uniform(rng, NEAR))
    x = along[rng.integers(len(along), size=PAIRS)] + size * scale * rng.standard_normal((PAIRS, system.nx))
    x = np.clip(x, low, high)
    u = np.zeros((PAIRS, system.nu))
    if nu:
        u = np.where(rng.random((PAIRS, 1)) < STILL, 0.0, rng.uniform(-1, 1, (PAIRS, nu)) * system.u_max)
    later = simulate(system, x, 1, dt, u=u[None] if nu else None)[-1]
    inside = np.isfinite(later).all(-1)
    return Increments(x[inside], u[inside, :nu], (later - x)[inside], offset, scale)


def _log_uniform(rng: np.random.Generator, ends: tuple[float, float]) -> np.ndarray:
    return np.exp(rng.uniform(np.log(ends[0]), np.log(ends[1]), (PAIRS, 1)))


class FlowProblem(nn.Module):
    """The network of :class:`observers.Flow`, on what a polynomial (nx, terms) leaves of the increments."""

    def __init__(
        self, increments: Increments, u_scale: np.ndarray, *, degrees: Sequence[int], small: bool, device: torch.device
    ) -> None:
        super().__init__()
        inputs = scaled_inputs(increments, u_scale)
        change = increments.change / increments.x_scale
        for degree in degrees:
            self.polynomial, left = _fitted(inputs, change, degree)
            little = _is_little(left)
            if little:
                break
        higher = little and degree != degrees[0]
        if not little and degree > 1:
            self.polynomial, left = _fitted(inputs, change, 1)
        elif higher or (small and degree > 1):
            thinned = _thinned(inputs, change, self.polynomial, degree)
            if _is_little(thinned[1]):
                self.polynomial, left = thinned
        narrow, wide = (SMALL_NARROW, SMALL_WIDE) if small and not higher else (NARROW, WIDE)
        width, depth = narrow if little else wide
        self.gain = left.std(0)
        left = left / np.where(self.gain > 0, self.gain, 1.0)
        self.network = Network(inputs.shape[1], change.shape[1], width=width, depth=depth, activation="tanh").to(device)
        self._inputs, self._left = tensor(inputs, device), tensor(left, device)
        self._weight = tensor(1.0 / ((left**2).mean(-1) + LEAST), device)

    def loss(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Mean square error of a batch, relative to what the polynomial leaves of each sample."""
        rows = torch.randint(len(self._inputs), (BATCH,), generator=generator, device=self._inputs.device)
        square = (self.network(self._inputs[rows]) - self._left[rows]).square().mean(-1)
        loss = (self._weight[rows] * square).mean()
        return {"loss": loss, "error": loss.detach().sqrt()}


def _is_little(left: np.ndarray) -> bool:
    """Whether what a polynomial leaves is usually little."""
    return bool(np.median(np.abs(left), axis=0).max() < LITTLE)


def _fitted(inputs: np.ndarray, change: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """A polynomial by least squares, (nx, terms), and what it leaves."""
    terms = monomials(inputs, degree)
    polynomial = np.linalg.lstsq(terms, change, rcond=None)[0].T
    return polynomial, change - terms @ polynomial.T


def _thinned(
    inputs: np.ndarray, change: np.ndarray, polynomial: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """A polynomial without terms that are negligible beside what it leaves, (nx, terms), and what it leaves then."""
    terms = monomials(inputs, degree)
    sizes, left = np.sqrt((terms**2).mean(0)), change - terms @ polynomial.T
    polynomial = polynomial.copy()
    for coefficients, target, off in zip(polynomial, change.T, left.std(0), strict=True):
        while True:
            used = np.flatnonzero(coefficients)
            negligible = np.abs(coefficients[used]) * sizes[used] < max(NEGLIGIBLE * off, INVISIBLE)
            if not negligible.any():
                break
            coefficients[used[negligible]] = 0.0
            kept = used[~negligible]
            coefficients[kept] = np.linalg.lstsq(terms[:, kept], target, rcond=None)[0]
    return polynomial, change - terms @ polynomial.T


def possible_degrees(variables: int) -> list[int]:
    """Find the degrees of polynomials that are tried, one after the other."""
    usual = max(k for k in range(1, HIGHEST_DEGREE + 1) if k == 1 or count(variables, k) <= MOST_TERMS)
    return [usual, *(k for k in range(usual + 1, HIGHEST + 1) if count(variables, k) <= MOST_OF_HIGHER)]


def scaled_inputs(increments: Increments, u_scale: np.ndarray) -> np.ndarray:
    """What a flow's network is given, (n, nx + nu)."""
    s = (increments.x - increments.x_offset) / increments.x_scale
    return np.column_stack([s, increments.u / u_scale])


def fit_flow(
    increments: Increments,
    u_scale: np.ndarray,
    *,
    degrees: Sequence[int],
    steps: int,
    seed: int,
    progress: ProgressBars,
    small: bool = False,
    device: torch.device | None = None,
    **of_plant: Any,
) -> Flow:
    """Fit a flow. Shapes: ``u_scale`` (nu,)."""
    device = device or torch.device("cpu")
    problem = FlowProblem(increments, u_scale, degrees=degrees, small=small, device=device)
    optimise_at_once(
        "flow", problem.network, problem.loss, progress, steps=steps, learning_rate=LEARNING_RATE, seed=seed
    )
    return Flow(
        problem.network.export(),
        x_offset=increments.x_offset,
        x_scale=increments.x_scale,
        u_scale=u_scale,
        gain=problem.gain,
        polynomial=problem.polynomial,
        error=np.zeros(len(increments.x_scale)),
        factors=Factors(np.zeros(1), np.zeros(1), np.ones((1, 1))),
        **of_plant,
    )


def usual_error(flow: Flow, increments: Increments) -> np.ndarray:
    """Find what a flow is usually off by after a sample. Shapes: returns (nx,)."""
    return np.asarray(OF_MEDIAN * np.median(_missed(flow, increments), axis=0))


def _missed(flow: Flow, increments: Increments) -> np.ndarray:
    """How far a flow is off after a sample, in scaled states, (n, nx)."""
    return np.asarray(np.abs(flow(increments.x, increments.u) - increments.x - increments.change) / flow.x_scale)


def usual_bend(flow: Flow, increments: Increments) -> np.ndarray | None:
    """Find what a flow is usually off by where states move far within a sample. Shapes: returns (nx,), or None."""
    moved = ((increments.change / flow.x_scale) ** 2).sum(-1)
    far = moved >= np.quantile(moved, 1 - FARTHEST)
    shares = _missed(flow, increments)[far] / np.maximum(moved[far, None], TINY)
    bend = np.asarray(OF_MEDIAN * np.median(shares, axis=0))
    return bend if bend.max() >= LEAST_BEND else None
