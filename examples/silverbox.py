"""The Silverbox, a standard benchmark of nonlinear identification: measurements of an electronic Duffing oscillator.

The data are not part of this project. nonlinearbenchmark.org offers SNLS80mV.csv, with columns V1 (input) and V2
(output) and 131,072 samples at 610.35 Hz. docs/results/silverbox.md has assumptions and results. Usage::

    python examples/silverbox.py SNLS80mV.csv
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pandas as pd
import tyro
from rich.console import Console
from rich.table import Table

import kkl_gym
from kkl_gym.simulate import advance
from training.figures import ALARM, RIVAL, drawing
from training.identification import estimate_parameters
from training.identification.motions import Problem, Shooting
from training.identification.windows import windows
from training.progress import LOG, progress_bars
from training.records import Record

DT = 2**14 / 1e7  # s
FILE = "SNLS80mV.csv"
SAMPLES = 131_072
# The initial state of each test is fitted to this number of first samples; their errors do not count.
FREE = 50
# Samples of the first three quarters of the multisine, and of its last quarter.
TRAINING, MULTISINE = (40_650, 105_712), (105_712, 127_400)
# Samples of the arrow (noise of growing amplitude), and of its part within the range of the training's outputs.
ARROW, ARROW_INSIDE = (100, 40_575), (100, 32_100)
# Number of records from the training part, and samples in each. One record is held out, to test predictions.
RECORDS, LENGTH = 8, 2_048
LIMITS = {
    "damping": (6.0, 600.0),
    "stiffness": (3e4, 3e6),
    "square": (-1e5, 1e5),
    "cube": (4e4, 4e6),
    "offset": (-1e4, 1e4),
    "gain": (1e4, 1e6),
    "before": (-1.0, 1.0),
    "after": (-1.0, 1.0),
}
PUBLISHED = {"NARX (SysIdentPy)": (7.73, 4.15, 2.23), "SUBNET, nx = 4": (None, 6.79, 2.24)}  # mV rms


@dataclass(frozen=True)
class Silverbox(kkl_gym.System):
    """A forced Duffing oscillator, y'' = -damping y' - (stiffness + square y + cube y^2) y + offset + gain u(t).

    The generator's input is smooth between samples, but the simulation holds its input over an interval. A weighted sum
    of V1 at the interval's first sample and at its two neighbours has the smooth input's effect. For slow signals
    the weights before = -1/6 and after = 1/3 are right to second order.
    """

    damping: float = 60.0  # 1/s
    stiffness: float = 2.6e5  # 1/s^2
    square: float = 0.0  # 1/(V s^2)
    cube: float = 4e5  # 1/(V^2 s^2)
    offset: float = 0.0  # V/s^2
    gain: float = 1.2e5  # 1/s^2
    before: float = 0.0  # weights of neighbouring samples; the sample's own is 1 - before - after
    after: float = 0.0

    name: ClassVar[str] = "silverbox"
    state_names: ClassVar = ("position in V", "velocity in V/s")
    X: ClassVar = ((-0.3, 0.3), (-130.0, 130.0))  # ranges of the outputs and of their difference quotients
    bounds: ClassVar = ((-3.0, 3.0), (-1300.0, 1300.0))
    u_max: ClassVar = (0.15, 0.15, 0.15)  # V
    dt: ClassVar[float] = DT

    def f(self, x):
        """Drift."""
        y, v = x
        return v, self.offset - self.damping * v - (self.stiffness + (self.square + self.cube * y) * y) * y

    def g(self, x):
        """Input matrix."""
        at = 1.0 - self.before - self.after
        return (0.0, 0.0, 0.0), (self.gain * self.before, self.gain * at, self.gain * self.after)

    def h(self, x):
        """Output."""
        return (x[0],)

    def rate(self, x):
        """Return the frequency of small motions about x, in rad/s."""
        return abs(self.stiffness + (2.0 * self.square + 3.0 * self.cube * x[0]) * x[0]) ** 0.5


def read(path: Path) -> np.ndarray:
    """Read input and output in V, (131072, 2), from the file or the folder that holds it."""
    path = path / FILE if path.is_dir() else path
    data = pd.read_csv(path, usecols=["V1", "V2"])[["V1", "V2"]].to_numpy(float)
    if data.shape != (SAMPLES, 2):
        raise ValueError(f"{path} has {len(data)} samples, but the Silverbox has {SAMPLES}")
    return data


def part(data: np.ndarray, begin: int, end: int) -> Record:
    """Return a part of the samples as a record, with the inputs before, at and after each sample."""
    u = np.stack([data[begin + shift : end + shift, 0] for shift in (-1, 0, 1)], axis=-1)
    return Record(f"[{begin}:{end}]", DT * np.arange(end - begin), data[begin:end, 1:], u)


def simulated(system: Silverbox, record: Record) -> np.ndarray:
    """Return outputs (n,) of a simulation from inputs only; its initial state is fitted to the first samples."""
    theta = np.array([system.parameters[name] for name in LIMITS])
    first = {(0, 0): np.array([record.y[0, 0], 0.0])}
    shooting = Shooting(system, DT, LIMITS, np.ones(len(theta)))
    x = Problem(shooting, windows([record], first, FREE - 1)).settled(theta).x0[0].tolist()
    y = [x[0]]
    for u in record.u[:-1].tolist():
        x = advance(system, x, u, (0.0, 0.0), DT)
        y.append(x[0])
    return np.array(y)


def main(path: Annotated[Path, tyro.conf.Positional], out: Path = Path("runs/silverbox"), seed: int = 0) -> list[float]:
    """Identify, simulate the tests, print a table and draw a figure.

    Returns the errors in mV rms on the multisine's test quarter, the arrow, and the arrow without extrapolation.

    Args:
        path: SNLS80mV.csv, or the folder that holds it.
        out: the run's folder.
        seed: seed of the fit's random numbers.
    """
    data, console = read(path), Console()
    out.mkdir(parents=True, exist_ok=True)
    begins = np.linspace(TRAINING[0], TRAINING[1] - LENGTH, RECORDS).astype(int)
    records = [part(data, begin, begin + LENGTH) for begin in begins]
    with progress_bars(console, out / LOG) as progress:
        found = estimate_parameters(Silverbox(), LIMITS, records, progress=progress, seed=seed)
        for line in found.summary():
            progress.say(line)

    tests = {"multisine": part(data, *MULTISINE), "arrow": part(data, *ARROW)}
    y = {name: simulated(found.system, record) for name, record in tests.items()}
    residuals = {name: 1e3 * (record.y[:, 0] - y[name]) for name, record in tests.items()}
    inside = residuals["arrow"][: ARROW_INSIDE[1] - ARROW_INSIDE[0]]
    errors = [float(np.sqrt(np.mean(r[FREE:] ** 2))) for r in (*residuals.values(), inside)]

    table = Table("", "multisine", "arrow", "arrow without extrapolation", title="simulated outputs, mV rms")
    for name, values in {"Duffing equation, identified here": errors, **PUBLISHED}.items():
        table.add_row(name, *("" if value is None else f"{value:.2f}" for value in values))
    console.print(table)
    draw(out / "silverbox.png", tests, residuals)
    console.print(f"wrote {out / 'silverbox.png'}")
    return errors


def draw(path: Path, tests: dict[str, Record], residuals: dict[str, Any]) -> None:
    """Draw the measured outputs, and their differences from the simulated outputs."""
    with drawing(path, 10, 5) as figure:
        axes = figure.subplots(2, len(tests), sharex="col", sharey="row")
        for (above, below), (name, record) in zip(axes.T, tests.items(), strict=True):
            above.plot(record.t, record.y, color=RIVAL, lw=0.3)
            below.plot(record.t[FREE:], residuals[name][FREE:], color=ALARM, lw=0.3)
            above.set(title=name, ylabel="V2 in V")
            below.set(xlabel="t in s", ylabel="V2 - simulated V2 in mV")


if __name__ == "__main__":
    tyro.cli(main)
