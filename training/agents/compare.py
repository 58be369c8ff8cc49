"""What knowing is worth: agents on every information set, several seeds each, on the same unseen episodes."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import pandas as pd
import torch
import tyro
from filelock import FileLock, Timeout
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import kkl_gym
from kkl_gym import get_system
from training.agents.information import make
from training.agents.play import Policy, play
from training.agents.tasks import TASKS, get_task, scores, successes
from training.files import write
from training.parallel import run_all

Knows = Literal["state", "ekf", "x_hat", "z", "stacked", "y", "recurrent", "recurrent-state"]
KNOWS: tuple[Knows, ...] = get_args(Knows)
LABELS = {
    "state": "full state",
    "ekf": "EKF estimate",
    "x_hat": "x̂",
    "z": "ẑ",
    "stacked": "8 y and actions",
    "y": "y",
    "recurrent": "y, recurrent agent",
    "recurrent-state": "full state, recurrent agent",
}
MORE_NOISE = {"van_der_pol": 0.2, "lorenz": 2.0}
RECURRENT_SEEDS = 3
EVALUATION_SEED = 0  # first of the evaluation's episodes; training begins at 10,000


@dataclass(frozen=True)
class Case:
    """One agent: trained, then played on the evaluation's episodes.

    folder : receives result.json, the learning curve and, where the policy is a perceptron, agent.safetensors.
    """

    system: str
    measurement_noise: float
    knows: Knows
    seed: int
    episodes: int
    timesteps: int | None
    folder: Path

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.system} at noise {self.measurement_noise:g}/{self.knows}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """What must not differ between a result that is there and one that is asked for."""
        return {"episodes": self.episodes, "timesteps": self.timesteps, "version": kkl_gym.__version__}

    @property
    def done(self) -> bool:
        """Whether its result is there; raises ValueError if it is that of another comparison."""
        path = self.folder / "result.json"
        if not path.exists():
            return False
        found = json.loads(path.read_text())["identity"]
        if found != self.identity:
            raise ValueError(f"{path} is of another comparison: {found}, not {self.identity}; choose another --out")
        return True


def run_case(case: Case) -> None:
    """Train and evaluate, unless another process is at it or it is done."""
    case.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(case.folder / "lock", timeout=0):
            if not case.done:
                _run(case)
    except Timeout:
        raise ValueError("another process is working on it") from None


def _run(case: Case) -> None:
    from training.agents.learn import learn, learn_recurrent

    torch.set_num_threads(1)
    task = get_task(case.system, case.measurement_noise)
    began = time.process_time()
    policy: Policy
    if case.knows in ("recurrent", "recurrent-state"):
        of: Literal["y", "state"] = "y" if case.knows == "recurrent" else "state"
        policy = learn_recurrent(task, of, case.folder, case.seed, case.timesteps)()
        env = make(task, of, case.episodes, "Disabled", with_action=True)
    else:
        information: Any = case.knows
        policy = agent = learn(task, information, case.folder, case.seed, case.timesteps)
        env = agent.make(case.episodes)
    seconds = time.process_time() - began
    x = play(env, policy, task.steps, EVALUATION_SEED).x
    result = {
        "identity": case.identity,
        "scores": scores(get_system(task.system), x).round(6).tolist(),
        "successes": successes(task, x).tolist(),
        "seconds": round(seconds, 1),
    }
    write(case.folder / "result.json", json.dumps(result) + "\n")


def idle(system: str, measurement_noise: float, episodes: int) -> np.ndarray:
    """Scores of zero input on the evaluation's episodes, (episodes,)."""
    task = get_task(system, measurement_noise)
    env = make(task, "state", episodes, "Disabled")
    (nu,) = env.single_action_space.shape  # type: ignore[misc]
    x = play(env, lambda obs: np.zeros((len(obs), nu)), task.steps, EVALUATION_SEED).x
    return scores(get_system(task.system), x)


@dataclass(frozen=True)
class Compare:
    """Train agents that know different things, several seeds each, and compare them on the same unseen episodes.

    Writes OUT/results.csv (a row for each agent), OUT/table.md and OUT/scores.png. Each agent is a job with a folder of
    its own; what is there is not done again, so that a run may be stopped at any time. Missing agents are said to be.
    """

    systems: tuple[str, ...] = tuple(TASKS)
    """Systems with a control task."""
    knows: tuple[Knows, ...] = KNOWS
    """What agents know."""
    seeds: int = 5
    """Agents of each kind; 3 of the recurrent ones, which take longest."""
    episodes: int = 100
    """Evaluation episodes."""
    timesteps: int | None = None
    """Actions to learn from; default: the hyperparameters'."""
    more_noise: bool = True
    """Also Van der Pol at noise 0.2 and Lorenz at 2."""
    jobs: int = 2
    """Worker processes, of one thread each."""
    out: Annotated[Path, tyro.conf.arg(help_behavior_hint="(default: agents/comparison)")] = Path("agents/comparison")
    """Folder of results."""

    def run(self, console: Console) -> None:
        """Run what is missing, then report."""
        if min(self.seeds, self.episodes, self.jobs) < 1:
            raise ValueError("seeds, episodes and jobs must be positive")
        cases = self.cases()
        todo = [case for case in cases if not case.done]
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        failures = []
        with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
            bar = progress.add_task("agents", total=len(cases), completed=len(cases) - len(todo))
            for case, failure, _ in run_all(run_case, todo, min(self.jobs, max(1, len(todo)))):
                if failure:
                    failures.append(f"{case.name}: {failure}")
                progress.console.print(f"[red]failed[/red] {failures[-1]}" if failure else f"finished {case.name}")
                progress.advance(bar)
        if any(case.done for case in cases):
            collect(cases).to_csv(self.out / "results.csv", index=False)
            report(self.out, len(cases))
            console.print(f"wrote results.csv, table.md and scores.png in {self.out}")
        if failures:
            raise ValueError(f"{len(failures)} of {len(cases)} agents failed; the first: {failures[0]}")

    def cases(self) -> list[Case]:
        """All agents, the first seed of each first."""
        noise: dict[str, tuple[float, ...]] = {system: (get_task(system).measurement_noise,) for system in self.systems}
        if self.more_noise:
            noise |= {name: (*noise[name], level) for name, level in MORE_NOISE.items() if name in noise}
        return [
            Case(
                system,
                level,
                knows,
                seed,
                self.episodes,
                self.timesteps,
                self.out / "jobs" / f"{system}-{level:g}" / knows / str(seed),
            )
            for seed in range(self.seeds)
            for system in self.systems
            for level in noise[system]
            for knows in self.knows
            if seed < RECURRENT_SEEDS or not knows.startswith("recurrent")
        ]


