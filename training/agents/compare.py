"""What knowing is worth: agents on every information set, several seeds each, on the same unseen episodes."""

import json
import os
import time
from dataclasses import asdict, dataclass
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
from training.agents.information import make, observer_of
from training.agents.play import Policy, play
from training.agents.policy import fingerprint, rules, versioned
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
MORE_NOISE_RECURRENT_SEEDS = 1
MANY = 1000  # seeds, more than anyone trains
PROTOCOL = 1  # changes where results must not be mixed with earlier ones
EVALUATION_SEED = 10**9  # of the first of the evaluation's episodes; training's are far below


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
        from training.agents.learn import hyperparameters

        task = get_task(self.system, self.measurement_noise)
        recurrent = self.knows.startswith("recurrent")
        observer = versioned(observer_of(get_system(task.system))) if self.knows in ("x_hat", "z") else None
        described = {
            "protocol": PROTOCOL,
            "episodes": self.episodes,
            "timesteps": self.timesteps,
            "task": asdict(task),
            "rules": rules(task),
            "hyperparameters": hyperparameters(task, "ppo_lstm" if recurrent else None),
            "observer": None if observer is None else [observer, fingerprint(observer)],
            "version": kkl_gym.__version__,
        }
        return dict(json.loads(json.dumps(described)))

    @property
    def done(self) -> bool:
        """Whether its result is there; raises ValueError if it is that of another comparison."""
        path = self.folder / "result.json"
        if not path.exists():
            return False
        found, asked = json.loads(path.read_text())["identity"], self.identity
        for name, value in asked.items():
            if found.get(name) != value:
                raise ValueError(
                    f"{path} is of another comparison: {name} = {found.get(name)}, not {value}; choose another --out, "
                    "or remove it"
                )
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
    """Agents of each kind; of the recurrent ones, which take longest, 3, and 1 where there is more or less noise."""
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
        for names in (self.systems, self.knows):
            if not names or len(set(names)) < len(names):
                raise ValueError(f"give systems and what agents know, each once; got {names}")
        cases = self.cases()
        todo = [case for case in cases if not case.done]
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        failures = []
        try:
            with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
                bar = progress.add_task("agents", total=len(cases), completed=len(cases) - len(todo))
                for case, failure, _ in run_all(run_case, todo, min(self.jobs, max(1, len(todo)))):
                    if failure:
                        failures.append(f"{case.name}: {failure}")
                    progress.console.print(f"[red]failed[/red] {failures[-1]}" if failure else f"finished {case.name}")
                    progress.advance(bar)
        finally:  # also after an interruption
            results = collect(self.out, self.episodes, self.timesteps)
            if len(results):
                write(self.out / "results.csv", results.to_csv(index=False))
                report(self.out)
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
            if not knows.startswith("recurrent")
            or seed < (RECURRENT_SEEDS if level == noise[system][0] else MORE_NOISE_RECURRENT_SEEDS)
        ]


def collect(out: Path, episodes: int, timesteps: int | None) -> pd.DataFrame:
    """One row for each agent in the folder, whoever trained it; raises ValueError if some are of another comparison."""
    plan = Compare(seeds=MANY, episodes=episodes, timesteps=timesteps, out=out).cases()
    idle_scores: dict[tuple[str, float], float] = {}
    rows = []
    for case in plan:
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


def normalised(scores: np.ndarray, top: float, idle: float) -> np.ndarray:
    """0 is zero input, 1 is ``top``; NaN if that is no better than zero input."""
    return (scores - idle) / (top - idle) if top > idle else np.full(np.shape(scores), np.nan)


def middle(values: np.ndarray, axis: int = -1) -> Any:
    """Interquartile mean."""
    from scipy.stats import trim_mean

    return trim_mean(values, 0.25, axis=axis)


def interval(values: np.ndarray, best: np.ndarray, idle: float) -> tuple[float, float, float]:
    """Interquartile mean of the normalised scores of agents, with a bootstrap 95 % interval.

    values, best : scores of these agents and of those that know the full state, one for each agent; both are resampled.
    The interval is NaN for fewer than three agents. With five it covers about nine times in ten, for which bootstrap
    intervals of so few are known.
    """
    found = float(normalised(middle(values), float(middle(best)), idle))
    if min(len(values), len(best)) < 3:
        return found, np.nan, np.nan
    rng = np.random.default_rng(0)
    same = values is best
    draws = []
    for _ in range(2000):
        tops = rng.choice(best, len(best))
        mine = tops if same else rng.choice(values, len(values))
        reference = float(middle(best)) if same else float(middle(tops))
        draws.append(float(normalised(middle(mine), reference, idle)))
    low, high = np.nanquantile(draws, [0.025, 0.975])
    return found, float(low), float(high)


