"""From CSV files to an observer in a control loop, without recorded states and with an unknown parameter.

This command does the identification and the training; further options name the columns of your own files::

    kkl-gym identify van_der_pol --data runs/from_csv/record-*.csv --unknown mu=2 --out runs/from_csv
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from rich.console import Console

import kkl_gym
import observers
from training.files import write
from training.identification import identify
from training.presets import controller
from training.records import read_records

MU = 3.3  # the plant's parameter; the model begins with GUESS
GUESS, LIMITS = 2.0, (0.2, 20.0)
NOISE = 0.1  # standard deviation of the noise on each sample of y
STARTS = ((-3.0, 3.0), (-6.0, 6.0))  # from these starts the controller's bounded input can stabilise the plant

Policy = Callable[[np.ndarray, dict[str, np.ndarray]], np.ndarray]
"""Maps the state and the info of an environment to an action."""


def record(env: kkl_gym.KKLEnv, path: Path, *, seconds: float, seed: int) -> None:
    """Write times, inputs and noisy outputs, like a data logger, while a random input excites the plant."""
    rng, rows = np.random.default_rng(seed), []
    _, info = env.reset(seed=seed)
    for k in range(round(seconds / env.dt)):
        if k % 50 == 0:
            action = rng.uniform(-1.0, 1.0, 1)
        y = info["y"][0]
        _, _, _, _, info = env.step(action)
        rows.append((k * env.dt, info["u"][0], y))  # u is held from this sample to the next
    write(path, pd.DataFrame(rows, columns=["t", "u", "y"]).to_csv(index=False))


def cost(env: kkl_gym.KKLEnv, policy: Policy, *, seconds: float, episodes: int) -> float:
    """Return the mean of c = mean(((x - target) / scale)^2) over time and episodes, which differ in start and noise."""
    costs = []
    for seed in range(100, 100 + episodes):  # by default the records have the seeds 0 to 5
        x, info = env.reset(seed=seed)
        for _ in range(round(seconds / env.dt)):
            x, reward, _, _, info = env.step(policy(x, info))
            costs.append((1.0 / reward - 1.0) / 4.0)  # the reward is 1 / (1 + 4 c)
    return float(np.mean(costs))


def main(
    runs: int = 6,
    seconds: float = 10.0,
    inverse_steps: int = 1500,
    trajectories: int = 500,
    out: Path = Path("runs/from_csv"),
    seed: int = 0,
) -> tuple[float, float, float]:
    """Record, identify, control; returns the identified mu, and the costs with x_hat and with the true state.

    Args:
        runs: number of files to write; the 6th, 16th, ... are held out of the fit, to test predictions.
        seconds: length of each record.
        inverse_steps: batches of the observer's training.
        trajectories: simulated trajectories of the identified plant, for the training.
        out: the run's folder.
        seed: seed of the records and the training; the episodes of the comparison have fixed seeds.
    """
    plant = kkl_gym.KKLEnv(
        "van_der_pol", parameters={"mu": MU}, process_noise=0.0, measurement_noise=NOISE, start_box=STARTS
    )
    out.mkdir(parents=True, exist_ok=True)
    files = [out / f"record-{k}.csv" for k in range(runs)]
    for k, path in enumerate(files):
        record(plant, path, seconds=seconds, seed=seed + k)

    model = kkl_gym.get_system("van_der_pol", {"mu": GUESS})
    learned = identify(
        model,
        {"mu": LIMITS},
        read_records(files, system=model),
        out,
        settings={
            "inverse_steps": inverse_steps,
            "trajectories": trajectories,
            "duration": 20.0,
            "free_inverse": False,  # no second T_inv for motion without input, because the controller always acts
        },
        seed=seed,
        resume=True,
        console=Console(),
    )

    act = controller(learned.identified.system, plant.dt)  # for the identified model, because the plant is unknown
    observer = observers.load(str(out / "van_der_pol.safetensors"), NOISE)

    def on_estimate(x: np.ndarray, info: dict[str, np.ndarray]) -> np.ndarray:
        """Act on the observer's estimate, which needs only the samples and inputs that a real plant shows."""
        x_hat = observer.reset(info["y"]) if info["sample"] == 0 else observer.step(info["y"], info["u"])
        return act(x_hat[None])[0]

    def on_state(x: np.ndarray, info: dict[str, np.ndarray]) -> np.ndarray:
        """Act on the true state, which a real plant would not show."""
        return act(info["x"][None])[0]

    found = learned.identified.system.parameters["mu"]
    with_estimate, with_state = (cost(plant, policy, seconds=20.0, episodes=5) for policy in (on_estimate, on_state))
    spread = learned.identified.standard_errors["mu"]
    print(f"mu = {found:.4f} +- {spread:.2g}, from the guess {GUESS:g}; the plant has {MU:g}")
    print(f"mean cost of five episodes of 20 s: {with_estimate:.4f} with x_hat, {with_state:.4f} with the true state")
    return found, with_estimate, with_state


if __name__ == "__main__":
    tyro.cli(main)
