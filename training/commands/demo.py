"""``kkl-gym demo``: environments with their observers, in a table, a figure and an animation."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

import kkl_gym
from kkl_gym.simulate import check_duration
from kkl_gym.system import System
from observers import Artifact, load
from training.commands.options import NoiseLevel, OneObserver, OneSystem, OwnPolicy, Seconds, Shown, read_policy, shown
from training.evaluation.levels import Level, show_level
from training.evaluation.metrics import smape
from training.figures import ESTIMATE, MEASURED, RIVAL, TRUTH, drawing, save_moving, style
from training.files import require_writable
from training.progress import progress_bars

EVERY = 100  # steps between two reports of progress
SECONDS = 12.0  # s, length of an animation; it shows 12 times System.pace: real time if the pace is 1 s
FRAMES = 144  # number of frames in an animation
TRAIL = 0.35  # share of the samples that a frame's phase portrait draws; older points would hide the latest


@dataclass(frozen=True)
class Demo:
    """Run the environments with their observers; print errors, and draw true and estimated states.

    The observer runs inside the environment. If no policy acts, the paper's observer, SPINN, also runs, where it ships.
    """

    system: OneSystem = None
    observer: OneObserver = None
    out: Path = Path("runs/demo")
    """Folder for the figure: estimates.png, or estimates-NAME.png for a single system."""
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each sample of y."""
    duration: Seconds = None
    """Length of each episode in seconds."""
    seed: int = 0
    """Seed of the starts and the noise."""
    policy: OwnPolicy = None
    gif: bool = False
    """Also write a .gif of phase portraits: the first 12 s (of your own systems, 12 times System.pace)."""

    def run(self, console: Console) -> Path:
        """Play the episodes, and write the figure."""
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        environments = shown(self.system, self.observer)
        for one in environments:
            if not one.observed:
                raise ValueError(f"no observer ships for {one.system.name!r}: name a file, --observer FILE")
        require_writable(self.out)
        with progress_bars(console) as progress:
            episodes = []
            for one in environments:
                duration = one.system.duration if self.duration is None else self.duration
                dt = one.options.get("dt", one.system.dt)
                check_duration(duration, dt)
                steps = round(duration / dt)
                with progress.phase(f"running {one.label}", steps) as report:
                    noise, seed = self.measurement_noise, self.seed
                    episodes.append(play(one, steps, noise, seed=seed, policy=self.policy, report=report))
            console.print(table(episodes))
            path = self.out / ("estimates.png" if self.system is None else f"estimates-{episodes[0].system.name}.png")
            with progress.phase("drawing"):
                draw(path, episodes)
            colours = "magenta and blue" if any(one.spinn is not None for one in episodes) else "magenta"
            progress.say(f"wrote {path}: true states in black, estimates in {colours}, measured outputs in grey")
            if self.gif:
                moving = path.with_suffix(".gif")
                with progress.phase("drawing the moving picture"):
                    animate(moving, episodes)
                progress.say(f"wrote {moving}: states in black, estimates in magenta, measured outputs below")
        return path


@dataclass(frozen=True)
class Episode:
    """One episode of an environment with an observer; ``spinn`` holds the estimates of SPINN, if it ran."""

    environment: Shown
    artifact: Artifact
    dt: float
    noise: str
    x: np.ndarray
    x_hat: np.ndarray
    spinn: np.ndarray | None
    y: np.ndarray
    seconds: float

    @property
    def system(self) -> System:
        """The environment's system."""
        return self.environment.system


