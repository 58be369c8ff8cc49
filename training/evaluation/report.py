"""A training run in one picture."""

from pathlib import Path
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.evaluation.errors import UnseenTrajectories, errors, unseen_trajectories
from training.evaluation.levels import show_level
from training.figures import ESTIMATE, TRUTH, drawing
from training.maps.smooth import residual
from training.train_observer import Result
from training.trajectories.controllers import Controller
from training.trajectories.noise import noisy_output


def write_report(
    path: Path, result: Result, system: System, *, policy: Controller | None = None, seed: int = 1_000_000
) -> None:
    """Draw the errors in training, the PDE residual over the domain, and estimates against the truth.

    Where no T was learned, the error by noise level takes the place of the residual. The trajectories shown are
    unseen, without process noise and input but a policy's, and not those that ``kkl-gym evaluate`` takes. Above each
    state stands its NRMSE after the transient, the median of 20 of them.
    """
    artifact = result.artifact
    seconds = min(20.0 * system.pace, artifact.training["duration"])
    trajectories = unseen_trajectories(
        system, artifact.filter.dt, n=20, duration=seconds, seed=seed, driven=policy is not None, policy=policy
    )
    with drawing(path, 12, 3.2 + 1.5 * system.nx) as figure:
        grid = figure.add_gridspec(1 + system.nx, 2, height_ratios=[2.0, *[1.0] * system.nx])
        losses = figure.add_subplot(grid[0, 0])
        for name, history in result.losses.items():
            losses.semilogy(*np.array(history).T, label=name)
        title = f"{system.name}, {artifact.training['pipeline']}"
        losses.set(xlabel="batch", ylabel="error", title=title)
        losses.legend()
        right = figure.add_subplot(grid[0, 1])
        if artifact.forward is None:
            _draw_noise_levels(right, result, system, trajectories, seed)
        else:
            draw_residual(right, artifact, system)

        x = trajectories.x[:, :1]  # the first that stayed within the bounds, if any did
        u = trajectories.u[:, :1] if policy else None
        rng = np.random.default_rng(seed)
        t = np.arange(len(x)) * artifact.filter.dt
        for column, level in enumerate((0.0, artifact.measurement_noise)):
            y = noisy_output(system, x, measurement_noise=level, rng=rng)
            x_hat = KKLObserver(artifact, level, process_noise=0.0).estimate(y, u)
            nrmse = errors(artifact, system, trajectories, measurement_noise=level, seed=seed).nrmse
            for i in range(system.nx):
                ax = figure.add_subplot(grid[1 + i, column])
                ax.plot(t, x[..., i], color=TRUTH, lw=1.8, label="true")
                ax.plot(t, x_hat[..., i], "--", color=ESTIMATE, label="estimated")
                ax.set_ylabel(system.state_names[i])
                if i == 0:
                    ax.set_title(f"measurement noise {show_level(level)}")
                    ax.legend(loc="upper right")
                if len(nrmse) and not np.isnan(nrmse[0, i]):
                    ax.set_title(f"NRMSE {np.median(nrmse[:, i]):.2g} %", loc="right")
            ax.set_xlabel("t in s")


def _draw_noise_levels(ax: Any, result: Result, system: System, trajectories: UnseenTrajectories, seed: int) -> None:
    artifact = result.artifact
    if not trajectories.x.shape[1]:
        ax.set_title("every trajectory left the declared bounds")
        return
    largest = np.asarray(artifact.inverse.measurement_noise_max)
    levels = [0.0, *((part * largest).tolist() for part in np.geomspace(0.01, 1.0, 7))]
    medians = [
        np.median(errors(artifact, system, trajectories, measurement_noise=level, seed=seed).late) for level in levels
    ]
    ax.plot(range(len(levels)), medians, "o-")
    ax.set_xticks(range(len(levels)), ["\n".join(f"{each:.2g}" for each in np.atleast_1d(level)) for level in levels])
    ax.set(xlabel="measurement noise", ylabel="SMAPE in %", yscale="log", title="median error after the transient")


def draw_residual(ax: Any, artifact: Artifact, system: System) -> None:
    """Draw the size of the PDE's residual over the plane of the phase portrait, other states at the centre of X."""
    from matplotlib.colors import LogNorm

    points = 150  # along each axis
    first, second = (i % system.nx for i in system.portrait)
    x = np.tile(np.mean(system.X, axis=1), (points**2, 1))
    grids = [np.linspace(*system.X[i], points) for i in (first, second)]
    x[:, first], x[:, second] = (grid.ravel() for grid in np.meshgrid(*grids))
    size = np.linalg.norm(residual(artifact, system, x), axis=1).reshape(points, points)
    image = ax.pcolormesh(*grids, size, norm=LogNorm() if size.all() else None, shading="auto")
    ax.figure.colorbar(image, ax=ax, label="|∂T/∂x f − A T − B h|")
    ax.set(xlabel=system.state_names[first], ylabel=system.state_names[second])
    ax.grid(visible=False)
    ax.set_title("PDE residual over X" if system.nx == 2 else "PDE residual through the centre of X")
