"""Real hardware: the pendulum of a Quanser Qube Servo 2, estimated from the angle of its arm alone.

The first observer is told no equation: it is fitted to eight recorded runs, and four others say how good it is. Beside
it stand an extended Kalman filter, with the device's published model and with one that is fitted to the same eight
runs, and the finite differences that a control engineer would begin with::

    python examples/qube.py PATH

PATH is a folder with run01.csv to run12.csv, whose columns are alpha, theta (rad), alpha_dot, theta_dot (rad/s) and
time (s): the twelve free runs that come with Buisson-Fenet, Bahr, Morgenthaler, Di Meglio, "Towards gain tuning for
numerical KKL observers" (2023), repository Centre-automatique-et-systemes/learn_observe_KKL, MIT licence.
docs/results/qube.md has the results.

What is said of the device beforehand, beside the records: left and right are alike, and the arm has no angle of its
own. Each run is therefore learned from twice, once mirrored, with the signs of both angles changed; and the map sees
how the arm's angle changes, not where it is.

Eight runs hold few of the swings that a pendulum can do. A second observer therefore learns from motions of the
device's equations as well, with the parameters that were fitted to the same eight runs, released from anywhere.

The recorded velocities are no measurements. They follow from the recorded angles exactly, sample by sample, as
v_k+1 = 0.8 v_k + 50 (angle_k+1 - angle_k): a derivative behind a low-pass of 55.79 rad/s. Estimates of angles are taken
through the same formula where they are compared with them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro
from rich.console import Console
from scipy.signal import savgol_filter

import kkl_gym
from kkl_gym.elementary import cos, sin, tanh
from kkl_gym.simulate import simulate
from observers import Artifact
from observers.storage import write
from training.figures import ALARM, ESTIMATE, RIVAL, TARGET, TRUTH, drawing
from training.identification.shooting import Shooting, shoot
from training.identification.windows import windows
from training.kalman import ExtendedKalmanFilter
from training.markdown import table
from training.recorded.config import recorded_config
from training.recorded.errors import estimates
from training.recorded.fit import train_recorded
from training.records import Record, Signals, read_records, resampled

SIGNALS = Signals("time", ("theta",), (), ("cos(alpha)", "sin(alpha)", "alpha_dot", "theta_dot"))
MIRRORED = np.array([1.0, -1.0, -1.0, -1.0])  # what these signals are multiplied with in the mirror
TRAINING, HELD_OUT = (1, 2, 4, 5, 7, 8, 10, 11), (3, 6, 9, 12)
# Of the training runs, those that swing far and those that do not. Either half is left out by --cross-validate, for the
# runs that are held out swing less than any of them.
FOLDS = ((1, 4, 7, 10), (2, 5, 8, 11))
DT = 0.004  # s, as the device samples
TRANSIENT = 1.0  # s that are left out of all errors
RELEASED = 0.5  # s after which the fitted equations follow the runs; at their beginning they do not

# In 1/s, evenly spaced on a logarithmic scale, but for 55.79, that of the recorded velocities.
RATES = (2.5, 3.245, 4.212, 5.467, 7.096, 9.21, 11.95, 15.52, 20.14, 26.14, 33.93, 44.04, 55.79, 74.2, 96.3, 125.0)

# Chosen by --cross-validate, among the training runs alone.
SETTINGS = {
    "eigenvalues": tuple(-rate for rate in RATES),
    "arbitrary_zero": ("theta",),
    "measurement_noise_max": 0.004,  # rad; an encoder's step is 0.0031
    "width": 192,
    "inverse_steps": 6000,
    "members": 4,
}

# First guesses of what is fitted. The mass is not: without an input, all forces may be larger by one factor.
GUESSES = {
    "arm_length": 0.085,
    "arm_inertia": 5.72e-5,
    "arm_damping": 0.00027,
    "arm_friction": 1e-4,
    "arm_spring": 5e-4,
    "pendulum_inertia": 1.33e-4,
    "pendulum_damping": 1e-5,
    "pendulum_friction": 4e-5,
}
ALONE, BOTH = "KKL, recorded states", "KKL, recorded states and the fitted model's motions"
LOOKS = (":", ESTIMATE), ("--", ESTIMATE), ("-", RIVAL), ("-", TARGET), (":", ALARM)  # of estimators in the figure
WINDOW, FITTED = 125, 9.0  # samples of a motion that is fitted; s of each run, after which it rests
# Of the equations' motions: how many, how long in s, and what they are released with at most: rad of the arm beside any
# angle of the pendulum, and rad/s. The eight runs begin with the arm up to 0.85 rad from the middle. The number was
# chosen by --cross-validate among 8, 24 and 72.
MOTIONS, LASTING, TURNED, MOVING = 24, 11.0, 0.9, (0.3, 0.5)
ENCODER = 2 * np.pi / 2048  # rad, a step of either angle


@dataclass(frozen=True)
class Qube(kkl_gym.System):
    """The device without motor input: x = (theta, alpha, theta', alpha'), alpha from above, y = theta.

    Without dry friction and the spring of the arm's cable it is as published.

    Lengths, masses and inertias are those of Quanser's script qube2_rotpen_param.m (that of the arm as published,
    mass length^2 / 12). It has much more damping than these runs show; the two coefficients are those of
    BlueRiverTech's quanser-openai-driver, file qube_simulator.py. The motor's terminals are open.
    """

    gravity: float = 9.81  # m/s^2
    arm_length: float = 0.085  # m
    arm_inertia: float = 5.72e-5  # kg m^2, 0.095 kg (0.085 m)^2 / 12
    arm_damping: float = 0.00027  # N m s
    arm_friction: float = 0.0  # N m
    arm_spring: float = 0.0  # N m/rad
    pendulum_mass: float = 0.024  # kg
    pendulum_length: float = 0.129  # m
    pendulum_inertia: float = 0.024 * 0.129**2 / 3  # kg m^2, about its joint
    pendulum_damping: float = 0.00005  # N m s
    pendulum_friction: float = 0.0  # N m

    name: ClassVar[str] = "qube"
    state_names: ClassVar = ("theta in rad", "alpha in rad", "theta' in rad/s", "alpha' in rad/s")
    X: ClassVar = ((-1.5, 1.5), (0.0, 2 * np.pi), (-10.0, 10.0), (-25.0, 25.0))
    bounds: ClassVar = ((-50.0, 50.0), (-500.0, 500.0), (-100.0, 100.0), (-200.0, 200.0))

    def f(self, x):
        """Drift: Lagrange's equations of the two angles, solved for their accelerations."""
        theta, alpha, theta_dot, alpha_dot = x
        half, sine, cosine = self.pendulum_length / 2, sin(alpha), cos(alpha)
        inertia = self.pendulum_inertia
        coupling = -self.pendulum_mass * self.arm_length * half
        m11 = self.arm_inertia + self.pendulum_mass * self.arm_length**2 + inertia * sine * sine
        m12, m22 = coupling * cosine, inertia
        r1 = coupling * sine * alpha_dot**2 - 2 * inertia * sine * cosine * theta_dot * alpha_dot
        r2 = inertia * sine * cosine * theta_dot**2 + self.pendulum_mass * self.gravity * half * sine
        r1 = r1 - self.arm_damping * theta_dot - self.arm_friction * tanh(theta_dot / 0.1) - self.arm_spring * theta
        r2 = r2 - self.pendulum_damping * alpha_dot - self.pendulum_friction * tanh(alpha_dot / 0.8)
        determinant = m11 * m22 - m12 * m12
        return theta_dot, alpha_dot, (m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m12 * r1) / determinant

    def h(self, x):
        """Output."""
        return (x[0],)


