"""Adapt a shipped observer, by outputs alone, to a plant that differs from the observer's model, and test the result.

Every parameter of the plant is 10 % larger than in the model. The plant's records hold only t and y. Usage::

    python examples/adaptation.py lorenz --noise 0.5

The example compares three observers on the plant: the shipped one, the one that
:func:`training.identification.adapt` makes from it, and one trained on the true parameters with the same settings.
docs/results/identification.md has a table of results.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from observers import Artifact
from observers.names import resolve
from training import train
from training.config import settings_of
from training.evaluation.errors import errors, unseen_trajectories
from training.identification import adapt
from training.records import Record

WRONG = 1.1  # ratio of the plant's parameters to those of the observer's model


@dataclass(frozen=True)
class Compared:
    """Errors of three observers on the plant, and of the parameters that were identified.

    Parameters
    ----------
    shipped, adapted, trained : float
        SMAPE in % over all steps, as the median over unseen trajectories; ``trained`` had the true parameters.
    parameters : dict of str to float
        Errors of the identified parameters, in % of the plant's parameters.
    """

    shipped: float
    adapted: float
    trained: float
    parameters: dict[str, float]


def main(
    system: tyro.conf.Positional[str],
    noise: float = 0.5,
    records: int = 20,
    seconds: float = 30.0,
    seed: int = 12,
    out: Path | None = None,
    inverse_steps: int | None = None,
    trajectories: int | None = None,
) -> Compared:
    """Adapt an observer to a plant that differs from its model, train another on the plant, and print their errors.

    Args:
        system: reverse_duffing, van_der_pol, rossler or lorenz.
        noise: standard deviation of the measurement noise.
        records: number of records.
        seconds: length of each record.
        seed: seed of the records and of the unseen trajectories.
        out: folder of the runs.
        inverse_steps: batches of both trainings; by default as many as for the shipped observer.
        trajectories: simulated trajectories of both trainings; by default as many as for the shipped observer.
    """
    console, model = Console(), get_system(system)
    plant = model.replace({name: WRONG * value for name, value in model.parameters.items()})
    rng, steps = np.random.default_rng(seed), round(seconds / plant.dt)
    x = simulate(plant, plant.draw_starts(rng, records), steps, plant.dt)
    y = plant.output(x) + noise * rng.standard_normal((steps + 1, records, plant.ny))
    t = np.arange(steps + 1) * plant.dt
    shipped, folder = Artifact.read(resolve(system)), out or Path("runs") / f"{system}-adapted"
    sizes = {"inverse_steps": inverse_steps, "trajectories": trajectories}
    settings = {name: size for name, size in sizes.items() if size is not None}
    began = time.process_time()
    learned = adapt(
        shipped,
        model,
        [Record(f"record {i + 1}", t, y[:, i]) for i in range(records)],
        folder / f"{noise:g}",
        unknown={name: (value / 3, 3 * value) for name, value in model.parameters.items()},
        settings=settings,
        resume=True,
        console=console,
    )
    took = time.process_time() - began
    config = settings_of(shipped.training, **settings)
    trained = train(plant, config, folder / "true", resume=True, console=console).artifact

    unseen = unseen_trajectories(plant, plant.dt, n=50, duration=50.0, seed=seed)
    smape = [
        float(np.median(errors(one, plant, unseen, measurement_noise=noise, seed=seed).full))
        for one in (shipped, learned.result.artifact, trained)
    ]
    values = learned.identified.system.parameters
    found = Compared(*smape, {name: 100 * (value / plant.parameters[name] - 1) for name, value in values.items()})
    for name, off in found.parameters.items():
        console.print(f"{name}: {values[name]:.6g}, {off:+.2g} % off")
    console.print(
        f"{system}, noise {noise:g}, SMAPE in %: shipped {found.shipped:.3g}, adapted {found.adapted:.3g}, trained on "
        f"the plant {found.trained:.3g}; adapting took {took:.0f} s of CPU"
    )
    return found


if __name__ == "__main__":
    tyro.cli(main)