def collect(cases: list[Case]) -> pd.DataFrame:
    """One row for each agent that is done."""
    idle_scores: dict[tuple[str, float], float] = {}
    rows = []
    for case in cases:
        if not case.done:
            continue
        key = (case.system, case.measurement_noise)
        if key not in idle_scores:
            idle_scores[key] = float(idle(*key, case.episodes).mean())
        result = json.loads((case.folder / "result.json").read_text())
        rows.append(
            {
                "system": case.system,
                "noise": case.measurement_noise,
                "knows": case.knows,
                "seed": case.seed,
                "score": np.mean(result["scores"]),
                "success": np.mean(result["successes"]),
                "idle": idle_scores[key],
                "seconds": result["seconds"],
            }
        )
    return pd.DataFrame(rows)


def normalised(results: pd.DataFrame) -> pd.DataFrame:
    """With a column ``normalised``: 0 is zero input, 1 the mean of the agents that know the full state."""
    best = results[results.knows == "state"].groupby(["system", "noise"]).score.mean()
    out = results.copy()
    top = np.array([best.get(key, np.nan) for key in zip(results.system, results.noise, strict=True)])
    out["normalised"] = (results.score - results.idle) / (top - results.idle)
    return out


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Interquartile mean over agents and its bootstrap 95 % interval."""
    from scipy.stats import bootstrap, trim_mean

    values = np.asarray(values, dtype=float)
    middle = float(trim_mean(values, 0.25))
    if len(set(values)) < 2:
        return middle, middle, middle
    found = bootstrap(
        (values,), lambda v, axis: trim_mean(v, 0.25, axis=axis), method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return middle, float(found.low), float(found.high)


def report(out: Path, planned: int) -> None:
    """Table and figure from results.csv alone."""
    results = normalised(pd.read_csv(out / "results.csv"))
    partial = "" if len(results) == planned else f" Partial: {len(results)} of {planned} agents."
    tasks = list(results[["system", "noise"]].drop_duplicates().itertuples(index=False, name=None))
    lines = [
        "# Agents",
        "",
        "Normalised score: 0 is zero input, 1 the mean of the agents that know the full state. Interquartile mean over "
        f"agents [bootstrap 95 % interval], success rate in %, agents.{partial}",
        "",
        "| | " + " | ".join(f"{system.replace('_', ' ')}, noise {noise:g}" for system, noise in tasks) + " |",
        "|---" * (1 + len(tasks)) + "|",
    ]
    for knows in KNOWS:
        cells = []
        for system, noise in tasks:
            group = results[(results.system == system) & (results.noise == noise) & (results.knows == knows)]
            if group.empty or group.normalised.isna().any():
                cells.append("–")
                continue
            middle, low, high = interval(group.normalised.to_numpy())
            cells.append(f"{middle:.2f} [{low:.2f}, {high:.2f}], {100 * group.success.mean():.0f} %, {len(group)}")
        lines.append(f"| {LABELS[knows]} | " + " | ".join(cells) + " |")
    minutes = results.groupby("knows").seconds.mean() / 60
    spent = ", ".join(f"{LABELS[knows]} {minutes[knows]:.1f}" for knows in KNOWS if knows in minutes)
    lines += ["", f"CPU minutes for one training: {spent}."]
    write(out / "table.md", "\n".join(lines) + "\n")
    _draw(out / "scores.png", results, tasks, partial)


def _draw(path: Path, results: pd.DataFrame, tasks: list[tuple[str, float]], partial: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * len(tasks) + 1.5, 3.6), layout="constrained")
    axes = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for ax, (system, noise) in zip(axes, tasks, strict=True):
        for place, knows in enumerate(reversed(KNOWS)):
            group = results[(results.system == system) & (results.noise == noise) & (results.knows == knows)]
            values = group.normalised.to_numpy()
            if len(values) and np.isfinite(values).all():
                middle, low, high = interval(values)
                ax.plot(values, np.full(len(values), place), ".", color="0.6", markersize=4)
                ax.plot([low, high], [place, place], color="C0", lw=2)
                ax.plot(middle, place, "o", color="C0")
        ax.axvline(1.0, color="0.8", lw=0.8)
        ax.set(title=f"{system.replace('_', ' ')}, noise {noise:g}", xlabel="normalised score")
        ax.set_yticks(range(len(KNOWS)), [LABELS[knows] for knows in reversed(KNOWS)])
    figure.suptitle(f"What agents know and how well they act.{partial}", fontsize="medium")
    figure.savefig(path, dpi=110)
