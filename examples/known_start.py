"""Two uses of a learned forward map T: starts without a transient, and z - T(x_hat), which reveals a biased sensor."""

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import kkl_gym
import observers
from kkl_gym.simulate import simulate

DT = 0.01  # s


def main(runs: int = 200, measurement_noise: float = 0.0, bias: float = 1.0, seed: int = 0) -> dict[str, list[float]]:
    """Print median errors and mismatches, over all runs, of each system's SPINN observer; returns them by system.

    The errors are |x_hat - x| / |x|, taken 0, 0.5 and 2 s after a start in X: for known x0, then for unknown x0.
    ``observer.mismatch`` is taken after 20 s, in runs without a fault and in the same runs with a sensor that is
    biased from 15 s on.

    Args:
        runs: number of runs.
        measurement_noise: standard deviation on each sample of y.
        bias: bias of the sensor from 15 s on.
        seed: seed of starts and noise.
    """
    ages = (0.0, 0.5, 2.0)
    table = Table("system", "x0 known", "unknown", "mismatch, no fault / biased", title="error after 0, 0.5 and 2 s")
    found = {}
    for name in kkl_gym.SYSTEMS:
        system, rng = kkl_gym.get_system(name), np.random.default_rng(seed)
        x = simulate(system, rng.uniform(*system.box(), (runs, system.nx)), 2000, DT)
        y = system.output(x) + measurement_noise * rng.standard_normal((len(x), runs, system.ny))
        observer = observers.load(f"{name}-spinn", measurement_noise)
        errors = [
            np.median(np.linalg.norm(x_hat[k] - x[k], axis=-1) / np.linalg.norm(x[k], axis=-1))
            for x_hat in (observer.estimate(y, x0=x[0]), observer.estimate(y))
            for k in (round(age / DT) for age in ages)
        ]
        mismatches = []
        for offset in (0.0, bias):
            observer.reset(y[0])
            for k in range(1, len(y)):
                observer.advance(y[k] + (offset if k > 1500 else 0.0))
            mismatches.append(np.median(observer.mismatch))
        found[name] = [float(value) for value in (*errors, *mismatches)]
        shown = [f"{value:.1g}" for value in found[name]]
        table.add_row(name.replace("_", " "), *(" / ".join(part) for part in (shown[:3], shown[3:6], shown[6:])))
    Console().print(table)
    return found


if __name__ == "__main__":
    tyro.cli(main)
