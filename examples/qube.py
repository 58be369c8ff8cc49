"""Real hardware: estimate the pendulum of a Quanser Qube Servo 2 from the angle of its arm only.

The first observer has no equations: it is fitted to eight recorded runs and tested on four others. It is compared with
an extended Kalman filter on the device's published model, with one on a model fitted to the same eight runs, and with
finite differences, which a control engineer would try first::

    python examples/qube.py PATH

PATH is a folder with run01.csv to run12.csv, whose columns are alpha (pendulum, rad), theta (arm, rad), alpha_dot,
theta_dot (rad/s) and time (s). These are the twelve runs without motor input of Buisson-Fenet, Bahr, Morgenthaler,
Di Meglio, "Towards gain tuning for numerical KKL observers" (2023), repository
Centre-automatique-et-systemes/learn_observe_KKL, MIT licence. docs/results/qube.md has the results.

Two assumptions about the device are used besides the records. Left and right are symmetric, so the observer learns from
each run twice: as recorded, and mirrored, with the signs of both angles changed. No angle of the arm is special, so the
map sees changes of the arm's angle, not the angle itself.

Eight runs contain few of the possible swings of a pendulum. Therefore a second observer also learns from motions
simulated from random states by the device's equations, whose parameters were fitted to the same eight runs.

While the arm sticks, its angle carries no information, and the pendulum swings on regardless. Therefore a third
estimator is a Kalman filter with a model whose arm can stick. The second observer starts this filter, and restarts it
when their estimates disagree.

The recorded velocities are not measurements. They follow exactly from the recorded angles, sample by sample, as
v_k+1 = 0.8 v_k + 50 (angle_k+1 - angle_k): a derivative after a low-pass filter of 55.79 rad/s. The velocities of
a Kalman filter are computed from its angles by the same formula before they are compared.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from qube_model import KEPT, BothAngles, Pushed, Qube, Sticking
from rich.console import Console
from scipy.signal import savgol_filter

from kkl_gym.simulate import simulate
from observers import Artifact, KKLObserver
from observers.estimator import Running
from training.figures import ESTIMATE, RIVAL, TARGET, TRUTH, drawing
from training.files import table, write
from training.identification.motions import Shooting
from training.identification.shooting import shoot
from training.identification.windows import windows
from training.kalman import ExtendedKalmanFilter
from training.lessons import train
from training.records import Record, Signals, read_records, resampled
from training.sources.recorded import RecordedSource, recorded_preset

SIGNALS = Signals("time", ("theta",), (), ("cos(alpha)", "sin(alpha)", "alpha_dot", "theta_dot"))
MIRRORED = np.array([1.0, -1.0, -1.0, -1.0])  # factors of the hidden signals in the mirror image
TRAINING, HELD_OUT = (1, 2, 4, 5, 7, 8, 10, 11), (3, 6, 9, 12)
# The training runs in two halves, with large and with small swings. --cross-validate holds out each half in turn to
# test extrapolation to other swings, because the test runs swing less than any training run.
FOLDS = ((1, 4, 7, 10), (2, 5, 8, 11))
DT = 0.004  # s, the device's sampling interval
TRANSIENT = 1.0  # s; errors before this time of each run do not count
RELEASED = 0.5  # s; the equations are fitted to each run from this time on

# Decay rates of the observer's filter in 1/s. They are evenly spaced on a logarithmic scale except for 55.79, the rate
# of the low-pass filter of the recorded velocities.
RATES = (2.5, 3.245, 4.212, 5.467, 7.096, 9.21, 11.95, 15.52, 20.14, 26.14, 33.93, 44.04, 55.79, 74.2, 96.3, 125.0)

# Chosen by --cross-validate, on the training runs only.
SETTINGS = {
    "eigenvalues": tuple(-rate for rate in RATES),
    "arbitrary_zero": ("theta",),
    "measurement_noise_max": 0.004,  # rad; an encoder's step is 0.0031
    "width": 192,
    "inverse_steps": 6000,
    "members": 4,
}

# First guesses of the fitted parameters. The mass is fixed, because a common factor of all forces and inertias has no
# effect without an input.
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
DIFFERENCES = "finite differences"
GUIDED = "Kalman filter, fitted model with an arm that sticks, initialised by the second KKL"
# Line styles and colours of the estimators in the figure, in the order of the table.
LOOKS = (":", ESTIMATE), ("--", ESTIMATE), ("-", ESTIMATE), ("-", RIVAL), ("-", TARGET)
# The figure shows the first 4 s of each run, with root mean square errors over windows of 125 samples.
SHOWN, AVERAGED = 4.0, 125
# The equations are fitted to windows of 125 samples, from the first 9 s of each run; afterwards the pendulum rests.
WINDOW, FITTED = 125, 9.0
# The simulated motions: their number, chosen by --cross-validate among 8, 24 and 72; their duration in s; and,
# at their release, the arm's largest angle in rad and the largest rates of arm and pendulum in rad/s. The pendulum's
# angle is arbitrary. The eight runs begin with the arm up to 0.85 rad from the middle.
MOTIONS, LASTING, TURNED, MOVING = 24, 11.0, 0.9, (0.3, 0.5)
ENCODER = 2 * np.pi / 2048  # rad, resolution of both angles
# Settings of the Kalman filter that the observer starts, chosen on the training runs. LONGER: samples in a window for
# the fit of its model. STARTED: time in s until which the observer restarts the filter at every sample. SURE: standard
# deviations of the filter's states after a restart, in rad, rad/s and 0.1 mN m. APART: distance of the two estimates of
# alpha, as points on the unit circle, above which the observer also restarts the filter.
LONGER, STARTED, SURE, APART = 250, 0.3, (0.002, 0.3, 1.0, 4.0, 1.0), 0.5
PUSHED = 1.0  # standard deviation of the unknown torque on the arm, in 0.1 mN m


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
        Folder of the trainings, which resume from checkpoints; also for qube.safetensors, table.md and estimates.png.
    cross_validate
        Test the settings on the training runs only, each half held out once, and print the errors; save no results.
    inverse_steps
        Training batches of each network.

    Returns
    -------
    dict of str to ndarray, shape (4,)
        For each estimator, root mean square errors of cos alpha, sin alpha, alpha_dot and theta_dot in units of these
        signals' standard deviations, over all runs after the transient; NaN for signals without an estimate.
    """
    settings = {**SETTINGS, "dt": DT, "held_out": 0.0, "inverse_steps": inverse_steps}
    training = read(path, TRAINING)
    if cross_validate:
        runs, records, estimators = TRAINING, training, left_out_in_turn(training, settings, out)
    else:
        runs, records = HELD_OUT, read(path, HELD_OUT)
        model, sticking = fitted(training), fitted(training, Sticking())
        for each in (model, sticking):
            print(f"{each.name}, fitted:", ", ".join(f"{name} = {each.parameters[name]:.3g}" for name in GUESSES))
        alone, both = learned(training, model, settings, out)
        both.save(out / "qube.safetensors")
        estimators = {
            ALONE: [estimates(alone, record) for record in records],
            BOTH: [estimates(both, record) for record in records],
            GUIDED: guided(both, sticking, rest(training), records),
            "extended Kalman filter, published model": kalman(records, Qube()),
            "extended Kalman filter, fitted model": kalman(records, Qube(**model.parameters)),
            DIFFERENCES: [differences(record) for record in records],
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
    """Read the records of some runs, and resample them at the device's interval."""
    records = read_records([path / f"run{run:02d}.csv" for run in runs], signals=SIGNALS)
    return [resampled(record, DT) for record in records]


def fitted(records: Sequence[Record], model: BothAngles | None = None) -> BothAngles:
    """Fit the device's model to windows of WINDOW samples, or a given model to windows of LONGER samples."""
    model, window, noise = (
        (BothAngles(), WINDOW, None) if model is None else (model, LONGER, (ENCODER / 2, ENCODER / 2))
    )
    first, last = round(RELEASED / DT), round(FITTED / DT)
    both, starts = [], {}
    for i, record in enumerate(records):
        angles = np.stack([record.y[:, 0], np.unwrap(np.arctan2(record.x[:, 1], record.x[:, 0]))], -1)
        rates = savgol_filter(angles, 11, 3, deriv=1, delta=DT, axis=0)
        both.append(replace(record, y=angles, x=None, signals=Signals("time")))
        for k in range(first, min(last, len(angles) - window), window):
            starts[i, k] = np.concatenate([angles[k], rates[k]])
    guesses = np.array(list(GUESSES.values()))
    limits = {name: (0.0, 10 * guess) for name, guess in GUESSES.items()}
    fit = shoot(Shooting(model, DT, limits, guesses), guesses, windows(both, starts, window), rounds=12, noise=noise)
    return replace(model, **fit.parameters)


def released(model: BothAngles) -> list[Record]:
    """Simulate motions by the model's equations, with the signals that the device would record."""
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
    """Train two observers: on records only, and on records and simulated motions."""
    return trained(records, settings, out / "records"), trained([*records, *released(model)], settings, out / "both")


def trained(records: Sequence[Record], settings: dict, out: Path) -> Artifact:
    """Train an observer on records and their mirror images."""
    mirrored = [replace(r, name=f"{r.name}, mirrored", y=-r.y, x=r.x * MIRRORED) for r in records]
    both = [*records, *mirrored]
    source = RecordedSource(both, recorded_preset(both, {"tracking": False, **settings}), "qube")
    return train(source, folder=out, resume=True, console=Console()).artifact


def left_out_in_turn(records: Sequence[Record], settings: dict, out: Path) -> dict[str, list[np.ndarray]]:
    """Return estimates along each training run, by observers and equations learned from the other half of the runs."""
    found = {}
    for fold in FOLDS:
        kept = [record for run, record in zip(TRAINING, records, strict=True) if run not in fold]
        alone, both = learned(kept, fitted(kept), settings, out / f"without-{'-'.join(map(str, fold))}")
        left = [records[TRAINING.index(run)] for run in fold]
        recursive = guided(both, fitted(kept, Sticking()), rest(kept), left)
        for run, record, last in zip(fold, left, recursive, strict=True):
            found[run] = estimates(alone, record), estimates(both, record), last
    return {name: [found[run][i] for run in TRAINING] for i, name in enumerate((ALONE, BOTH, GUIDED))}


def estimates(observer: Artifact, record: Record) -> np.ndarray:
    """Return an observer's estimates along a record."""
    return KKLObserver(observer, 0.0).estimate(record.y, record.u)


def rest(records: Sequence[Record]) -> float:
    """Return the mean angle at which the recorded pendulum comes to rest, in rad from hanging straight down."""
    return float(np.mean([np.arcsin(-record.x[-round(1.0 / DT) :, 1]).mean() for record in records]))


def guided(observer: Artifact, model: Sticking, zero: float, records: Sequence[Record]) -> list[np.ndarray]:
    """Return estimates of a Kalman filter that the observer starts, and restarts when their estimates are far apart.

    The arm's angle is measured, not estimated. ``zero`` is the pendulum's angle at rest, in rad from the vertical.
    """
    y = padded([record.y for record in records])
    signals = padded([estimates(observer, record) for record in records])
    kalman_filter = ExtendedKalmanFilter(
        Pushed(**model.parameters),
        DT,
        Q=np.diag([0.0, 0.0, 0.0, 0.03, np.sqrt(2 / KEPT) * PUSHED]) ** 2,
        R=np.array([[0.005**2]]),
        start=(np.zeros(5), np.diag(SURE) ** 2),
    )
    state, found = kalman_filter.start(y.shape[1]), []
    for k, (cosine, sine, alpha_dot, theta_dot) in enumerate(np.moveaxis(signals, -1, 1)):
        state = kalman_filter.advance(state, y[k])
        alpha = state.x[:, 1] + zero
        lost = (np.hypot(np.cos(alpha) - cosine, np.sin(alpha) - sine) > APART) | (k * DT <= STARTED)
        x = np.stack([y[k, :, 0], np.arctan2(sine, cosine) - zero, theta_dot, alpha_dot, 0.0 * alpha], -1)
        P = np.where(lost[:, None, None], np.diag(SURE) ** 2, state.P)
        state = state._replace(x=np.where(lost[:, None], x, state.x), P=P)
        found.append(state.x)
    return recorded_signals(np.stack([y[..., 0], np.array(found)[..., 1] + zero], -1), records)


def padded(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return signals (n, k) of several records as one array; the last samples of shorter records are repeated."""
    longest = max(len(each) for each in values)
    return np.stack([np.pad(each, ((0, longest - len(each)), (0, 0)), mode="edge") for each in values], 1)


def recorded_signals(angles: np.ndarray, records: Sequence[Record]) -> list[np.ndarray]:
    """Return the signals that the device would record for angles theta and alpha (n, runs, 2), run by run."""
    each = [np.unwrap(angles[: len(record.t), i], axis=0).T for i, record in enumerate(records)]
    return [
        np.stack([np.cos(alpha), np.sin(alpha), recorded_velocity(alpha), recorded_velocity(theta)], -1)
        for theta, alpha in each
    ]


def kalman(records: Sequence[Record], model: Qube) -> list[np.ndarray]:
    """Return estimates of an extended Kalman filter, whose noise covariances were chosen on the training runs.

    It starts with a hanging pendulum at rest. The initial standard deviations of arm and pendulum are 1 and 1.8 rad for
    their angles, and 4 and 12 rad/s for their rates.
    """
    y = padded([record.y for record in records])
    kalman_filter = ExtendedKalmanFilter(
        model,
        DT,
        Q=np.diag([0.0, 0.0, 10.0, 10.0]) ** 2,
        R=np.array([[0.003**2]]),
        start=(np.array([0.0, np.pi, 0.0, 0.0]), np.diag([1.0, 1.8, 4.0, 12.0]) ** 2),
    )
    return recorded_signals(Running(kalman_filter).along(y)[..., :2], records)


def differences(record: Record) -> np.ndarray:
    """Return the arm's velocity by the device's formula; differences of theta do not give the pendulum's signals."""
    nothing = np.full(len(record.t), np.nan)
    return np.stack([nothing, nothing, nothing, recorded_velocity(record.y[:, 0])], -1)


def recorded_velocity(angle: np.ndarray) -> np.ndarray:
    """Return the derivative of an angle, (n,), with the low-pass filter of the recorded velocities."""
    velocity = np.zeros(len(angle))
    for k in range(1, len(angle)):
        velocity[k] = 0.8 * velocity[k - 1] + 50.0 * (angle[k] - angle[k - 1])
    return velocity


def errors(x_hat: Sequence[np.ndarray], records: Sequence[Record]) -> np.ndarray:
    """Return root mean square errors in units of standard deviations, (4,), over all runs after the transient."""
    late = round(TRANSIENT / DT)
    truth = np.concatenate([record.x[late:] for record in records])
    apart = np.concatenate([each[late:] for each in x_hat]) - truth
    return np.sqrt(np.mean(apart**2, 0)) / truth.std(0)


def draw(
    path: Path, estimators: Mapping[str, Sequence[np.ndarray]], records: Sequence[Record], titles: Sequence[str]
) -> None:
    """Draw the first seconds of each run in its own column: a recorded signal, and the errors of two signals."""
    names, shown, smooth = ("sin(alpha)", "alpha_dot"), slice(0, round(SHOWN / DT)), np.ones(AVERAGED) / AVERAGED
    of = [SIGNALS.hidden.index(name) for name in names]
    # Finite differences give no estimates of alpha.
    drawn = {name: x_hat for name, x_hat in estimators.items() if name != DIFFERENCES}
    with drawing(path, 2.6 * len(records), 6.5) as figure:
        axes = figure.subplots(1 + len(names), len(records), squeeze=False, sharex=True, sharey="row")
        for column, (record, title) in enumerate(zip(records, titles, strict=True)):
            t = record.t[shown] - record.t[0]
            axes[0, column].set_title(title)
            axes[-1, column].set_xlabel("t in s")
            axes[0, column].plot(t, record.x[shown, of[0]], color=TRUTH, lw=1.2, label="recorded")
            for i, ax in zip(of, axes[1:, column], strict=True):
                for (label, x_hat), (style, color) in zip(drawn.items(), LOOKS, strict=True):
                    squares = (x_hat[column][shown, i] - record.x[shown, i]) ** 2
                    rms = np.sqrt(np.convolve(squares, smooth, mode="valid"))
                    ax.semilogy(t[AVERAGED // 2 :][: len(rms)], rms, ls=style, color=color, lw=1.2, label=label)
        for ax, name in zip(axes[:, 0], (names[0], *(f"error of {name}" for name in names)), strict=True):
            ax.set_ylabel(name)
        lines = [line for ax in axes[:2, 0] for line in ax.lines]
        figure.legend(handles=lines, loc="outside lower center", ncols=2)


if __name__ == "__main__":
    tyro.cli(main)