@dataclass(frozen=True)
class BothAngles(Qube):
    """The same with both angles measured, as in the runs that its parameters are fitted to."""

    name: ClassVar[str] = "qube-both-angles"

    def h(self, x):
        """Outputs."""
        return x[0], x[1]


def main(
    path: Annotated[Path, tyro.conf.Positional],
    out: Path = Path("runs/qube"),
    cross_validate: bool = False,
    inverse_steps: int = SETTINGS["inverse_steps"],
) -> dict[str, np.ndarray]:
    """Train, compare, and write a table and a figure.

    Parameters
    ----------
    path
        Folder with run01.csv to run12.csv.
    out
        Folder of the runs, which go on from their checkpoints; receives qube.safetensors, table.md and estimates.png.
    cross_validate
        Judge the settings on the training runs instead: leave either half out once, and look at none of the others.
    inverse_steps
        Batches for each network.

    Returns
    -------
    dict of str to ndarray, shape (4,)
        By estimator, root mean square errors of cos alpha, sin alpha, alpha_dot and theta_dot over their standard
        deviations, all runs together, after the transient; NaN for what it does not estimate.
    """
    settings = {**SETTINGS, "dt": DT, "held_out": 0.0, "inverse_steps": inverse_steps}
    training = read(path, TRAINING)
    if cross_validate:
        runs, records, estimators = TRAINING, training, left_out_in_turn(training, settings, out)
    else:
        runs, records = HELD_OUT, read(path, HELD_OUT)
        model = fitted(training)
        print("fitted:", ", ".join(f"{name} = {model.parameters[name]:.3g}" for name in GUESSES))
        alone, both = learned(training, model, settings, out)
        both.save(out / "qube.safetensors")
        estimators = {
            ALONE: [estimates(alone, record) for record in records],
            BOTH: [estimates(both, record) for record in records],
            "extended Kalman filter, published model": kalman(records, Qube()),
            "extended Kalman filter, fitted model": kalman(records, Qube(**model.parameters)),
            "finite differences": [differences(record) for record in records],
        }
    found = {name: errors(x_hat, records) for name, x_hat in estimators.items()}
    rows = [[name, *("-" if np.isnan(e) else f"{e:.3f}" for e in each)] for name, each in found.items()]
    lines = table(["", *SIGNALS.hidden], rows)
    print("\n".join(lines))
    if not cross_validate:
        write(out / "table.md", "\n".join(lines) + "\n")
        draw(out / "estimates.png", estimators, records, [f"run {run}" for run in runs])
    return found


