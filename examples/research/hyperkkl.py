"""``python -m examples.research hyperkkl``: default observers under HyperKKL's protocol (arXiv 2603.29744)."""

# ruff: noqa: D102 - System documents the methods that each system defines

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from rich.console import Console

from kkl_gym.system import Box, Components, System
from training.files import table, write
from training.progress import LOG, progress_bars

if TYPE_CHECKING:
    import pandas as pd

    from observers import Artifact

Input = Literal["zero", "constant", "sinusoid", "square"]
INPUTS: tuple[Input, ...] = ("zero", "constant", "sinusoid", "square")
# Ranges of (amplitude, frequency in rad/s) within HyperKKL's training distribution (False) and beyond it (True).
RANGES: dict[str, dict[bool, tuple[tuple[float, float], tuple[float, float]]]] = {
    "constant": {False: ((-1.0, 1.0), (0.0, 0.0)), True: ((-2.0, 2.0), (0.0, 0.0))},
    "sinusoid": {False: ((0.1, 1.0), (0.5, 3.0)), True: ((1.0, 2.0), (3.0, 6.0))},
    "square": {False: ((0.1, 1.0), (0.5, 2.0)), True: ((1.0, 2.0), (2.0, 4.0))},
}
SETTLING = 5.0  # s; errors before this time of each trial do not count
# The best SMAPE in % that HyperKKL's paper prints for four systems and each of INPUTS, within training's RANGES.
PRINTED: dict[str, tuple[float, float, float, float]] = {
    "duffing": (5.6, 21.1, 22.7, 21.3),
    "van_der_pol": (5.0, 26.0, 15.5, 17.9),
    "rossler": (52.7, 55.4, 53.5, 54.0),
    "fitzhugh_nagumo": (9.8, 42.1, 30.9, 32.5),
}


class Driven:
    """Base of the systems below: samples every 0.05 s, and one input, which stays in [-1, 1] in training.

    ``trial`` is a trial's duration in s, ``noise`` the noise's standard deviation, ``seen`` the measured state's index.
    """

    u_max: ClassVar[tuple[float, ...]] = (1.0,)
    dt: ClassVar[float] = 0.05
    trial: ClassVar[float] = 50.0
    noise: ClassVar[float] = 0.01
    seen: ClassVar[int] = 0

    def h(self, x: Components) -> Components:
        return (x[self.seen],)


class Duffing(Driven, System):
    """x1' = x2, x2' = -x1 - x1^3 + u."""

    name: ClassVar[str] = "duffing"
    X: ClassVar[Box] = ((-1, 1), (-1, 1))
    bounds: ClassVar[Box] = ((-50, 50), (-500, 500))
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,))

    def f(self, x: Components) -> Components:
        return x[1], -x[0] - x[0] * x[0] * x[0]


class VanDerPol(Driven, System):
    """Van der Pol's oscillator with mu = 1."""

    name: ClassVar[str] = "van_der_pol"
    X: ClassVar[Box] = ((-3, 3), (-3, 3))
    bounds: ClassVar[Box] = ((-20, 20), (-50, 50))
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,))

    def f(self, x: Components) -> Components:
        return x[1], (1.0 - x[0] * x[0]) * x[1] - x[0]


class Rossler(Driven, System):
    """Rössler's system with a = b = 0.1 and c = 14; y = x2."""

    name: ClassVar[str] = "rossler"
    X: ClassVar[Box] = ((-10, 10), (-10, 10), (-10, 10))
    bounds: ClassVar[Box] = ((-100, 100), (-100, 100), (-100, 300))
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,), (0.0,))
    seen: ClassVar[int] = 1

    def f(self, x: Components) -> Components:
        return -x[1] - x[2], x[0] + 0.1 * x[1], 0.1 + x[2] * (x[0] - 14.0)


