"""Draw the figures of the pages, on a light and on a dark background: ``make figures``.

The data are files in docs/results, or short simulations. Some figures are drawn by functions of ``kkl-gym demo``. Each
figure and animation is written twice, as NAME and NAME-dark; docs/site/hooks.py shows the file of the reader's theme.

``python -m examples.research.figures figures/portraits.gif`` draws a single figure.

docs/figures/qube.png is not drawn here and has only a light version: it needs a training (examples/qube.py) and records
that are not part of this project. docs/figures/kkl.svg is drawn by hand; each run writes kkl-dark.svg from it.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pandas as pd
from PIL import Image

from examples.research.agents import picture
from examples.research.agents.comparison import read_results
from examples.research.agents.kinds import draw as draw_kinds
from examples.research.agents.tables import draw_curves, draw_scores
from examples.research.benchmark.results import draw_results as draw_benchmark
from kkl_gym import SYSTEMS
from observers import Artifact, load
from observers.factors import standard_deviations
from observers.names import resolve
from observers.storage import replacing
from training.agents.agent import Agent, find
from training.agents.play import Episodes, play
from training.agents.seeds import agent_evaluation_seed
from training.agents.tasks import Task
from training.calibration import chi_square
from training.commands import demo
from training.commands.options import shown
from training.evaluation.errors import estimates as estimates_of
from training.evaluation.errors import unseen_trajectories
from training.evaluation.faults import FAULTS
from training.evaluation.metrics import smape
from training.figures import ALARM, ESTIMATE, MEASURED, RIVAL, TARGET, TRUTH, Theme, drawing, style
from training.files import write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOCS = Path(__file__).resolve().parents[2] / "docs"
RESULTS = DOCS / "results"
Draw = Callable[[Path], object]
COLOURS = 256  # number of colours that remain in a picture; this reduces the file to a third
SEED = 7  # seed of the animations of ``kkl-gym demo``
DT = 0.01  # s, sampling interval of the shipped systems
EKF = "EKF with the exact equations"
RIVALS = {"ekf": "tuned EKF", "ukf": "tuned UKF", "gru": "GRU"}  # methods in the figure of noise levels
BAND = 0.9  # share of errors within a band
THRESHOLDS = (0.5, 100.0)  # range of scores in the figure of faults
LEVELS = (0.0, 0.5)  # measurement noise in the figure of errors over time
SMALLEST = 0.01  # lower end of the error axis in %, under noise, in the figure of errors over time
QUANTILES = (0.1, 0.5, 0.9)  # quantiles over runs in the figure of errors over time
AGENTS = {"the agent sees the noisy output y": "van_der_pol-y", "the agent sees the estimate": "van_der_pol"}
FIRST = 1.0  # s; until then, bands may exceed the panels of errors
# Colours of docs/figures/kkl.svg, and their replacements on a dark background.
DARK = {
    "#fdfcf8": "#1e2129", "#ddd8c8": "#363b47", "#f1efe6": "#2a2f3a", "#e9f1fa": "#1f3044", "#fbecea": "#402523",
    "#333": "#c9ccd3", "#222": "#eceae4", "#555": "#b4b8c0", "#777": "#9aa0aa", "#888": "#8a909c",
    "#2b6cb0": "#4aa3df", "#1d4e89": "#8cc4ee", "#b03a2e": "#e0756a", "#d08a82": "#9c574f", "#8c2d23": "#f0978d",
}  # fmt: skip


def estimates(duration: float = 15.0) -> Draw:
    """Return the drawing of ``kkl-gym demo --duration 15``: states and estimates of all systems."""
    episodes = [demo.play(one, round(duration / one.system.dt), None, seed=0) for one in shown(None, None)]
    return lambda path: demo.draw(path, episodes)


def portraits(name: str | None = None, duration: float = 12.0) -> Draw:
    """Return the animation of ``kkl-gym demo --gif --seed 7 --duration 12``: phase portraits of one system or all."""
    episodes = [demo.play(one, round(duration / one.system.dt), None, seed=SEED) for one in shown(name, None)]
    return lambda path: demo.animate(path, episodes)


def agents() -> tuple[Task, Mapping[str, Episodes]]:
    """Play the first episode of ``kkl-gym agent evaluate`` with two agents: one sees y, the other an estimate."""
    played = {}
    for title, name in AGENTS.items():
        agent = Agent.read(find(name))
        env = agent.make()
        played[title] = play(env, agent.policy(env.single_action_space), seed=agent_evaluation_seed(0, 1))
    return agent.task, played


def agents_moving() -> Draw:
    """Return the animation of both agents' phase portraits."""
    task, played = agents()
    return lambda path: picture.animate(task, played, path)


def agents_over_time() -> Draw:
    """Return the drawing of both agents' states, outputs and inputs."""
    task, played = agents()
    return lambda path: picture.draw(task, played, path)