def read(path: Path, runs: Sequence[int]) -> list[Record]:
    """Records of some runs, on the device's grid."""
    records = read_records([path / f"run{run:02d}.csv" for run in runs], signals=SIGNALS)
    return [resampled(record, DT) for record in records]


def fitted(records: Sequence[Record]) -> BothAngles:
    """The device with parameters for which its motions follow those recorded, each for half a second."""
    first, last = round(RELEASED / DT), round(FITTED / DT)
    both, starts = [], {}
    for i, record in enumerate(records):
        angles = np.stack([record.y[:, 0], np.unwrap(np.arctan2(record.x[:, 1], record.x[:, 0]))], -1)
        rates = savgol_filter(angles, 11, 3, deriv=1, delta=DT, axis=0)
        both.append(replace(record, y=angles, x=None, signals=Signals("time")))
        for k in range(first, min(last, len(angles) - WINDOW), WINDOW):
            starts[i, k] = np.concatenate([angles[k], rates[k]])
    guesses = np.array(list(GUESSES.values()))
    limits = {name: (0.0, 10 * guess) for name, guess in GUESSES.items()}
    fit = shoot(Shooting(BothAngles(), DT, limits, guesses), guesses, windows(both, starts, WINDOW), rounds=12)
    return replace(BothAngles(), **fit.parameters)


def released(model: BothAngles) -> list[Record]:
    """Motions of the equations, recorded as the device records its own."""
    rng = np.random.default_rng(0)
    theta, alpha = rng.uniform(-TURNED, TURNED, MOTIONS), rng.uniform(0, 2 * np.pi, MOTIONS)
    x0 = np.stack([theta, alpha, *rng.uniform(-1, 1, (2, MOTIONS)) * np.array(MOVING)[:, None]], -1)
    x = simulate(model, x0, round(LASTING / DT), DT)
    t = DT * np.arange(len(x))
    records = []
    for i in range(MOTIONS):
        theta, alpha = (ENCODER * np.round(x[:, i, column] / ENCODER) for column in (0, 1))
        hidden = np.stack([np.cos(alpha), np.sin(alpha), recorded_velocity(alpha), recorded_velocity(theta)], -1)
        records.append(Record(f"motion {i + 1}", t, theta[:, None], x=hidden, signals=SIGNALS))
    return records


def learned(records: Sequence[Record], model: BothAngles, settings: dict, out: Path) -> tuple[Artifact, Artifact]:
    """Observers from records alone, and from records and motions of the equations."""
    return trained(records, settings, out / "records"), trained([*records, *released(model)], settings, out / "both")


def trained(records: Sequence[Record], settings: dict, out: Path) -> Artifact:
    """An observer from records and their mirror images."""
    mirrored = [replace(r, name=f"{r.name}, mirrored", y=-r.y, x=r.x * MIRRORED) for r in records]
    both = [*records, *mirrored]
    config = recorded_config(both, settings)
    return train_recorded(both, config, out, name="qube", resume=True, console=Console()).artifact


