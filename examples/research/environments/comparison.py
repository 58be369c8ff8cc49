"""What a memory or an observer is worth: agents that are shown different things, several seeds each."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import gymnasium as gym
import numpy as np

import kkl_gym
from examples.research.environments.window import show_window
from kkl_gym.memory import IMAGINED
from observers.storage import explained, write
from training.agents.any_environment.information import Shown, show
from training.agents.any_environment.task import HiddenTask
from training.jobs import check_identity, claimed_job
from training.seeds import AGENT_EVALUATION_SEED

if TYPE_CHECKING:
    import pandas as pd
    from stable_baselines3.common.vec_env import VecEnv

Kind = Literal["state", "x_hat", "stacked_x_hat", "z", "stacked", "recurrent", "y"]
KINDS: tuple[Kind, ...] = get_args(Kind)
ESTIMATES: tuple[Kind, ...] = ("x_hat", "stacked_x_hat")  # what is learned from hidden signals
RANDOM: Literal["random"] = "random"  # actions: what has the score 0
ROWS = 10  # episodes that are played at a time
PROTOCOL = 1  # changes where results must not be mixed with earlier ones
OTHER = "an agent of another comparison"
RESULT = "result.json"
MANY = 100  # seeds, more than anyone trains


@dataclass(frozen=True)
class Case:
    """One agent: trained, then played on the evaluation's episodes."""

    task: HiddenTask
    kind: Kind | Literal["random"]
    seed: int
    episodes: int
    timesteps: int | None
    aggregate: int
    folder: Path

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.task.name}/{self.kind}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """What must not differ between a result that is there and one that is asked for."""
        task = asdict(self.task)
        for option, kinds in (("time_constants", ("z",)), ("frames", ("stacked", "stacked_x_hat"))):
            if self.kind not in kinds:
                del task[option]  # which is nothing to the others
        for option, usual in (("past_actions", True), ("angles", ())):
            if self.kind not in ("z", "stacked") or task[option] == usual:
                del task[option]  # as comparisons did before there were these
        described: dict[str, Any] = {
            "protocol": PROTOCOL,
            "episodes": self.episodes,
            "task": task,
            "version": kkl_gym.__version__,
        }
        if self.kind == RANDOM:
            return described
        from training.agents.any_environment.learning import (
            REHEARSAL,
            TOLD,
            WANDERED,
            algorithm_for,
            hyperparameters,
        )

        with self.task.make() as env:
            algorithm = algorithm_for(env.action_space, self.task.env_id, learned_with(self.kind))
        described |= {
            "timesteps": self.timesteps,
            "algorithm": algorithm,
            "hyperparameters": hyperparameters(algorithm, self.task.env_id),
            "aggregate": 0,
        }
        if self.kind in ESTIMATES:
            begins = {"wanders": WANDERED} if self.task.measurement_noise else {"told": TOLD}
            described |= {"aggregate": self.aggregate, **begins, "rehearsal": REHEARSAL}
        if self.kind == "z":
            described["past"] = IMAGINED
        return described

    @property
    def done(self) -> bool:
        """Whether its result is there; raises ValueError if the folder holds an agent of another comparison."""
        if not (self.folder / RESULT).exists():
            return False
        check_identity(self.folder / "job.json", self.identity, OTHER)
        return True


def run_case(case: Case) -> None:
    """Train and evaluate an agent, unless that is done."""
    with claimed_job(case.folder, case.identity, OTHER):
        if not case.done:
            write(case.folder / RESULT, json.dumps(_run(case)) + "\n")


def _run(case: Case) -> dict[str, Any]:
    import torch
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    from examples.research.environments.window_fit import STACKED
    from training.agents.any_environment.learning import learn_to_play
    from training.agents.any_environment.observing import KKL, OBSERVER

    torch.set_num_threads(1)
    kind, observer = case.kind, str(case.folder / OBSERVER)
    began = time.process_time()
    model: Any = None
    if kind != RANDOM:
        model = learn_to_play(
            case.task,
            learned_with(kind),
            case.folder,
            timesteps=case.timesteps,
            seed=case.seed,
            aggregate=case.aggregate if kind in ESTIMATES else 0,
            estimation=STACKED if kind == "stacked_x_hat" else KKL,
        )
    seconds = time.process_time() - began
    rows = min(ROWS, case.episodes)
    env: Any = make_vec_env(lambda: _shown(case.task, kind, observer), rows, seed=AGENT_EVALUATION_SEED)
    try:
        policy: Any = _RandomActions(env) if model is None else model
        returns: Any = evaluate_policy(
            policy,
            env if model is None else _scaled(env, model),
            n_eval_episodes=case.episodes,
            return_episode_rewards=True,
            warn=False,
        )[0]
    finally:
        env.close()
    return {"returns": [round(float(value), 4) for value in returns], "seconds": round(seconds, 1)}


def learned_with(kind: Kind | Literal["random"]) -> Shown:
    """What the agents of a kind are shown, whoever makes the estimates."""
    if kind == RANDOM:
        return "state"
    return "x_hat" if kind == "stacked_x_hat" else kind


def _shown(task: HiddenTask, kind: Kind | Literal["random"], observer: str) -> gym.Env[np.ndarray, Any]:
    if kind == "stacked_x_hat":
        return show_window(task, observer)
    return show(task, learned_with(kind), observer if kind == "x_hat" else None)


def _scaled(env: "VecEnv", model: Any) -> "VecEnv":
    """The environments as the agent saw them, its scaling as it ended."""
    from stable_baselines3.common.vec_env import VecNormalize

    trained = model.get_vec_normalize_env()
    if trained is None:
        return env
    scaled = VecNormalize(env, training=False, norm_reward=False)
    scaled.obs_rms = trained.obs_rms
    return scaled


class _RandomActions:
    """Acts at random, as :func:`stable_baselines3.common.evaluation.evaluate_policy` asks."""

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
) -> list[Case]:
    """All agents of a comparison, the first seed of each first."""
    found: dict[Path, Case] = {}
    for seed in range(seeds):
        for task in tasks:
            for kind in (*((RANDOM,) if seed == 0 else ()), *kinds):
                of = task.without_noise if kind in ("state", RANDOM) else task
                folder = out / "jobs" / of.name / kind / str(seed)
                found.setdefault(folder, Case(of, kind, seed, episodes, timesteps, aggregate, folder))
    return list(found.values())


def collect(cases: Sequence[Case]) -> "pd.DataFrame":
    """Results of the agents that are done."""
    import pandas as pd

    rows = []
    for case in cases:
        with explained(case.folder / RESULT, ValueError):
            result = json.loads((case.folder / RESULT).read_text())
            rows.append(
                {
                    "environment": case.task.env_id,
                    "noise": case.task.measurement_noise,
                    "shown": case.kind,
                    "seed": case.seed,
                    "return": round(float(np.mean(result["returns"])), 4),
                    "seconds": result["seconds"],
                }
            )
    return pd.DataFrame(rows)


__all__ = ["KINDS", "RANDOM", "Case", "Kind", "collect", "planned", "run_case"]