class Lorenz(Driven, System):
    """Lorenz's system with sigma = 10, rho = 28 and beta = 8/3; y = x2."""

    name: ClassVar[str] = "lorenz"
    X: ClassVar[Box] = ((-20, 20), (-30, 30), (0, 50))
    bounds: ClassVar[Box] = ((-100, 100), (-150, 150), (-100, 200))
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (1.0,), (0.0,))
    seen: ClassVar[int] = 1

    def f(self, x: Components) -> Components:
        return 10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1], x[0] * x[1] - 8.0 / 3.0 * x[2]


class FitzHughNagumo(Driven, System):
    """v' = v - v^3 / 3 - w + 0.5 + u, w' = 0.08 (v + 0.7 - 0.8 w)."""

    name: ClassVar[str] = "fitzhugh_nagumo"
    X: ClassVar[Box] = ((-2.5, 2.5), (-1.5, 1.5))
    bounds: ClassVar[Box] = ((-10, 10), (-10, 10))
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((1.0,), (0.0,))
    trial: ClassVar[float] = 100.0

    def f(self, x: Components) -> Components:
        return x[0] - x[0] * x[0] * x[0] / 3.0 - x[1] + 0.5, 0.08 * (x[0] + 0.7 - 0.8 * x[1])


class Traffic(Driven, System):
    """Traffic densities in five cells of a road; the last one is measured, and u adds to the inflow from a ramp."""

    name: ClassVar[str] = "traffic"
    X: ClassVar[Box] = ((0.01, 0.1),) * 5
    bounds: ClassVar[Box] = ((-0.1, 0.25),) * 5
    G: ClassVar[tuple[tuple[float, ...], ...]] = ((0.0,), (0.0,), (1 / 500,), (0.0,), (0.0,))
    trial: ClassVar[float] = 100.0
    noise: ClassVar[float] = 0.001
    seen: ClassVar[int] = 4

    def f(self, x: Components) -> Components:
        flow = [each - each * each / 0.25 for each in x]
        inflow = (1.2 / 500, 0.0, 0.3 / 500, 0.0, 0.0)
        before = (0.0, *flow[:-1])
        return [0.06 * (entering - leaving) + more for entering, leaving, more in zip(before, flow, inflow)]


SYSTEMS = {cls.name: cls for cls in (Duffing, VanDerPol, Rossler, FitzHughNagumo, Traffic, Lorenz)}