def report(out: Path) -> None:
    """Table and figure from results.csv alone."""
    results = pd.read_csv(out / "results.csv")
    missing = len(Compare().cases()) - len(results)
    partial = f" Partial: {missing} of {len(Compare().cases())} agents are missing." if missing > 0 else ""
    tasks = list(results[["system", "noise"]].drop_duplicates().itertuples(index=False, name=None))
    lines = [
        "# Agents",
        "",
        "Normalised score: 0 is zero input, 1 the interquartile mean of the agents that know the full state. "
        "Interquartile mean over agents [bootstrap 95 % interval], success rate in %, number of agents. Observers see "
        f"every sample of y; agents on y see it once for each action.{partial}",
        "",
        "| | " + " | ".join(f"{system.replace('_', ' ')}, noise {noise:g}" for system, noise in tasks) + " |",
        "|---" * (1 + len(tasks)) + "|",
    ]
    cells = _cells(results, tasks)
    for knows in KNOWS:
        row = []
        for task in tasks:
            cell = cells.get((*task, knows))
            if cell is None:
                row.append("–")
                continue
            found, low, high = cell["interval"]
            spread = "" if np.isnan(low) else f" [{low:.2f}, {high:.2f}]"
            row.append(f"{found:.2f}{spread}, {100 * cell['success']:.0f} %, {len(cell['agents'])}")
        lines.append(f"| {LABELS[knows]} | " + " | ".join(row) + " |")
    minutes = results.groupby("knows").seconds.mean() / 60
    spent = ", ".join(f"{LABELS[knows]} {minutes[knows]:.1f}" for knows in KNOWS if knows in minutes)
    lines += ["", f"CPU minutes for one training: {spent}."]
    write(out / "table.md", "\n".join(lines) + "\n")
    _draw(out / "scores.png", results, tasks, partial)


def _cells(results: pd.DataFrame, tasks: list[tuple[str, float]]) -> dict[tuple[str, float, str], dict[str, Any]]:
    """What table and figure show for each task and kind of agent."""
    cells = {}
    for system, noise in tasks:
        here = results[(results.system == system) & (results.noise == noise)]
        best = here[here.knows == "state"].score.to_numpy()
        if not len(best):  # nothing to measure the others by
            continue
        idle_score = float(here.idle.iloc[0])
        for knows, group in here.groupby("knows"):
            values = best if knows == "state" else group.score.to_numpy()
            found = interval(values, best, idle_score)
            if np.isfinite(found[0]):
                cells[system, noise, str(knows)] = {
                    "interval": found,
                    "agents": normalised(values, float(middle(best)), idle_score),
                    "success": group.success.mean(),
                }
    return cells


def _draw(path: Path, results: pd.DataFrame, tasks: list[tuple[str, float]], partial: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * len(tasks) + 1.5, 3.6), layout="constrained")
    axes = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    cells = _cells(results, tasks)
    for ax, task in zip(axes, tasks, strict=True):
        for place, knows in enumerate(reversed(KNOWS)):
            cell = cells.get((*task, knows))
            if cell is not None:
                found, low, high = cell["interval"]
                ax.plot(cell["agents"], np.full(len(cell["agents"]), place), ".", color="0.6", markersize=4)
                ax.plot([low, high], [place, place], color="C0", lw=2)
                ax.plot(found, place, "o", color="C0")
        ax.axvline(1.0, color="0.8", lw=0.8)
        ax.set(title=f"{task[0].replace('_', ' ')}, noise {task[1]:g}", xlabel="normalised score")
        ax.set_yticks(range(len(KNOWS)), [LABELS[knows] for knows in reversed(KNOWS)])
    figure.suptitle(f"What agents know and how well they act.{partial}", fontsize="medium")
    temporary = path.with_name(f".{path.name}.new.png")
    figure.savefig(temporary, dpi=110)
    os.replace(temporary, path)