def error_bars(name: str = "van_der_pol", duration: float = 8.0) -> Draw:
    """Return the drawing of states, estimates and 90 % bands of the errors, in the run of ``kkl-gym demo``."""
    (environment,) = shown(name, None)
    episode = demo.play(environment, round(duration / environment.system.dt), None, seed=0)
    observer = load(name, environment.system.measurement_noise)
    width = chi_square(BAND, 1)[()] ** 0.5 * standard_deviations(observer.estimate_covariance(episode.y))

    def draw(path: Path) -> None:
        t = np.arange(len(episode.x)) * episode.dt
        with drawing(path, 9, 4.6) as figure:
            axes = figure.subplots(2, episode.system.nx, sharex=True, height_ratios=[3, 2], squeeze=False)
            for i, (above, below) in enumerate(axes.T):
                if i == 0:  # the measured state
                    above.plot(t, episode.y[:, 0], ".", ms=1.5, color=MEASURED, label="measured")
                for ax, middle, label in (
                    (above, episode.x_hat[:, i], f"{100 * BAND:.0f} % band"),
                    (below, 0 * t, None),
                ):
                    ax.fill_between(
                        t, middle - width[:, i], middle + width[:, i], color=ESTIMATE, alpha=0.3, lw=0, label=label
                    )
                above.plot(t, episode.x[:, i], color=TRUTH, label="true")
                above.plot(t, episode.x_hat[:, i], "--", color=ESTIMATE, lw=1.0, label="estimate")
                below.plot(t, episode.x[:, i] - episode.x_hat[:, i], color=TRUTH, lw=0.8)
                margin, largest = 0.2 * np.ptp(episode.x[:, i]), 1.2 * width[t > FIRST, i].max()
                name = episode.system.state_names[i]
                above.set(ylabel=name, ylim=(episode.x[:, i].min() - margin, episode.x[:, i].max() + margin))
                below.set(xlabel="t in s", ylabel=f"error of {name}", ylim=(-largest, largest))
            axes[0, 0].legend(loc="lower right", ncols=2, markerscale=4)

    return draw


def noise_levels() -> Draw:
    """Return the drawing of errors by noise level, for shipped maps and some of the benchmark's observers."""
    files = RESULTS / "accuracy.csv", RESULTS / "tracking" / "accuracy.csv"
    ours = pd.concat(map(pd.read_csv, files))
    rivals = pd.read_csv(RESULTS / "benchmark" / "results.csv")

    def draw(path: Path) -> None:
        medians = ours[(ours.starts == "X") & ~ours.driven].groupby(["observer", "measurement_noise"]).smape.median()
        others = rivals[rivals.starts == "X"].groupby(["system", "method", "noise"]).smape.median()
        with drawing(path, 10, 3.2) as figure:
            axes = figure.subplots(1, len(SYSTEMS), sharey=True)
            for ax, name in zip(axes, SYSTEMS, strict=True):
                for observer, line, color, label in (
                    (name, "o-", ESTIMATE, "default maps"),
                    (f"{name}-large, T_inv alone", "o:", ESTIMATE, "T_inv alone"),
                    (f"{name}-spinn", "o-", TARGET, "SPINN"),
                ):
                    ax.plot(medians[observer], line, color=color, label=label)
                for (method, label), marker in zip(RIVALS.items(), ("x", "+", "^"), strict=True):
                    if (name, method) in others.index:
                        ax.plot(others[name, method], marker, ms=6, mfc="none", color=RIVAL, label=label)
                levels = medians[name].index
                ax.set_xscale("symlog", linthresh=levels[1], linscale=0.4)
                ax.set_xticks(levels, [f"{level:g}" for level in levels], fontsize="small")
                ax.minorticks_off()
                ax.set(yscale="log", title=name.replace("_", " "), xlabel="noise on each sample of y")
            axes[0].set_ylabel("median SMAPE in %")
            figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3 + len(RIVALS))

    return draw


def errors_of_runs(
    level: float, *, trajectories: int = 100, duration: float | None = None
) -> dict[str, list[np.ndarray]]:
    """Return errors in % by system, (steps, n) for the default map and for an EKF, in runs of ``kkl-gym evaluate``.

    The runs start in X. The mean of a run's errors is its SMAPE; the tables of the pages show medians of SMAPEs.
    """
    errors = {}
    for name, kind in SYSTEMS.items():
        system, how = kind(), dict[str, Any](measurement_noise=level, seed=0)
        runs = unseen_trajectories(system, DT, n=trajectories, duration=duration or system.duration, seed=0)
        x_hats = (
            estimates_of(Artifact.read(resolve(name)), system, runs, **how)[0],
            estimates_of(None, system, runs, **how)[0],
        )
        rows = 1, -1, system.nx  # each step is a run of its own for smape
        errors[name] = [smape(runs.x.reshape(rows), x_hat.reshape(rows)).reshape(x_hat.shape[:2]) for x_hat in x_hats]
    return errors