def play(
    environment: Shown,
    steps: int,
    measurement_noise: Level | None,
    *,
    seed: int,
    policy: str | None = None,
    report: Callable[[int], object] = lambda done: None,
) -> Episode:
    """Play one episode with an observer; the inputs are zero unless a policy acts."""
    options: dict[str, Any] = {"measurement_noise": measurement_noise, "max_episode_steps": steps}
    env = kkl_gym.KKLObservation(gym.make(environment.env_id, **environment.options, **options), environment.observer)
    base: Any = env.unwrapped
    system, level, artifact = environment.system, base.measurement_noise, env.observer.artifact
    acting = read_policy(artifact, system, policy)
    _, info = env.reset(seed=seed)
    infos, seconds = [info], list[float]()
    action = np.zeros(env.action_space.shape or (), np.float32)
    for k in range(steps):
        if acting is not None:
            action = np.asarray(acting(info["x"][None]), dtype=float)[0]
        started = time.perf_counter()
        _, _, terminated, _, info = env.step(action)
        seconds.append(time.perf_counter() - started)
        infos.append(info)
        if terminated:
            break
        if k % EVERY == 0:
            report(k)
    x, x_hat, y = (np.array([info[key] for info in infos]) for key in ("x", "x_hat", "y"))
    # SPINN's maps take no inputs, so SPINN runs only where no policy acts.
    ships = acting is None and type(system) in kkl_gym.SYSTEMS.values()
    return Episode(
        environment,
        artifact,
        dt=base.dt,
        noise=show_level(level),
        x=x,
        x_hat=x_hat[:, : system.nx],  # without an estimated bias
        spinn=load(f"{system.name}-spinn", level).estimate(y) if ships else None,
        y=y,
        # The first step, which compiles or loads machine code, hardly changes the median.
        seconds=float(np.median(seconds)),
    )


def table(episodes: Sequence[Episode]) -> Table:
    """Return a table of the observers' errors and of the time of a step."""
    noise = ", ".join(dict.fromkeys(episode.noise for episode in episodes))
    with_spinn = any(episode.spinn is not None for episode in episodes)
    laid_out = Table(
        "environment",
        "observer" if episodes[0].environment.observer else "default",
        "late",
        *("SPINN", "late") if with_spinn else (),
        "µs a step",
        title=f"SMAPE in %, all steps and late (after 20 %), measurement noise {noise}",
        caption="SMAPE is relative to the state: near the state 0 it is large for every observer.",
    )
    for episode in episodes:
        estimates = [episode.x_hat, *([episode.spinn] if with_spinn else [])]
        errors = [
            smape(episode.x[:, None], x_hat[:, None], skip)[0]  # type: ignore[index]
            for x_hat in estimates
            for skip in (0, len(episode.x) // 5)
        ]
        cells = [f"{error:.2f}" for error in errors]
        laid_out.add_row(episode.environment.label, *cells, f"{1e6 * episode.seconds:.0f}")
    return laid_out


def draw(path: Path, episodes: Sequence[Episode]) -> None:
    """Draw true and estimated states over time, a column for each episode (like the paper's fig. 2)."""
    rows = max(episode.x.shape[1] for episode in episodes)
    with drawing(path, max(6.0, 2.6 * len(episodes)), 1.9 * rows) as figure:
        axes = figure.subplots(rows, len(episodes), squeeze=False)
        for column, episode in enumerate(episodes):
            system, C = episode.system, episode.artifact.C
            t = np.arange(len(episode.x)) * episode.dt
            for i in range(rows):
                ax: Any = axes[i, column]
                if i >= system.nx:
                    ax.set_visible(False)
                    continue
                for measured, row in zip(episode.y.T, [] if C is None else C, strict=False):
                    if np.array_equal(row, np.eye(system.nx)[i]):
                        ax.plot(t, measured, color=MEASURED, alpha=0.6, lw=0.6, label="measured")
                ax.plot(t, episode.x[:, i], color=TRUTH, lw=1.8, label="true")
                label = "observer" if episode.environment.observer else "default observer"
                ax.plot(t, episode.x_hat[:, i], "--", color=ESTIMATE, lw=1.0, label=label)
                if episode.spinn is not None:
                    ax.plot(t, episode.spinn[:, i], ":", color=RIVAL, label="SPINN")
                low, high = episode.x[:, i].min(), episode.x[:, i].max()
                margin = 0.25 * (high - low) or 1.0
                # First estimates that are far off stay outside the axis.
                ax.set_ylim(low - margin, high + margin)
                ax.set_ylabel(system.state_names[i])
            axes[0, column].set_title(system.name.replace("_", " "))
            axes[system.nx - 1, column].set_xlabel("t in s")
        lines = [pair for ax in axes.flat for pair in zip(*ax.get_legend_handles_labels(), strict=True)]
        handles = {label: handle for handle, label in lines}
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=len(handles))
        noise = ", ".join(dict.fromkeys(episode.noise for episode in episodes))
        what = "one noisy output" if all(episode.y.shape[1] == 1 for episode in episodes) else "noisy outputs"
        # The title of a narrow figure needs two lines.
        end = "\n" if len(episodes) == 1 else " "
        figure.suptitle(f"Hidden states estimated from {what}{end}(standard deviation {noise} on every sample)")


