"""``python -m examples.research kinds``: agents in five kinds of partial observability, at equal CPU time."""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
import tyro
from gymnasium.spaces import flatdim
from rich.console import Console

import kkl_gym
from examples.research.agents.partly import ANGLES, ENV_ID, KINDS, MEASURED
from examples.research.agents.statistics import middle
from examples.research.resumable import Job, Workers, run_and_report
from training import files
from training.agents.environments import single, vector
from training.agents.information import FeatureObservation, make, weighted
from training.agents.play import play
from training.agents.seeds import AGENT_EVALUATION_SEED, agent_training_seed
from training.agents.tasks import Task
from training.progress import ProgressBars

if TYPE_CHECKING:
    import pandas as pd

    from kkl_gym.wrappers.vector import VectorEnv

Shown = Literal["state", "y", "stacked", "traces", "z", "x_hat", "lru"]
ALGORITHMS = {"CartPole-v1": "ppo"}  # all others: sac
FRAMES = 32  # length of the linear recurrent unit's history
EVALUATIONS, EPISODES, LAST_EPISODES = 15, 20, 100
OBSERVER_STEPS = 40_000  # random steps from which an observer, or the weights of z under noise, are learned
FAULTY = ("noise", "delay", "drop-out")  # kinds in which the observer tracks, and the agent sees only estimates
COLUMNS = ("environment", "kind", "shown", "seed", "steps", "seconds", "return", "observer_seconds")


@dataclass(frozen=True)
class TimedAgent(Job):
    """One agent, trained for ``seconds`` of CPU time, and evaluated during the training."""

    env_id: str
    kind: str
    shown: Shown
    seed: int
    seconds: float
    folder: Path

    result: ClassVar[str] = "curve.csv"
    other: ClassVar[str] = "an agent of another comparison"

    @property
    def name(self) -> str:
        """Environment, kind, information and seed."""
        return f"{self.env_id} {self.kind}/{self.shown}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """The settings on which the curve depends."""
        own = {"kind": KINDS[self.kind], "shown": self.shown, "seconds": self.seconds}
        return {"env_id": self.env_id, **own, "version": kkl_gym.__version__}

    @cached_property
    def task(self) -> Task:
        """The environment, whose observation is [y, state]."""
        how = {"env_id": self.env_id, **KINDS[self.kind], "hold": self.shown != "x_hat"}
        y, angles = tuple(range(self._ny)), ANGLES.get(self.env_id, ())
        task = Task(f"examples.research.agents.partly:{ENV_ID}", y, env_kwargs=how, angles=angles)
        weighs = self.shown == "z" and self._noise and angles  # without angles the weights are no better
        return weighted(task, OBSERVER_STEPS, seed=self.seed) if weighs else task

    @property
    def _ny(self) -> int:
        return len(MEASURED[self.env_id])

    @property
    def _noise(self) -> float:
        return float(KINDS[self.kind].get("noise", 0.0))

    def _states(self, size: int, known: Sequence[int] = ()) -> tuple[int, ...]:
        """Indices of the state in an observation of some size, without the entries that are known."""
        return tuple(place for place in range(self._ny, size) if place - self._ny not in known)

    def make(self, rows: int, observer: Path | None = None) -> "VectorEnv":
        """Make environments with the agent's information."""
        task = self.task
        if self.shown == "state":
            with closing(single(task)) as one:
                return make(replace(task, measured=self._states(flatdim(one.observation_space))), "y", rows)
        if self.shown == "lru":
            return make(replace(task, frames=FRAMES), "stacked", rows)
        if self.shown != "x_hat":
            return make(task, self.shown, rows)

        def observed(env: "VectorEnv") -> "VectorEnv":
            out = kkl_gym.KKLVectorObservation(env, observer, measurement_noise=self._noise)
            out.observer.delay = KINDS[self.kind].get("delay", 0)
            return out

        env = vector(task, rows, observed)
        first = self._ny if self.kind in FAULTY else 0
        return FeatureObservation(env, lambda at: at["obs"][:, first:], flatdim(env.single_observation_space) - first)

    def learn_observer(self) -> Path:
        """Learn an observer from random steps in a simulator. Returns its file."""
        from training.agents.observing import learn_observer
        from training.rollouts.playing import WANDERING, policy_of, roll_out

        with single(self.task) as env:
            env.get_wrapper_attr("exact")()
            known = () if self.kind in FAULTY else MEASURED[self.env_id]
            hidden = [str(place) for place in self._states(flatdim(env.observation_space), known)]
            outputs = [str(place) for place in range(self._ny)]
            policy = policy_of(WANDERING, env)
            rollouts = roll_out(env, policy, measured=outputs, hidden=hidden, steps=OBSERVER_STEPS, seed=self.seed)
        task, tracking = replace(self.task, measurement_noise=self._noise), self.kind in FAULTY
        quiet = ProgressBars(None)
        return learn_observer(task, rollouts.records(), self.folder, seed=self.seed, progress=quiet, tracking=tracking)

    def work(self) -> None:
        """Train for the CPU time; the time of evaluations does not count."""
        from examples.research.agents.recurrent import LinearRecurrence
        from training.agents.learning import Learner, hyperparameters

        began = time.process_time()
        task, observer = self.task, self.learn_observer() if self.shown == "x_hat" else None
        spent = time.process_time() - began
        algorithm = ALGORITHMS.get(self.env_id, "sac")
        settings = hyperparameters(algorithm, Task(self.env_id, tuple(MEASURED[self.env_id])))
        if algorithm == "sac":
            settings["buffer_size"] = 100_000  # more than the number of steps
        budget = _budget(self.seconds, lambda seconds: evaluate(seconds))
        for name, value in settings.items():
            if str(value).startswith("lin_"):
                settings[name] = _falling(float(value.removeprefix("lin_")), budget)
        if self.shown == "lru":
            extractor = {"features_extractor_class": LinearRecurrence, "features_extractor_kwargs": {"frames": FRAMES}}
            settings["policy_kwargs"] |= extractor
        rows, curve = settings.get("n_envs", 1), list[tuple[Any, ...]]()
        with (
            closing(Learner(algorithm, settings, self.seed, task, self.make(rows, observer), ())) as learner,
            closing(self.make(EPISODES, observer)) as few,
            closing(self.make(LAST_EPISODES, observer)) as many,
        ):
            model: Any = learner.model
            model.get_env().seed(agent_training_seed(self.seed, 0, rows))

            def evaluate(seconds: float) -> None:
                env = few if seconds < self.seconds else many
                value = play(env, policy_of(model), seed=AGENT_EVALUATION_SEED).returns.mean()
                at = (model.num_timesteps, round(seconds, 2), round(float(value), 3), round(spent, 1))
                curve.append((self.env_id, self.kind, self.shown, self.seed, *at))

            learner.learn(10**9, [budget])
        lines = [",".join(map(str, row)) for row in [COLUMNS, *curve]]
        files.write(self.folder / self.result, "\n".join(lines) + "\n")


