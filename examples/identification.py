"""Identify a simulated plant from its outputs, train an observer, and print the errors of parameters and estimates.

The records hold only t and y. First guesses of the parameters are 25 to 50 % off::

    python examples/identification.py lorenz --noise 0.5

docs/guides/identification.md explains the method, and docs/results/identification.md has a table of results.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from observers import Artifact
from observers.names import resolve
from training.evaluation.errors import errors, unseen_trajectories
from training.identification import identify
from training.records import Record
from training.trajectories.motions import draw_process_noise

FIRST_GUESSES = {
    "reverse_duffing": {"b": 0.6},  # y determines b only if a is known
    "van_der_pol": {"mu": 1.5},
    "rossler": {"a": 0.13, "b": 0.28, "c": 4.0},
    "lorenz": {"sigma": 7.0, "rho": 20.0, "beta": 2.0},
}
TRANSIENT = 3.0  # s; errors before this time of each run do not count


@dataclass(frozen=True)
class Found:
    """The errors of the identification and of its observer.

    Parameters
    ----------
    parameters : dict of str to (float, float)
        Error of each parameter in % of its true value, and in standard errors.
    smape, smape_of_default : float
        Median SMAPE in % after 3 s on unseen trajectories, of the trained observer and of the default map, which was
        trained on the exact model.
    """

    parameters: dict[str, tuple[float, float]]
    smape: float
    smape_of_default: float


def main(
    system: tyro.conf.Positional[Literal["reverse_duffing", "van_der_pol", "rossler", "lorenz"]],
    noise: float = 0.0,
    process_noise: float = 0.0,
    records: int = 60,
    seconds: float = 30.0,
    seed: int = 11,
    out: Path | None = None,
    inverse_steps: int | None = None,
) -> Found:
    """Simulate records of a plant, identify it from its outputs, and print all errors.

    Args:
        system: the plant.
        noise: standard deviation of the measurement noise.
        process_noise: bound of the records' process noise, in System.scale per s; environments have 0.05 by default.
        records: number of records.
        seconds: length of each record.
        seed: seed of the records.
        out: the run's folder.
        inverse_steps: batches of the observer's training; fewer than the default are enough for a quick look.
    """
    began, console = time.monotonic(), Console()
    plant, guesses = get_system(system), FIRST_GUESSES[system]
    rng, steps = np.random.default_rng(seed), round(seconds / plant.dt)
    x0 = plant.draw_starts(rng, records)
    w = draw_process_noise(plant, process_noise, n=records, steps=steps, rng=rng) if process_noise else None
    x = simulate(plant, x0, steps, plant.dt, w=w)
    y = plant.output(x) + noise * rng.standard_normal((steps + 1, records, plant.ny))
    t = np.arange(steps + 1) * plant.dt
    learned = identify(
        plant.replace(guesses),
        {name: (value / 10, value * 10) for name, value in guesses.items()},
        [Record(f"record {i + 1}", t, y[:, i]) for i in range(records)],
        out or Path("runs") / f"{system}-identified-{noise:g}",
        settings={} if inverse_steps is None else {"inverse_steps": inverse_steps},
        resume=True,
        console=console,
    )
    took = time.monotonic() - began

    unseen = unseen_trajectories(plant, plant.dt, n=50, duration=30.0, seed=seed)
    observers = (learned.result.artifact, Artifact.read(resolve(system)))
    smape, of_default = (
        float(np.median(errors(one, plant, unseen, measurement_noise=noise, seed=seed, skip=TRANSIENT).late))
        for one in observers
    )
    parameters = {}
    for name, error in learned.identified.standard_errors.items():
        off = learned.identified.system.parameters[name] - plant.parameters[name]
        parameters[name] = (100 * off / plant.parameters[name], np.nan if error is None else off / error)
        console.print(f"{name}: {parameters[name][0]:+.2g} %, {parameters[name][1]:+.1f} standard errors")
    console.print(f"SMAPE after {TRANSIENT:g} s: {smape:.3g} %, default map {of_default:.3g} %; it took {took:.0f} s")
    return Found(parameters, smape, of_default)


if __name__ == "__main__":
    tyro.cli(main)
