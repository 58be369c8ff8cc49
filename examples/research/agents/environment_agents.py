"""Agents in environments of which they see a part: which there are, and the training and returns of each."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import gymnasium as gym
import numpy as np

import kkl_gym
from examples.research.resumable import Job
from kkl_gym.memory import IMAGINED
from observers.storage import explained
from training.agents.any_environment.information import Shown, show
from training.agents.any_environment.task import HiddenTask
from training.agents.seeds import AGENT_EVALUATION_SEED
from training.files import write

if TYPE_CHECKING:
    import pandas as pd
    from stable_baselines3.common.vec_env import VecEnv

Kind = Literal["state", "x_hat", "stacked_x_hat", "z", "stacked", "recurrent", "y"]
KINDS: tuple[Kind, ...] = get_args(Kind)
ESTIMATES: tuple[Kind, ...] = ("x_hat", "stacked_x_hat")  # whose estimates are learned from the hidden signals
RANDOM: Literal["random"] = "random"  # actions, whose return has the normalised score 0
ROWS = 10  # episodes that are played at a time
KINDS_WITH = {  # settings of a task that matter to some agents alone
    "time_constants": ("z",),
    "frames": ("stacked", "stacked_x_hat"),
    "past_actions": ("z", "stacked"),
    "angles": ("z", "stacked"),
}
COLUMNS = {
    "results.csv": ["environment", "noise", "shown", "seed", "return", "seconds"],
    "curves.csv": ["environment", "noise", "shown", "steps", "seconds", "return"],
}


@dataclass(frozen=True)
class EnvironmentAgent(Job):
    """One agent: trained, then played on the evaluation's episodes."""

    task: HiddenTask
    kind: Kind | Literal["random"]
    seed: int
    episodes: int
    timesteps: int | None
    aggregate: int
    folder: Path

    result: ClassVar[str] = "result.json"
    other: ClassVar[str] = "an agent of another comparison"

    @property
    def name(self) -> str:
        """Task, kind and seed."""
        return f"{self.task.name}/{self.kind}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """Task, hyperparameters and the package's version, without what does not concern this kind of agents."""
        task = asdict(self.task)
        for setting, kinds in KINDS_WITH.items():
            if self.kind not in kinds:
                del task[setting]
        described: dict[str, Any] = {"episodes": self.episodes, "task": task, "version": kkl_gym.__version__}
        if self.kind == RANDOM:
            return described
        from training.agents.any_environment.learning import REHEARSAL, TOLD, WANDERED, algorithm_for, hyperparameters

        with self.task.make() as env:
            algorithm = algorithm_for(env.action_space, self.task.env_id, shown_as(self.kind))
        described |= {
            "timesteps": self.timesteps,
            "algorithm": algorithm,
            "hyperparameters": hyperparameters(algorithm, self.task.env_id),
        }
        if self.kind in ESTIMATES:
            begins = WANDERED if self.task.measurement_noise else TOLD
            described |= {"aggregate": self.aggregate, "begins": begins, "rehearsal": REHEARSAL}
        if self.kind == "z":
            described["past"] = IMAGINED
        return described

    def work(self) -> None:
        """Train the agent, play it and write its returns."""
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.evaluation import evaluate_policy

        from examples.research.agents.window import STACKED
        from training.agents.any_environment.learning import learn_to_play
        from training.agents.any_environment.observing import KKL, OBSERVER

        began = time.process_time()
        model: Any = None
        if self.kind != RANDOM:
            model = learn_to_play(
                self.task,
                shown_as(self.kind),
                self.folder,
                timesteps=self.timesteps,
                seed=self.seed,
                aggregate=self.aggregate if self.kind in ESTIMATES else 0,
                estimation=STACKED if self.kind == "stacked_x_hat" else KKL,
            )
        seconds = time.process_time() - began
        observer, rows = str(self.folder / OBSERVER), min(ROWS, self.episodes)
        env: Any = make_vec_env(lambda: self._environment(observer), rows, seed=AGENT_EVALUATION_SEED)
        try:
            policy: Any = RandomActions(env) if model is None else model
            returns: Any = evaluate_policy(
                policy,
                env if model is None else _scaled(env, model),
                n_eval_episodes=self.episodes,
                return_episode_rewards=True,
                warn=False,
            )[0]
        finally:
            env.close()
        result = {"returns": [round(float(value), 4) for value in returns], "seconds": round(seconds, 1)}
        write(self.folder / self.result, json.dumps(result) + "\n")

    def _environment(self, observer: str) -> gym.Env[np.ndarray, Any]:
        if self.kind == "stacked_x_hat":
            from examples.research.agents.window import show_window

            return show_window(self.task, observer)
        return show(self.task, shown_as(self.kind), observer if self.kind == "x_hat" else None)


