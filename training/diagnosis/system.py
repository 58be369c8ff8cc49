"""Checks of a system before any training: its equations, inputs, motions, sampling and outputs."""

import importlib.util
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from kkl_gym import EquationError
from kkl_gym.compiled import SamplingStep, batch_step, single_step
from kkl_gym.equations import components, input_matrix
from kkl_gym.simulate import simulate
from kkl_gym.system import System
from training.diagnosis.finding import Finding, Verdict, percent
from training.evaluation.levels import Level
from training.trajectories.motions import DRIVEN, Controller, how_to_stay, random_inputs, under_policy

COMPARED = 100  # number of points of X, and of 2X, at which the equations are evaluated
POINTS = 1000  # number of points of X at which outputs are evaluated
MOTIONS = 100  # number of motions; if the system has inputs and no policy is given, half are driven
MANY = 0.5  # it is a problem if a larger share of the free, or of the driven, motions leaves the bounds
# Change of y per sample, in standard deviations of y: a problem above COARSE, a note above JERKY; SMOOTH is advised.
COARSE, JERKY, SMOOTH = 1.0, 0.5, 0.1
STILL = 1e-9  # an output does not move if its range is at most this share of its largest absolute value

COST = {
    "floats": "single environments and observers do not run",
    "arrays": "batches, training and evaluation do not run",
    "symbols": "no Kalman filter, no monitor of nonlinear outputs, no --pipeline spinn, and batches are not compiled",
}


def of_X(system: System, n: int, factor: float = 1.0) -> np.ndarray:
    """Return points (n, nx) of X or of a multiple of X, the same in each call."""
    x = system.draw_starts(np.random.default_rng(1), n, factor)
    if np.shape(x) != (n, system.nx):
        call = f"draw_starts(rng, {n}, {factor:g})"
        raise ValueError(f"{call} returns starts of shape {np.shape(x)}; return ({n}, {system.nx})")
    return x