def animate(path: Path, motions: Sequence[Episode]) -> None:
    """Animate states and estimates, with a column for each motion."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # A single column needs room for the legend.
    side = 2.4 if len(motions) > 1 else 4.8
    frames: list[Image.Image] = []
    with style():
        figure = Figure(figsize=(side * len(motions), side + 0.7), dpi=120)
        canvas: Any = FigureCanvasAgg(figure)
        axes = figure.subplots(2, len(motions), squeeze=False, height_ratios=[4, 1])
        columns = [Column(motion, *pair) for motion, pair in zip(motions, axes.T, strict=True)]
        columns[0].name_lines(figure)
        canvas.draw()
        still = canvas.copy_from_bbox(figure.bbox)
        for share in np.arange(1, FRAMES + 1) / FRAMES:
            canvas.restore_region(still)
            for column in columns:
                column.show(share)
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    save_moving(path, frames, seconds=SECONDS)


class Column:
    """An animated phase portrait of the beginning of a motion, and the measured outputs below it."""

    def __init__(self, motion: Episode, portrait: Any, strip: Any) -> None:
        system, shown = motion.system, list(motion.system.portrait)
        self.samples = min(len(motion.x), 1 + round(SECONDS * system.pace / motion.dt))
        self.x, self.x_hat = (states[: self.samples, shown] for states in (motion.x, motion.x_hat))
        self.y, self.t = motion.y[: self.samples], np.arange(self.samples) * motion.dt
        low, high = self.x.min(0), self.x.max(0)
        # First estimates that are far off stay outside the axes.
        margin = 0.2 * np.where(high > low, high - low, 1.0)
        (left, bottom), (right, top) = low - margin, high + margin
        names = [system.state_names[i] for i in shown]
        portrait.set(xlim=(left, right), ylim=(bottom, top), title=system.name.replace("_", " "), xticks=[], yticks=[])
        portrait.set_xlabel(names[0], labelpad=2)
        portrait.set_ylabel(names[1], labelpad=2)
        strip.set(xlim=(0.0, self.t[-1]), ylim=(self.y.min(), self.y.max()), yticks=[], xticks=[0, int(self.t[-1])])
        strip.set_xlabel("t in s", labelpad=-8)
        strip.set_ylabel("y", labelpad=2)
        self.trails = [
            (
                portrait.plot([], [], style, color=color, lw=width, animated=True)[0],
                portrait.plot([], [], "o", color=color, markersize=size, animated=True)[0],
            )
            for style, color, width, size in (("-", TRUTH, 1.4, 7), ("-", ESTIMATE, 1.2, 4))
        ]
        self.outputs = [strip.plot([], [], color=MEASURED, lw=0.6, animated=True)[0] for _ in self.y.T]

    def name_lines(self, figure: Any) -> None:
        """Draw the legend above all columns."""
        lines = [*(trail for trail, _ in self.trails), self.outputs[0]]
        figure.legend(lines, ["state", "estimate", "what the observer sees"], loc="outside upper center", ncols=3)

    def show(self, share: float) -> None:
        """Draw the frame in which ``share`` of the samples have passed."""
        now = max(1, round(share * self.samples))
        first = max(0, now - round(TRAIL * self.samples))
        for (trail, head), states in zip(self.trails, (self.x, self.x_hat), strict=True):
            trail.set_data(*states[first:now].T)
            head.set_data(*states[now - 1 : now].T)
        for line, output in zip(self.outputs, self.y.T, strict=True):
            line.set_data(self.t[:now], output[:now])
        for artist in (*(artist for pair in self.trails for artist in pair), *self.outputs):
            artist.axes.draw_artist(artist)