def shown_as(kind: Kind | Literal["random"]) -> Shown:
    """Which information set of :mod:`training.agents.any_environment` a kind of agents has."""
    if kind == RANDOM:
        return "state"
    return "x_hat" if kind == "stacked_x_hat" else kind


def _scaled(env: "VecEnv", model: Any) -> "VecEnv":
    """The environments with the scaling of observations that the agent ended with."""
    from stable_baselines3.common.vec_env import VecNormalize

    trained = model.get_vec_normalize_env()
    if trained is None:
        return env
    scaled = VecNormalize(env, training=False, norm_reward=False)
    scaled.obs_rms = trained.obs_rms
    return scaled


class RandomActions:
    """Random actions as a policy of stable-baselines3."""

    def __init__(self, env: "VecEnv") -> None:
        self._env = env
        env.action_space.seed(AGENT_EVALUATION_SEED)

    def predict(self, observation: np.ndarray, state: Any = None, **_: Any) -> tuple[np.ndarray, Any]:
        """Draw an action for each row."""
        return np.array([self._env.action_space.sample() for _ in observation]), state


def planned(
    tasks: Sequence[HiddenTask],
    out: Path,
    *,
    kinds: Sequence[Kind] = KINDS,
    seeds: int = 5,
    episodes: int = 100,
    timesteps: int | None = None,
    aggregate: int = 0,
) -> list[EnvironmentAgent]:
    """All agents of a comparison, the first seed of each first; levels of noise share the agents on the state."""
    agents: dict[Path, EnvironmentAgent] = {}
    for seed in range(seeds):
        for task in tasks:
            for kind in (*((RANDOM,) if seed == 0 else ()), *kinds):
                own = task.without_noise if kind in ("state", RANDOM) else task
                folder = out / "jobs" / own.name / kind / str(seed)
                agents.setdefault(folder, EnvironmentAgent(own, kind, seed, episodes, timesteps, aggregate, folder))
    return list(agents.values())


def collect(agents: Sequence[EnvironmentAgent]) -> "pd.DataFrame":
    """Results of agents that are done, a row each."""
    import pandas as pd

    rows = []
    for agent in agents:
        with explained(agent.folder / agent.result, ValueError):
            result = json.loads((agent.folder / agent.result).read_text())
            task, mean = agent.task, round(float(np.mean(result["returns"])), 4)
            rows.append((task.env_id, task.measurement_noise, agent.kind, agent.seed, mean, result["seconds"]))
    return pd.DataFrame(rows, columns=COLUMNS["results.csv"])


def read_earlier(folder: Path | None, name: str) -> "pd.DataFrame":
    """Rows of an earlier comparison, none without one; raises ValueError or OSError if they cannot be used."""
    import pandas as pd

    columns = COLUMNS[name]
    if folder is None:
        return pd.DataFrame(columns=columns)
    with explained(folder / name, ValueError):
        rows = pd.read_csv(folder / name, index_col=False)
        if list(rows.columns) != columns:
            raise ValueError(f"its columns are {', '.join(rows.columns)}, not {', '.join(columns)}")
        rows = rows.astype({name: float for name in columns if name not in ("environment", "shown", "seed", "steps")})
        if rows.isna().any(axis=None):
            raise ValueError(f"row {rows.index[rows.isna().any(axis=1)][0] + 2} lacks a value")
        if unknown := set(rows.shown) - {*KINDS, RANDOM}:
            raise ValueError(f"unknown agents {', '.join(sorted(unknown))}; there are {', '.join(KINDS)}")
    return rows


def beside(earlier: "pd.DataFrame", rows: "pd.DataFrame", here: "pd.DataFrame") -> "pd.DataFrame":
    """Put rows below earlier ones, without those of the environments, levels of noise and kinds in ``here``."""
    import pandas as pd

    task = ["environment", "noise", "shown"]
    others = earlier[~pd.MultiIndex.from_frame(earlier[task]).isin(pd.MultiIndex.from_frame(here[task]))]
    if others.empty:
        return rows
    joined = pd.concat([others, rows])
    return joined.iloc[np.argsort(pd.factorize(joined.environment)[0], kind="stable")]


def unusual_settings(tasks: Sequence[HiddenTask]) -> str:
    """Settings of agents on z and on stacks that are not the defaults, as a sentence; empty if there are none."""
    changed = []
    for field in fields(HiddenTask):
        values = {getattr(task, field.name) for task in tasks} if field.name in KINDS_WITH else set()
        changed += [f"`{field.name}` {value}" for value in values if value != field.default]
    return f"Agents on z and on stacked observations: {', '.join(changed)}." if changed else ""