class Subject:
    """A system, its sampling, and motions for several checks, with the same random numbers each time.

    ``motions`` are states (steps + 1, MOTIONS, nx) and inputs. Each of the ``kinds``, such as free, has equally many
    motions. States are NaN after they leave the bounds. ``stay`` (MOTIONS,) marks the motions that stay within them.
    """

    def __init__(
        self,
        system: System,
        dt: float,
        duration: float,
        policy: Controller | None = None,
        noise: tuple[Level, ...] = (),
    ) -> None:
        self.system, self.dt, self.duration, self.policy, self.noise = system, dt, duration, policy, noise
        self.kinds = ("under the policy",) if policy else ("free", "driven") if system.nu else ("free",)

    @cached_property
    def step(self) -> SamplingStep[np.ndarray]:
        """Function that advances a batch by one sampling interval, compiled where possible."""
        return batch_step(self.system)

    @cached_property
    def motions(self) -> tuple[np.ndarray, np.ndarray]:
        """States and inputs of the motions, which are simulated at the first use."""
        system, rng, steps = self.system, np.random.default_rng(3), max(1, round(self.duration / self.dt))
        x0 = system.draw_starts(rng, MOTIONS)
        if self.policy:
            own = np.arange(MOTIONS) % 4 == 0
            return under_policy(system, self.policy, x0, steps=steps, dt=self.dt, rng=rng, own=own, step=self.step)
        u = np.zeros((steps, MOTIONS, system.nu))
        if system.nu:
            u[:, MOTIONS // 2 :] = random_inputs(system, MOTIONS // 2, steps, dt=self.dt, rng=rng, kinds=DRIVEN)
        return simulate(system, x0, steps, self.dt, u=u, step=self.step), u

    @property
    def stay(self) -> np.ndarray:
        """Mask of the motions that stay within the bounds."""
        return np.isfinite(self.motions[0][-1]).all(-1)

    @property
    def y(self) -> np.ndarray:
        """Outputs (steps + 1, n, ny) of the motions that stay within the bounds."""
        return self.system.output(self.motions[0][:, self.stay])

    @property
    def followed(self) -> tuple[np.ndarray, np.ndarray]:
        """States and inputs of the motions that stay within the bounds, only driven ones if there are inputs."""
        rows = np.flatnonzero(self.stay & (np.arange(MOTIONS) >= MOTIONS - MOTIONS // len(self.kinds)))
        return self.motions[0][:, rows], self.motions[1][:, rows]


def declaration(subject: Subject) -> Iterator[Finding]:
    """Yield the states, inputs and parameters of the system."""
    system = subject.system
    inputs = ", ".join(f"{u_max:g}" for u_max in system.u_max)
    values = ", ".join(f"{name} = {value:g}" for name, value in system.parameters.items())
    text = f"{system.name}: states {', '.join(system.state_names)}; inputs {f'up to {inputs}' if inputs else 'none'}"
    yield Finding("system", "ok", f"{text}; parameters {values or 'none'}")


def equations(subject: Subject) -> Iterator[Finding]:
    """Check whether the equations work on floats, arrays and symbols, and give finite numbers."""
    import sympy

    system, works = subject.system, list[str]()
    x = np.concatenate([of_X(system, COMPARED), of_X(system, COMPARED, 2.0)])
    symbols = list(sympy.symbols(f"x:{system.nx}", real=True))
    for kind, states in {"floats": x.tolist(), "arrays": [x.T], "symbols": [symbols]}.items():
        try:
            with np.errstate(all="ignore"):
                values = [_everything(system, state) for state in states]
        except (EquationError, NotImplementedError) as error:
            # Where floats raise at 1 / 0, arrays give infinity, which is reported below.
            if kind != "floats" or not isinstance(error.__cause__, ArithmeticError):
                verdict: Verdict = "note" if kind == "symbols" else "problem"
                yield Finding("equations", verdict, f"on {kind}: {error}", f"as it is, {COST[kind]}")
                continue
        works.append(kind)
        if kind == "arrays":
            rows = [np.broadcast_to(np.asarray(value, dtype=float), len(x)) for value in values[0]]
            bad = ~np.isfinite(np.array(rows)).all(0)
            if bad.any():
                shares = f"{percent(bad[:COMPARED].mean())} of X and {percent(bad[COMPARED:].mean())} of 2X"
                point = ", ".join(f"{value:.3g}" for value in x[bad][0])
                text = f"the equations are not finite in {shares}, such as at x = ({point})"
                advice = "choose X and the bounds where the equations hold, or change the equations"
                yield Finding("equations", "problem", text, advice)
            for j in range(0 if system.discrete else system.nu):
                if not np.any(rows[system.nx + j : system.nx * (1 + system.nu) : system.nu]):
                    advice = f"give column {j + 1} of G or g(x) a nonzero entry"
                    yield Finding("equations", "problem", f"input {j + 1} moves no state", advice)
    if works:
        parts = "step and h" if system.discrete else "f, g and h"
        yield Finding("equations", "ok", f"{parts} work on {', '.join(works)}")


def _everything(system: System, x: Any) -> list[Any]:
    """Return all values of the equations at a state in one list."""
    if system.discrete:
        return [*components(system.step, x, [0.5 * u_max for u_max in system.u_max]), *components(system.h, x)]
    g = [gij for row in input_matrix(system, x) for gij in row]
    return [*components(system.f, x), *g, *components(system.h, x)]


def machine_code(subject: Subject) -> Iterator[Finding]:
    """Check whether batches and single environments run as machine code."""
    obstacle = subject.step.obstacle
    if importlib.util.find_spec("numba") is None:
        yield Finding("compiled", "note", "Numba is not installed: training is slower", 'pip install "kkl-gym[fast]"')
    elif subject.system.discrete:
        yield Finding("compiled", "ok", "nothing to compile: the system is not integrated")
    elif obstacle is not None:
        advice = "write the equations in arithmetic and functions of kkl_gym.elementary, if speed matters"
        yield Finding("compiled", "note", f"batches run on NumPy, several times slower: {obstacle}", advice)
    else:
        slow = single_step(subject.system).obstacle
        singly = "and so do single ones" if slow is None else f"single ones take their steps in Python ({slow})"
        yield Finding("compiled", "ok", f"large batches of environments run as machine code, {singly}")


def bounds(subject: Subject) -> Iterator[Finding]:
    """Check whether motions from X stay within the bounds."""
    (x, _), lost = subject.motions, ~subject.stay
    followed = f"{len(lost)} motions of {subject.duration:g} s from X"
    if not lost.any():
        yield Finding("bounds", "ok", f"all of {followed}, {' and '.join(subject.kinds)}, stay within the bounds")
        return
    counts = np.split(lost, len(subject.kinds))
    parts = [f"{one.sum()} of {len(one)} {kind}" for one, kind in zip(counts, subject.kinds)]
    when = subject.dt * np.median(np.isfinite(x[:, lost]).all(-1).sum(0))
    text = f"of {followed}, {' and '.join(parts)} leave the bounds, after {when:.3g} s at the median"
    many = max(one.mean() for one in counts) > MANY
    yield Finding("bounds", "problem" if many else "note", text, how_to_stay(subject.system, subject.policy))


def sampling(subject: Subject) -> Iterator[Finding]:
    """Check how much the outputs change from sample to sample."""
    dt, y, change = subject.dt, subject.y, 0.0
    text = f"dt = {dt:g} s, motions of {subject.duration:g} s"
    if y.size and np.any(moving := (spread := np.sqrt(y.var(0).mean(0))) > 0):
        change = (np.sqrt((np.diff(y, axis=0) ** 2).mean((0, 1)))[moving] / spread[moving]).max()
        text += f"; y changes by {percent(change)} of its standard deviation from sample to sample"
    limits = (np.inf, np.inf) if subject.system.discrete else (COARSE, JERKY)  # discrete: no motion between steps
    verdict: Verdict = "problem" if change > limits[0] else "note" if change > limits[1] else "ok"
    advice = {"problem": "the motion between samples is lost", "note": "samples are few", "ok": ""}[verdict]
    if advice:
        advice += f": take dt = {dt * SMOOTH / change:.1g} s"
    yield Finding("sampling", verdict, text, advice)


def outputs(subject: Subject) -> Iterator[Finding]:
    """Check whether each output moves, and yield its range and noise."""
    system, y, moving = subject.system, subject.system.output(of_X(subject.system, POINTS)), subject.y
    levels = np.broadcast_to(np.asarray(system.measurement_noise, dtype=float), (system.ny,))
    for i, level in enumerate(levels):
        name, size, along = f"y{i + 1}", float(np.ptp(y[:, i])), ""
        if size <= STILL * np.abs(y[:, i]).max():
            advice = "let h measure something that moves, or leave this output out"
            yield Finding("output", "problem", f"{name} is {y[0, i]:.4g} everywhere in X", advice)
            continue
        if moving.size:
            along = f", {np.ptp(moving[..., i]):.3g} along motions"
        noise = f"noise {level:.3g} by default, {percent(level / size)} of the range in X"
        yield Finding("output", "ok", f"{name} ranges over {size:.3g} in X{along}; {noise}")