def left_out_in_turn(records: Sequence[Record], settings: dict, out: Path) -> dict[str, list[np.ndarray]]:
    """Estimates along each training run, by observers and equations that were learned from the other half."""
    found = {}
    for fold in FOLDS:
        kept = [record for run, record in zip(TRAINING, records, strict=True) if run not in fold]
        observers = learned(kept, fitted(kept), settings, out / f"without-{'-'.join(map(str, fold))}")
        for run in fold:
            found[run] = [estimates(observer, records[TRAINING.index(run)]) for observer in observers]
    return {name: [found[run][i] for run in TRAINING] for i, name in enumerate((ALONE, BOTH))}


def kalman(records: Sequence[Record], model: Qube) -> list[np.ndarray]:
    """Estimates of an extended Kalman filter, whose noise was chosen on the training runs.

    It begins with a pendulum that hangs, give or take 1.8 rad, and velocities of 4 and 12 rad/s.
    """
    longest = max(len(record.t) for record in records)
    y = np.stack([np.pad(record.y[:, 0], (0, longest - len(record.t)), mode="edge") for record in records], 1)[
        ..., None
    ]
    kalman_filter = ExtendedKalmanFilter(
        model,
        DT,
        Q=np.diag([0.0, 0.0, 10.0, 10.0]) ** 2,
        R=np.array([[0.003**2]]),
        start=(np.array([0.0, np.pi, 0.0, 0.0]), np.diag([1.0, 1.8, 4.0, 12.0]) ** 2),
    )
    x = np.stack([kalman_filter.reset(y[0]), *(kalman_filter.step(each) for each in y[1:])])
    found = [x[: len(record.t), i] for i, record in enumerate(records)]
    return [
        np.stack([np.cos(alpha), np.sin(alpha), recorded_velocity(alpha), recorded_velocity(theta)], -1)
        for theta, alpha in (each[:, :2].T for each in found)
    ]


def differences(record: Record) -> np.ndarray:
    """The arm's velocity as the device computes it. Of the pendulum, differences of theta say nothing."""
    nothing = np.full(len(record.t), np.nan)
    return np.stack([nothing, nothing, nothing, recorded_velocity(record.y[:, 0])], -1)


def recorded_velocity(angle: np.ndarray) -> np.ndarray:
    """The derivative of an angle, (n,), behind the low-pass of the recorded velocities."""
    velocity = np.zeros(len(angle))
    for k in range(1, len(angle)):
        velocity[k] = 0.8 * velocity[k - 1] + 50.0 * (angle[k] - angle[k - 1])
    return velocity


def errors(x_hat: Sequence[np.ndarray], records: Sequence[Record]) -> np.ndarray:
    """Root mean square errors over standard deviations, (4,), all runs together, after the transient."""
    late = round(TRANSIENT / DT)
    truth = np.concatenate([record.x[late:] for record in records])
    apart = np.concatenate([each[late:] for each in x_hat]) - truth
    return np.sqrt(np.mean(apart**2, 0)) / truth.std(0)


def draw(
    path: Path, estimators: Mapping[str, Sequence[np.ndarray]], records: Sequence[Record], titles: Sequence[str]
) -> None:
    """Draw the first seconds of the runs, each in a column, recorded and as estimated."""
    with drawing(path, 2.6 * len(records), 9) as figure:
        axes = figure.subplots(len(SIGNALS.hidden), len(records), squeeze=False, sharex=True)
        shown = slice(0, round(5.0 / DT))
        for column, (record, title) in enumerate(zip(records, titles, strict=True)):
            t = record.t[shown] - record.t[0]
            axes[0, column].set_title(title)
            axes[-1, column].set_xlabel("t in s")
            for i, name in enumerate(SIGNALS.hidden):
                ax = axes[i, column]
                ax.plot(t, record.x[shown, i], color=TRUTH, lw=1.8, label="recorded")
                for (label, x_hat), look in zip(estimators.items(), LOOKS, strict=False):
                    ax.plot(
                        t,
                        x_hat[column][shown, i],
                        ls=look[0],
                        color=look[1],
                        lw=1.0,
                        label=label,
                        zorder=3 if "KKL" in label else 2,
                    )
                margin = 0.2 * np.ptp(record.x[:, i])
                ax.set_ylim(record.x[:, i].min() - margin, record.x[:, i].max() + margin)
                if column == 0:
                    ax.set_ylabel(name)
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)


if __name__ == "__main__":
    tyro.cli(main)