@dataclass(frozen=True)
class HyperKKL:
    """Train a default observer for each of HyperKKL's systems, and evaluate it under HyperKKL's inputs.

    Writes OUT/results.csv, OUT/table.md and OUT/NAME.safetensors. Existing observers are not trained again.
    """

    systems: tuple[str, ...] = tuple(SYSTEMS)
    """Names of systems."""
    trials: int = 100
    """Number of starts for each input; they are drawn by Latin hypercube sampling."""
    seed: int = 0
    """Seed of starts, inputs and noise."""
    out: Path = Path("runs/hyperkkl")
    """Folder of results."""

    def run(self, console: Console) -> "pd.DataFrame":
        """Train and evaluate the observers."""
        import pandas as pd  # imported here, so that --help does not wait for it

        from training.diagnosis import check

        if unknown := [name for name in self.systems if name not in SYSTEMS]:
            raise ValueError(f"unknown system {unknown[0]!r}; there are {', '.join(SYSTEMS)}")
        if self.trials < 1:
            raise ValueError(f"trials must be positive, got {self.trials}")
        rows = []
        with progress_bars(console, self.out / LOG) as progress:
            for name in self.systems:
                system = SYSTEMS[name]()
                progress.say(f"{name}: {'; '.join(one.found for one in check(system) if one.check == 'observability')}")
                artifact = self._trained(system, progress)
                with progress.phase(f"measuring {name}"):
                    rows += list(self._measured(system, artifact))
        frame = pd.DataFrame(rows)
        write(self.out / "results.csv", frame.to_csv(index=False, float_format="%.4g"))
        write(self.out / "table.md", page(frame))
        console.print(f"wrote results.csv, table.md and {len(self.systems)} observers in {self.out}")
        return frame

    def _trained(self, system: System, progress: Any) -> "Artifact":
        from observers import Artifact
        from training import train

        path = self.out / f"{system.name}.safetensors"
        if not path.exists():
            train(system, folder=self.out / system.name, resume=True, console=progress).artifact.save(path)
        return Artifact.read(path)

    def _measured(self, system: Any, artifact: "Artifact") -> Iterator[dict[str, Any]]:
        """Yield rows with mean SMAPEs of the observer, its T_inv alone and an extended Kalman filter."""
        from scipy.stats.qmc import LatinHypercube

        from kkl_gym.simulate import simulate
        from training.evaluation.errors import UnseenTrajectories, errors
        from training.seeds import Stream, generator

        low, high = system.box()
        steps = round(system.trial / system.dt)
        for beyond in (False, True):
            for i, kind in enumerate(INPUTS):
                if kind == "zero" and beyond:
                    continue
                rng = generator(Stream.EVALUATION, self.seed, 4, i, int(beyond))
                x0 = low + (high - low) * LatinHypercube(system.nx, rng=rng).random(self.trials)
                u = inputs(kind, beyond, self.trials, system.dt * np.arange(steps), rng)
                x = simulate(system, x0, steps, system.dt, u=u)
                inside = np.isfinite(x[-1]).all(-1)
                runs = UnseenTrajectories(x[:, inside], u[:, inside], inside, system.dt)
                for noise in (0.0, system.noise):
                    how: dict[str, Any] = {"measurement_noise": noise, "seed": self.seed, "skip": SETTLING}
                    observers = {"smape": artifact, "alone": replace(artifact, motion=None), "kalman": None}
                    means = {key: errors(of, system, runs, **how).late.mean() for key, of in observers.items()}
                    spent = artifact.training["cpu_seconds_spent"]
                    case = {"system": system.name, "input": kind, "beyond": beyond, "noise": noise}
                    yield {**case, **means, "escaped": runs.escaped, "train_seconds": spent}


def inputs(kind: Input, beyond: bool, n: int, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return held inputs (steps, n, 1); each trial has its own amplitude and frequency, a sinusoid also its phase."""
    if kind == "zero":
        return np.zeros((len(t), n, 1))
    amplitude, frequency = (rng.uniform(*span, n) for span in RANGES[kind][beyond])
    if kind == "constant":
        u = np.tile(amplitude, (len(t), 1))
    elif kind == "sinusoid":
        u = amplitude * np.sin(np.outer(t, frequency) + rng.uniform(0.0, 2.0 * np.pi, n))
    else:
        u = amplitude * np.sign(np.sin(np.outer(t, frequency)))
    return u[..., None]


def page(frame: "pd.DataFrame") -> str:
    """Return a Markdown table with a row for each system and input; errors of T_inv alone are in brackets."""
    rows = []
    for (name, kind), group in frame.groupby(["system", "input"], sort=False):
        cells = group.set_index(["beyond", "noise"])
        printed = f"{PRINTED[name][INPUTS.index(kind)]:g}" if name in PRINTED else "–"
        cases = [(beyond, level) for beyond in (False, True) for level in sorted(group.noise.unique())]
        figures = [
            f"{_short(cells.loc[case].smape)} ({_short(cells.loc[case].alone)})" if case in cells.index else "–"
            for case in cases
        ]
        rows.append([f"{name.replace('_', ' ')}, {kind}", printed, *figures])
    header = ["SMAPE in %", "HyperKKL's best", "no noise", "noise", "beyond, no noise", "beyond, noise"]
    return "\n".join(table(header, rows)) + "\n"


def _short(value: float) -> str:
    return f"{value:.2g}" if value >= 0.001 else "<0.001"
