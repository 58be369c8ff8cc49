"""Standard errors of identified parameters, against repetitions of the identification."""

import numpy as np
import pytest

from kkl_gym import get_system
from kkl_gym.simulate import simulate
from training.identification import estimate_parameters
from training.progress import progress_bars
from training.records import Record

REPETITIONS, RECORDS, SECONDS, NOISE = 40, 60, 30.0, 0.1
FIRST_GUESSES = {"van_der_pol": {"mu": 1.5}, "lorenz": {"sigma": 7.0, "rho": 20.0, "beta": 2.0}}
FIRST_SEED = 5000


@pytest.mark.long
@pytest.mark.parametrize("name", FIRST_GUESSES)
def test_the_true_parameters_lie_within_the_intervals(name):
    """95 % intervals hold each true parameter in 90 % of the repetitions at least."""
    plant, guesses = get_system(name), FIRST_GUESSES[name]
    limits = {each: (value / 10, 10 * value) for each, value in guesses.items()}
    steps = round(SECONDS / plant.dt)
    t = np.arange(steps + 1) * plant.dt
    apart = []
    for repetition in range(REPETITIONS):
        rng = np.random.default_rng(FIRST_SEED + repetition)
        y = plant.output(simulate(plant, plant.draw_starts(rng, RECORDS), steps, plant.dt))
        y = y + NOISE * rng.standard_normal(y.shape)
        records = [Record(f"record {i}", t, y[:, i]) for i in range(RECORDS)]
        with progress_bars(None) as progress:
            found = estimate_parameters(plant.replace(guesses), limits, records, progress=progress, seed=repetition)
        errors = found.standard_errors
        apart.append([(found.system.parameters[each] - plant.parameters[each]) / errors[each] for each in guesses])
        print(f"{name}, repetition {repetition}: " + ", ".join(f"{value:+.2f}" for value in apart[-1]), flush=True)
    covered = (np.abs(apart) <= 1.96).mean(0)
    print(f"{name}: covered {dict(zip(guesses, covered.tolist(), strict=True))}, {REPETITIONS} repetitions")
    assert (covered >= 0.9).all()
