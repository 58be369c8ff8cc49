"""``python -m examples.research kinds``: agents in five kinds of partial observability, at equal CPU time."""

import itertools
import time
from collections.abc import Callable
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
from training.figures import drawing
from training.progress import ProgressBars

if TYPE_CHECKING:
    import pandas as pd

    from kkl_gym.wrappers.vector import VectorEnv

Shown = Literal["state", "y", "stacked", "traces", "z", "x_hat", "lru"]
# The settings of PPO for all environments and information sets, chosen on agents with the seeds 0, 4242 and 4243.
PPO: dict[str, Any] = {
    "policy": "MlpPolicy",
    "normalize": True,
    "n_envs": 16,
    "n_steps": 256,
    "batch_size": 256,
    "n_epochs": 10,
    "gamma": 0.95,
    "gae_lambda": 0.95,
    "target_kl": 0.03,
    "policy_kwargs": {"net_arch": [64, 64]},
}
CONTINUOUS = {"use_sde": True, "sde_sample_freq": 4}  # smooth exploration where actions are continuous
LEARNING_RATE = 0.001  # at the start; it falls linearly to zero
FRAMES = 32  # steps in the linear recurrent unit's history
EVALUATIONS, EPISODES, LAST_EPISODES = 10, 20, 100  # evaluations after the first; episodes of each, and of the last
OBSERVER_STEPS = 40_000  # number of steps for learning an observer or, under noise, the weights of z
TRUTH = 0.15  # initial share of the CPU time, in which agents on x_hat see the true state
FAULTY = ("noise", "delay", "drop-out")  # kinds in which the observer tracks, and agents on x_hat do not see y
OF_STATE = ("masked", "parameters")  # agents on the full state, who see no sensor faults, train in these only
STEPS = 200_000  # number of steps after which returns are compared, too
COLUMNS = ("environment", "kind", "shown", "seed", "steps", "seconds", "return")


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
        weighs = self.shown == "z" and self._noise and angles  # without angles, learned weights do not help
        return weighted(task, OBSERVER_STEPS, seed=self.seed) if weighs else task

    @property
    def _ny(self) -> int:
        return len(MEASURED[self.env_id])

    @property
    def _noise(self) -> float:
        return float(KINDS[self.kind].get("noise", 0.0))

    def _states(self, size: int) -> tuple[int, ...]:
        """Indices of the state in an observation, without the measured entries if agents on x_hat read these from y."""
        known = MEASURED[self.env_id] if self.shown == "x_hat" and self.kind not in FAULTY else ()
        return tuple(place for place in range(self._ny, size) if place - self._ny not in known)

    def make(self, rows: int, observer: Path | None = None) -> "VectorEnv":
        """Make environments with the agent's information; without an observer, the true state replaces x_hat."""
        task = self.task
        if self.shown in ("state", "x_hat") and observer is None:
            env = vector(task, rows)
            y = () if self.shown == "state" or self.kind in FAULTY else task.measured
            entries = [*y, *self._states(flatdim(env.single_observation_space))]
            return FeatureObservation(env, lambda at: at["obs"][:, entries], len(entries))
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

    def learn_observer(self, act: Callable[[np.ndarray], Any]) -> Path:
        """Learn an observer in a simulator: half from random steps, half from an agent that sees the true state."""
        from training.agents.observing import learn_observer
        from training.rollouts.playing import WANDERING, policy_of, roll_out

        with single(self.task) as env:
            env.get_wrapper_attr("exact")()
            places = self._states(flatdim(env.observation_space))
            seen = [*(() if self.kind in FAULTY else self.task.measured), *places]
            signals: Any = {"measured": [str(i) for i in self.task.measured], "hidden": [str(i) for i in places]}
            records = [
                record
                for policy in (policy_of(WANDERING, env), lambda obs: act(obs[None, seen])[0])
                for record in roll_out(env, policy, **signals, steps=OBSERVER_STEPS // 2, seed=self.seed).records()
            ]
        task, tracking = replace(self.task, measurement_noise=self._noise), self.kind in FAULTY
        quiet = ProgressBars(None)
        return learn_observer(task, records, self.folder, seed=self.seed, progress=quiet, tracking=tracking)

    def work(self) -> None:
        """Learn the observer and the agent within the CPU time. Evaluations do not count."""
        from examples.research.agents.recurrent import LinearRecurrence
        from training.agents.learning import Learner

        clock, observer, curve = _Clock(), None, list[tuple[Any, ...]]()
        # The curve also counts the steps from which the observer or the weights of z are learned.
        steps = OBSERVER_STEPS if self.shown == "x_hat" or self.task.weights is not None else 0
        settings = PPO | {"learning_rate": lambda _: LEARNING_RATE * max(0.0, 1.0 - clock.seconds / self.seconds)}
        if self.env_id != "CartPole-v1":
            settings |= CONTINUOUS
        if self.shown == "lru":
            extractor = {"features_extractor_class": LinearRecurrence, "features_extractor_kwargs": {"frames": FRAMES}}
            settings["policy_kwargs"] = {**PPO["policy_kwargs"], **extractor}
        with closing(Learner("ppo", settings, self.seed, self.task, self.make(PPO["n_envs"]), ())) as learner:
            model: Any = learner.model
            model.get_env().seed(agent_training_seed(self.seed, 0, PPO["n_envs"]))
            if self.shown == "x_hat":
                learner.learn(10**9, [_budget(clock, TRUTH * self.seconds)])
                observer = self.learn_observer(policy_of(model, deterministic=False))
                learner.move(self.make(PPO["n_envs"], observer), 1)
            with closing(self.make(EPISODES, observer)) as few, closing(self.make(LAST_EPISODES, observer)) as many:

                def evaluate(seconds: float) -> None:
                    env = few if seconds < self.seconds else many
                    value = play(env, policy_of(model), seed=AGENT_EVALUATION_SEED).returns.mean()
                    at = (model.num_timesteps + steps, round(seconds, 2), round(float(value), 3))
                    curve.append((self.env_id, self.kind, self.shown, self.seed, *at))

                learner.learn(10**9, [_budget(clock, self.seconds, evaluate)])
        lines = [",".join(map(str, row)) for row in [COLUMNS, *curve]]
        files.write(self.folder / self.result, "\n".join(lines) + "\n")


def policy_of(model: Any, *, deterministic: bool = True) -> Callable[[np.ndarray], Any]:
    """The policy of a model, for use during its training."""

    def act(obs: np.ndarray) -> Any:
        return model.predict(model.get_vec_normalize_env().normalize_obs(obs), deterministic=deterministic)[0]

    return act


class _Clock:
    """CPU seconds of this process since ``start``; an evaluation moves ``start``, so that its time does not count."""

    def __init__(self) -> None:
        self.start = time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self.start


def _budget(clock: _Clock, until: float, evaluate: Callable[[float], None] | None = None) -> Any:
    """A callback that stops a training at ``until`` s on the clock; it evaluates at equal intervals, and at the end."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Budget(BaseCallback):
        due = 0.0

        def _on_step(self) -> bool:
            seconds = clock.seconds
            if evaluate and seconds >= self.due:
                evaluate(seconds)
                clock.start = time.process_time() - seconds  # without the evaluation
                self.due = min(until, seconds + until / EVALUATIONS)
            return seconds < until

    return Budget()


@dataclass(frozen=True)
class Kinds:
    """Compare agents in five kinds of partial observability, at the same CPU time on one core.

    Writes OUT/kinds.csv (returns along CPU seconds and steps), OUT/table.md and OUT/curves.png. The jobs are ordered by
    seed. After an interruption, the same command continues.
    """

    environments: tuple[str, ...] = ("Pendulum-v1", "CartPole-v1")
    """Environments whose velocities are hidden, in every kind."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """masked (hidden velocities), noise (0.1 rms), delay (5 steps), drop-out (30 %), parameters (new per episode)."""
    information: tuple[Shown, ...] = get_args(Shown)
    """Information that agents see; lru is a linear recurrent unit over 32 frames."""
    seeds: int = 5
    """Number of agents for each environment, kind and information."""
    seconds: float = 50.0
    """CPU seconds of an agent's training, including its observer's."""
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
            if shown != "state" or kind in OF_STATE
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
                draw(self.out / "curves.png", rows)
                progress.say(f"wrote kinds.csv, table.md and curves.png in {self.out}")

        run_and_report(agents, self.out, console, workers=self.workers, what="agents", report=report)


def table(rows: "pd.DataFrame", missing: int = 0) -> list[str]:
    """Interquartile means of returns, at the end and after ``STEPS`` steps, with bootstrap intervals over seeds."""
    agents = rows.groupby(["environment", "kind", "shown", "seed"], sort=False)
    partial = f" Partial: {missing} agents are missing." if missing else ""
    lines = [
        "# Kinds of partial observability",
        "",
        "Returns: interquartile means over seeds, [95 % interval], number of seeds. Bold (full state left "
        f"out): the best mean, and means from the lower end of its interval on.{partial}",
        "",
    ]
    equal = agents.apply(lambda curve: np.interp(STEPS, curve.steps, curve["return"]))
    seconds = f"After {rows.seconds.max():.0f} CPU seconds:"
    for title, values in ((seconds, agents["return"].last()), (f"After {STEPS:,} steps:", equal)):
        lines += [title, "", *_by_kind(values), ""]
    return lines[:-1]


def _trained_in(kind: str, shown: str) -> str:
    """The kind in which the agents that are compared in ``kind`` were trained."""
    return "masked" if shown == "state" and kind not in OF_STATE else kind


def _by_kind(values: "pd.Series") -> list[str]:
    """A table with a row for each environment and kind, and a column for each kind of information."""
    shown = [name for name in get_args(Shown) if name in values.index.unique("shown")]
    groups = dict(iter(values.groupby(["environment", "kind", "shown"])))
    lines = list[list[str]]()
    for env_id, kind in values.index.droplevel(["shown", "seed"]).unique():
        keys = {name: (env_id, _trained_in(kind, name), name) for name in shown}
        text = _returns({name: groups[key].to_numpy() for name, key in keys.items() if key in groups})
        lines.append([f"`{env_id}`, {kind}", *(text.get(name, "–") for name in shown)])
    return files.table(["", *shown], lines)


def draw(path: Path, rows: "pd.DataFrame") -> None:
    """Draw mean returns over CPU seconds and over steps."""
    agents = dict(iter(rows.groupby(["environment", "kind", "shown"])))
    env_ids, kinds = rows.environment.unique(), rows.kind.unique()
    with drawing(path, 12.0, 2.0 * len(kinds) + 0.8) as figure:
        axes = figure.subplots(len(kinds), 2 * len(env_ids), squeeze=False, sharex="col")
        lines = dict[str, Any]()
        for (row, kind), (i, env_id), name in itertools.product(enumerate(kinds), enumerate(env_ids), get_args(Shown)):
            pair = axes[row, 2 * i : 2 * i + 2]
            for ax, over in zip(pair, ("seconds", "steps")):
                if (own := agents.get((env_id, _trained_in(kind, name), name))) is not None:
                    at = np.linspace(0, own[over].max(), 100)
                    seeds = [np.interp(at, one[over], one["return"], left=np.nan) for _, one in own.groupby("seed")]
                    (lines[name],) = ax.plot(at, np.mean(seeds, 0), color=f"C{get_args(Shown).index(name)}")
                ax.set_xlabel({"seconds": "CPU seconds", "steps": "steps"}[over] if row == len(kinds) - 1 else "")
            pair[0].set(ylabel="return", title=f"{env_id}, {kind}")
            pair[1].sharey(pair[0])
            pair[1].tick_params(labelleft=False)
            pair[1].xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}k")
        figure.legend(lines.values(), lines, loc="outside lower center", ncols=len(lines) or 1)


def _returns(row: dict[str, np.ndarray]) -> dict[str, str]:
    drawn = np.random.default_rng(0)
    means = {name: float(middle(values)) for name, values in row.items()}
    ends = {
        name: np.percentile(middle(drawn.choice(values, (2000, len(values)))), [2.5, 97.5])
        for name, values in row.items()
    }
    best = max((name for name in means if name != "state"), key=means.__getitem__, default=None)
    text = dict[str, str]()
    for name, values in row.items():
        mean = f"{means[name]:.4g}"
        if best and name != "state" and means[name] >= ends[best][0]:
            mean = f"**{mean}**"
        interval = f" [{ends[name][0]:.4g}, {ends[name][1]:.4g}]" if len(values) > 2 else ""
        text[name] = f"{mean}{interval}, {len(values)}"
    return text