def _falling(start: float, budget: Any) -> Callable[[float], float]:
    """A schedule that falls to zero over the CPU time instead of steps."""
    return lambda progress: start * float(budget.remaining())


def policy_of(model: Any) -> Callable[[np.ndarray], Any]:
    """The deterministic policy of a model, for use during its training."""
    scaling = model.get_vec_normalize_env()

    def act(obs: np.ndarray) -> Any:
        return model.predict(obs if scaling is None else scaling.normalize_obs(obs), deterministic=True)[0]

    return act


def _budget(seconds: float, evaluate: Callable[[float], None]) -> Any:
    """A callback that evaluates at equal intervals of CPU time, and stops at the last; evaluations do not count."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Budget(BaseCallback):
        began = time.process_time()
        evaluations = 0

        def remaining(self) -> float:
            return max(0.0, 1.0 - (time.process_time() - self.began) / seconds)

        def _on_training_start(self) -> None:
            self.began = time.process_time()

        def _on_step(self) -> bool:
            now = time.process_time()
            spent = now - self.began
            if spent >= seconds * ((self.evaluations + 1) / EVALUATIONS):
                self.evaluations += 1
                evaluate(spent)
                self.began += time.process_time() - now
            return spent < seconds

    return Budget()


@dataclass(frozen=True)
class Kinds:
    """Compare agents in five kinds of partial observability, each trained for the same CPU time on one core.

    Writes OUT/kinds.csv (returns along CPU seconds and steps) and OUT/table.md. The jobs are ordered by seed. After an
    interruption, the same command continues.
    """

    environments: tuple[str, ...] = ("Pendulum-v1", "CartPole-v1")
    """Environments whose velocities are hidden."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """masked (hidden velocities), noise (0.1), delay (5 steps), drop-out (30 %), parameters (new in each episode)."""
    information: tuple[Shown, ...] = get_args(Shown)
    """Information that agents see; lru is a linear recurrent unit over 32 frames."""
    seeds: int = 5
    """Number of agents of each kind."""
    seconds: float = 150.0
    """CPU seconds of a training."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = field(default_factory=Workers)
    out: Path = Path("runs/agents/kinds")
    """Folder of results."""

    def run(self, console: Console) -> None:
        """Train the missing agents, then report."""
        for name, values, known in (("environments", self.environments, MEASURED), ("kinds", self.kinds, KINDS)):
            if unknown := [value for value in values if value not in known]:
                raise ValueError(f"unknown {name} {', '.join(unknown)}; there are {', '.join(known)}")
        if self.seeds < 1 or self.seconds <= 0:
            raise ValueError(f"seeds and seconds must be positive, got {self.seeds} and {self.seconds}")
        cells = [
            (seed, env_id, kind, shown)
            for seed in range(self.seeds)
            for kind in self.kinds
            for env_id in self.environments
            for shown in self.information
            # Agents on the full state do not depend on the sensor.
            if shown != "state" or kind in ("masked", "parameters")
        ]
        agents = [
            TimedAgent(env_id, kind, shown, seed, self.seconds, self.out / "jobs" / env_id / kind / shown / str(seed))
            for seed, env_id, kind, shown in cells
        ]

        def report(progress: ProgressBars) -> None:
            done = [agent.folder / agent.result for agent in agents if agent.done]
            if done:
                import pandas as pd

                rows = pd.concat(map(pd.read_csv, done), ignore_index=True)
                files.write(self.out / "kinds.csv", rows.to_csv(index=False))
                files.write(self.out / "table.md", "\n".join(table(rows, len(agents) - len(done))) + "\n")
                progress.say(f"wrote kinds.csv and table.md in {self.out}")

        run_and_report(agents, self.out, console, workers=self.workers, what="agents", report=report)