def errors_over_time(**sizes: Any) -> Draw:
    """Return the drawing of medians and bands of errors over time, for observers and Kalman filters."""
    errors = {level: errors_of_runs(level, **sizes) for level in LEVELS}

    def draw(path: Path) -> None:
        with drawing(path, 10, 4.6) as figure:
            axes = figure.subplots(len(LEVELS), len(SYSTEMS), sharex=True, sharey="row")
            for row, level in zip(axes, LEVELS, strict=True):
                for ax, name in zip(row, SYSTEMS, strict=True):
                    for own, color, label in zip(
                        errors[level][name], (ESTIMATE, RIVAL), ("observer", EKF), strict=True
                    ):
                        t = DT * np.arange(1, len(own))
                        low, middle, high = np.quantile(own[1:], QUANTILES, axis=1)
                        ax.fill_between(t, low, high, color=color, alpha=0.25, lw=0)
                        ax.plot(t, middle, color=color, lw=0.9, label=label)
                    _set_logarithmic(ax, lowest=SMALLEST if level else SMALLEST / 100)
                row[0].set_ylabel(f"error in %, noise {level:g}" if level else "error in %, no noise")
            for ax, name in zip(axes[0], SYSTEMS, strict=True):
                ax.set_title(name.replace("_", " "))
            for ax in axes[-1]:
                ax.set_xlabel("t in s")
            figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)

    return draw


def _set_logarithmic(ax: "Axes", lowest: float) -> None:
    ax.set(xscale="log", yscale="log", ylim=(lowest, 200.0))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:g}")


def draw_faults(path: Path, runs: pd.DataFrame) -> None:
    """Draw the share of runs, without and with faults, whose score exceeds a threshold within the deadline."""
    observers = list(runs.observer.unique())
    with drawing(path, max(5.0, 2.5 * len(observers)), 3.2) as figure:
        axes: Any = figure.subplots(1, len(observers), sharey=True, squeeze=False)[0]
        for ax, observer in zip(axes, observers, strict=True):
            group = runs[runs.observer == observer]
            for fault, color in zip(FAULTS, (MEASURED, RIVAL, ALARM, ESTIMATE), strict=True):
                scores = np.sort(group[group.fault == fault].score)
                share = 100 * np.arange(len(scores), 0, -1) / len(scores)
                ax.step(scores, share, where="pre", color=color, label="sound" if fault == "none" else fault)
            ax.axvline(1.0, color=TRUTH, lw=0.8, ls="--", label="where it warns")
            title = f"{observer.replace('_', ' ')}, within {group.deadline.iloc[0]:g} s"
            ax.set(title=title, xlabel="threshold of the score", xscale="log", xlim=THRESHOLDS, ylim=(-2, 102))
        axes[0].set_ylabel("runs above it, %")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=1 + len(FAULTS))


FIGURES: Mapping[str, Callable[[], Draw]] = {
    "figures/estimates.png": estimates,
    "figures/portraits.gif": portraits,
    **{f"figures/{name}.gif": partial(portraits, name) for name in SYSTEMS},
    "figures/agents.gif": agents_moving,
    "figures/agents.png": agents_over_time,
    "figures/errors_over_time.png": errors_over_time,
    "figures/error_bars.png": error_bars,
    "figures/noise_levels.png": noise_levels,
    "results/benchmark/heatmap.png": lambda: partial(draw_benchmark, RESULTS / "benchmark"),
    "results/ablation/heatmap.png": lambda: partial(draw_benchmark, RESULTS / "ablation"),
    "results/agents/scores.png": lambda: partial(draw_scores, results=read_results(RESULTS / "agents")),
    "results/environments/scores.png": lambda: partial(draw_scores, results=read_results(RESULTS / "environments")),
    "results/environments/curves.png": lambda: partial(
        draw_curves, learned=pd.read_csv(RESULTS / "environments" / "curves.csv")
    ),
    "results/kinds/curves.png": lambda: partial(draw_kinds, rows=pd.read_csv(RESULTS / "kinds" / "kinds.csv")),
    "results/faults/scores.png": lambda: partial(draw_faults, runs=pd.read_csv(RESULTS / "faults" / "faults.csv")),
}


def in_theme(name: str, theme: Theme) -> str:
    """Return the file name of a figure in a theme."""
    return name if theme == "light" else str(Path(name).with_stem(f"{Path(name).stem}-dark"))


def shrink(path: Path) -> None:
    """Reduce the number of colours in a picture."""
    reduced = Image.open(path).convert("RGB").quantize(COLOURS, kmeans=1, dither=Image.Dither.NONE)
    with replacing(path) as temporary:
        reduced.save(temporary, optimize=True)


def main(names: Sequence[str] = (), out: Path = DOCS) -> None:
    """Draw figures in both themes."""
    if unknown := [name for name in names if name not in FIGURES]:
        raise SystemExit(f"there is no figure {', '.join(unknown)}; there are {', '.join(FIGURES)}")
    for name in names or FIGURES:
        draw = FIGURES[name]()
        for theme in get_args(Theme):
            path = out / in_theme(name, theme)
            with style(theme):
                draw(path)
            if path.suffix == ".png":
                shrink(path)
            print(f"wrote {path} ({path.stat().st_size / 1e3:.0f} kB)")
    sketch = (DOCS / "figures" / "kkl.svg").read_text(encoding="utf-8")
    for light, dark in DARK.items():
        sketch = sketch.replace(f'"{light}"', f'"{dark}"')
    write(out / "figures" / "kkl-dark.svg", sketch)


if __name__ == "__main__":
    main(sys.argv[1:])
