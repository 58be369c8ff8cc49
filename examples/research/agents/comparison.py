"""The compared agents of a task: their kinds, and the training and evaluation of each."""

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np

import kkl_gym
from examples.research.resumable import Job
from kkl_gym import get_system
from observers.storage import explained
from training.agents.agent import fingerprint, rules
from training.agents.environments import vector
from training.agents.information import OBSERVED, Information, make, observer_of
from training.agents.play import play
from training.agents.seeds import AGENT_EVALUATION_SEED
from training.agents.tasks import Task, scores, successes
from training.evaluation.levels import as_cell, show_level
from training.files import write

if TYPE_CHECKING:
    import pandas as pd

# Kinds of agents differ in the information that they see, in the source of estimates, or in the algorithm.
Kind = Literal[
    "state",
    "ekf",
    "x_hat",
    "x_hat_std",
    "z",
    "traces",
    "stacked",
    "y",
    "recurrent",
    "recurrent-state",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
ON_SYSTEMS: tuple[Kind, ...] = ("state", "ekf", "x_hat", "z", "stacked", "y", "recurrent", "recurrent-state")
IN_ENVIRONMENTS: tuple[Kind, ...] = ("state", "x_hat", "z", "stacked", "recurrent", "y")
IDLE: Literal["random"] = "random"  # zero input on systems, random actions in environments; the 0 of normalised scores
# The information that agents of these kinds see; all other kinds have the name of their information.
SEEN: dict[str, Information] = {"ekf": "x_hat", "recurrent-state": "state"}
# For some settings of a task: the kinds of agents that depend on the setting.
CONCERNED = {
    "time_constants": ("z", "traces"),
    "frames": ("stacked",),
    "past_actions": ("z", "traces", "stacked"),
    "angles": ("z",),
    "weights": ("z",),
}
SECOND_NOISE = {"van_der_pol": 0.2, "lorenz": 2.0}  # second level (standard deviation) of the noise on y
SEEDS = 5
# Largest numbers of agents of each (slow) recurrent kind on a system: at the first and at the second noise level.
RECURRENT_SEEDS, SECOND_NOISE_RECURRENT_SEEDS = 3, 1
COLUMNS = {
    "results.csv": ["environment", "noise", "shown", "seed", "return", "success", "seconds"],
    "curves.csv": ["environment", "noise", "shown", "steps", "seconds", "return"],
}


@dataclass(frozen=True)
class ComparedAgent(Job):
    """One agent: trained, then played on the evaluation's episodes."""

    task: Task
    kind: Kind | Literal["random"]
    seed: int
    episodes: int
    timesteps: int | None
    aggregate: int
    folder: Path
    observer: str | None = None

    result: ClassVar[str] = "result.json"
    other: ClassVar[str] = "an agent of another comparison"

    @property
    def name(self) -> str:
        """Task, noise, kind and seed."""
        return f"{self.task.name} at noise {show_level(self.task.measurement_noise)}/{self.kind}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """All on which the result depends, except kind and seed, which are in the folder's name."""
        task = asdict(self.task)
        for setting, kinds in CONCERNED.items():
            if self.kind not in kinds:
                del task[setting]
        described: dict[str, Any] = {"episodes": self.episodes, "task": task, "version": kkl_gym.__version__}
        if self.kind == IDLE:
            return described
        from training.agents.learning import PRIVILEGED, REHEARSAL, WANDERED, hyperparameters

        algorithm = self._algorithm
        described |= {
            "rules": rules(self.task),
            "timesteps": self.timesteps,
            "algorithm": algorithm,
            "hyperparameters": hyperparameters(algorithm, self.task),
        }
        if self._observer is not None:
            described["observer"] = [self._observer, fingerprint(self._observer)]
        elif self.kind == "x_hat":
            begins = WANDERED if self.task.measurement_noise else PRIVILEGED
            described |= {"aggregate": self.aggregate, "begins": begins, "rehearsal": REHEARSAL}
        return described

    @property
    def _observer(self) -> str | None:
        """Return the observer's name or file on systems; None in environments, and for kinds without an observer."""
        if self.task.system is None or self.kind not in OBSERVED:
            return None
        return self.observer or observer_of(get_system(self.task.system))

    @property
    def _information(self) -> Information:
        return SEEN.get(self.kind, self.kind)  # type: ignore[arg-type]

    @property
    def _algorithm(self) -> str:
        from training.agents.learning import RECURRENT, algorithm_for

        if self.kind.startswith("recurrent"):
            return RECURRENT
        with closing(vector(self.task, 1)) as env:
            return algorithm_for(self.task, self._information, env.single_action_space)

    def work(self) -> None:
        """Train the agent, play it, and write the return of each episode."""
        began, task = time.process_time(), self.task
        if self.kind == IDLE:
            env = make(task, "state", self.episodes)
            policy = _still(env) if task.system is not None else _random(env)
        else:
            from examples.research.agents.filtered import show_filtered
            from training.agents.learning import learn
            from training.agents.observing import OBSERVER

            show = show_filtered if self.kind == "ekf" else make
            fitted = task.system is None and self.kind == "x_hat"  # the observer is learned from hidden signals
            agent = learn(
                task,
                self._information,
                self.folder,
                algorithm=self._algorithm,
                timesteps=self.timesteps,
                seed=self.seed,
                observer=self._observer,
                aggregate=self.aggregate if fitted else 0,
                show=show,
            )
            observer = str(self.folder / OBSERVER) if fitted else self._observer
            env = show(agent.task, self._information, self.episodes, observer=observer)
            policy = agent.policy(env.single_action_space)
        seconds = time.process_time() - began
        with closing(env):
            played = play(env, policy, seed=AGENT_EVALUATION_SEED)
        values, held = played.returns, None
        if task.system is not None:
            system, x = get_system(task.system), played.signals("x")
            values, held = scores(system, x), successes(system, x).tolist()
        result = {"returns": values.round(6).tolist(), "successes": held, "seconds": round(seconds, 1)}
        write(self.folder / self.result, json.dumps(result) + "\n")


def _still(env: Any) -> Any:
    return lambda obs: np.zeros((len(obs), *env.single_action_space.shape))


def _random(env: Any) -> Any:
    env.action_space.seed(AGENT_EVALUATION_SEED)
    return lambda obs: env.action_space.sample()


def planned(
    tasks: Sequence[Task],
    out: Path,
    *,
    kinds: Sequence[Kind] | None = None,
    seeds: int = SEEDS,
    observers: dict[str, str] | None = None,
    **how: Any,
) -> list[ComparedAgent]:
    """Return the agents in the order of seeds; an environment's noise levels share full-state and idle agents."""
    agents: dict[Path, ComparedAgent] = {}
    for seed in range(seeds):
        for task in tasks:
            usual = IN_ENVIRONMENTS if task.system is None else ON_SYSTEMS
            second = SECOND_NOISE.get(task.name) == task.measurement_noise
            most = SECOND_NOISE_RECURRENT_SEEDS if second else RECURRENT_SEEDS
            for kind in (*((IDLE,) if seed == 0 else ()), *(usual if kinds is None else kinds)):
                own = task.without_noise if task.system is None and kind in ("state", IDLE) else task
                if task.system is not None and kind.startswith("recurrent") and seed >= most:
                    continue
                folder = out / "jobs" / f"{own.name}-{show_level(own.measurement_noise)}" / kind / str(seed)
                observer = (observers or {}).get(own.name)
                agents.setdefault(folder, ComparedAgent(own, kind, seed, **how, folder=folder, observer=observer))
    return list(agents.values())


def seeds_in(out: Path) -> int:
    """Return 1 + the largest seed in the agents' folders, OUT/jobs/TASK-NOISE/KIND/SEED."""
    return 1 + max((int(path.name) for path in out.glob("jobs/*/*/*") if path.name.isdigit()), default=-1)


def collect(agents: Sequence[ComparedAgent]) -> "pd.DataFrame":
    """Return the results of agents that are done, a row for each."""
    import pandas as pd

    rows = []
    for agent in agents:
        with explained(agent.folder / agent.result, ValueError):
            result = json.loads((agent.folder / agent.result).read_text())
            value = round(float(np.mean(result["returns"])), 6)
            success = np.nan if result["successes"] is None else float(np.mean(result["successes"]))
            noise = as_cell(agent.task.measurement_noise)
            rows.append((agent.task.name, noise, agent.kind, agent.seed, value, success, result["seconds"]))
    return pd.DataFrame(rows, columns=COLUMNS["results.csv"])


def read_results(folder: Path) -> "pd.DataFrame":
    """Read a comparison's results.csv."""
    import pandas as pd

    return pd.read_csv(folder / "results.csv", index_col=False).reindex(columns=COLUMNS["results.csv"])


def unusual_settings(tasks: Sequence[Task]) -> str:
    """Return a sentence with the changed settings of memories and stacks, or no text if all are the defaults."""
    changed = []
    for field in fields(Task):
        values = {getattr(task, field.name) for task in tasks} if field.name in CONCERNED else set()
        changed += [f"`{field.name}` {value}" for value in values if value != field.default]
    return f"Agents on z, traces and stacked observations: {', '.join(changed)}." if changed else ""