def table(rows: "pd.DataFrame", missing: int = 0) -> list[str]:
    """Interquartile means of the last returns, with bootstrap intervals for three or more seeds."""
    last = rows.groupby(["environment", "kind", "shown", "seed"], sort=False).last().reset_index()
    shown = [name for name in get_args(Shown) if name in set(last.shown)]
    lines, steps = list[list[str]](), list[list[str]]()
    for (env_id, kind), group in last.groupby(["environment", "kind"], sort=False):
        label, values, reached = f"`{env_id}`, {kind}", list[str](), list[str]()
        for name in shown:
            of_state = name == "state" and kind not in ("masked", "parameters")
            own = last[(last.environment == env_id) & (last.kind == "masked")] if of_state else group
            own = own[own.shown == name]
            values.append(_cell(own["return"].to_numpy()))
            reached.append(f"{own.steps.mean() / 1000:.0f}" if len(own) else "–")
        lines.append([label, *values])
        steps.append([label, *reached])
    observers = rows[rows.shown == "x_hat"].observer_seconds
    fit = "" if observers.empty else f" Observers took {observers.mean():.0f} CPU seconds more."
    partial = f" Partial: {missing} agents are missing." if missing else ""
    return [
        "# Kinds of partial observability",
        "",
        f"Returns after {rows.seconds.max():.0f} CPU seconds: interquartile means over seeds, [95 % interval], "
        f"number of seeds.{fit}{partial}",
        "",
        *files.table(["", *shown], lines),
        "",
        "Thousands of steps in that time:",
        "",
        *files.table(["", *shown], steps),
    ]


def _cell(values: np.ndarray) -> str:
    if not len(values):
        return "–"
    ends = ""
    if len(values) > 2:
        drawn = np.random.default_rng(0).choice(values, (2000, len(values)))
        low, high = np.percentile(middle(drawn), [2.5, 97.5])
        ends = f" [{low:.4g}, {high:.4g}]"
    return f"{float(middle(values)):.4g}{ends}, {len(values)}"
