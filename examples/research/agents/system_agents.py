"""Agents on systems: which there are, and the training and scores of each."""

import json
import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, get_args

import numpy as np

import kkl_gym
from examples.research.resumable import Job
from kkl_gym import get_system
from observers.storage import explained
from training.agents.agent import fingerprint, rules
from training.agents.information import OBSERVED, make, observer_of
from training.agents.play import Policy, play
from training.agents.seeds import AGENT_EVALUATION_SEED
from training.agents.tasks import TASKS, get_task, scores, successes
from training.evaluation.levels import Level, as_cell, as_name
from training.files import write

if TYPE_CHECKING:
    import pandas as pd

# An information set of training.agents.information, or y or the state with a recurrent policy.
Kind = Literal["state", "ekf", "x_hat", "x_hat_std", "z", "stacked", "y", "recurrent", "recurrent-state"]
KINDS: tuple[Kind, ...] = get_args(Kind)
ON_REQUEST = ("x_hat_std",)  # not every observer has error bars
USUAL_KINDS: tuple[Kind, ...] = tuple(kind for kind in KINDS if kind not in ON_REQUEST)

SECOND_NOISE = {"van_der_pol": 0.2, "lorenz": 2.0}  # further levels at which agents are trained
SEEDS = 5
RECURRENT_SEEDS = 3  # at most; their trainings take longest
SECOND_NOISE_RECURRENT_SEEDS = 1
LevelOrText = TypeVar("LevelOrText", bound=Hashable)


@dataclass(frozen=True)
class SystemAgent(Job):
    """One agent: trained, then played on the evaluation's episodes.

    Shapes: ``measurement_noise`` of length ny.
    """

    system: str
    measurement_noise: Level
    information: Kind
    seed: int
    episodes: int
    timesteps: int | None
    folder: Path
    observer: str | None = None

    result: ClassVar[str] = "scores.json"
    other: ClassVar[str] = "an agent of another comparison"

    @property
    def name(self) -> str:
        """System, noise, information and seed."""
        system, noise = get_system(self.system).name, as_name(self.measurement_noise)
        return f"{system} at noise {noise}/{self.information}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """Task, hyperparameters, the observer's content and the package's version."""
        from training.agents.learn import hyperparameters

        task = get_task(self.system, self.measurement_noise)
        recurrent = self.information.startswith("recurrent")
        observer = self.observer or observer_of(get_system(task.system)) if self._observes else None
        return {
            "episodes": self.episodes,
            "timesteps": self.timesteps,
            "task": asdict(task),
            "rules": rules(task),
            "hyperparameters": hyperparameters(task, "ppo_lstm" if recurrent else None),
            "observer": None if observer is None else [observer, fingerprint(observer)],
            "version": kkl_gym.__version__,
        }

    @property
    def _observes(self) -> bool:
        return self.information in OBSERVED

    def work(self) -> None:
        """Train the agent, play it and write its scores."""
        from examples.research.agents.recurrent import learn_recurrent
        from training.agents.learn import learn

        task = get_task(self.system, self.measurement_noise)
        began = time.process_time()
        policy: Policy
        if self.information in ("recurrent", "recurrent-state"):
            shown: Literal["y", "state"] = "y" if self.information == "recurrent" else "state"
            policy = learn_recurrent(task, shown, self.folder, seed=self.seed, timesteps=self.timesteps)
            env = make(task, shown, self.episodes, autoreset_mode="Disabled", with_action=True)
        else:
            information: Any = self.information
            observer = self.observer if self._observes else None
            policy = agent = learn(
                task, information, self.folder, seed=self.seed, timesteps=self.timesteps, observer=observer
            )
            env = agent.make(self.episodes, system=task.system)
        seconds = time.process_time() - began
        x = play(env, policy, steps=task.steps, seed=AGENT_EVALUATION_SEED).x
        result = {
            "scores": scores(get_system(task.system), x).round(6).tolist(),
            "successes": successes(task, x).tolist(),
            "seconds": round(seconds, 1),
        }
        write(self.folder / self.result, json.dumps(result) + "\n")


def idle_score(system: str, measurement_noise: Level, episodes: int) -> float:
    """Mean score of zero input on the evaluation's episodes.

    Shapes: ``measurement_noise`` of length ny.
    """
    task = get_task(system, measurement_noise)
    env = make(task, "state", episodes, autoreset_mode="Disabled")
    (nu,) = env.single_action_space.shape  # type: ignore[misc]
    x = play(env, lambda obs: np.zeros((len(obs), nu)), steps=task.steps, seed=AGENT_EVALUATION_SEED).x
    return float(scores(get_system(task.system), x).mean())


def combinations(
    levels: Mapping[str, Sequence[LevelOrText]], information: Sequence[Kind] = USUAL_KINDS, seeds: int = SEEDS
) -> Iterator[tuple[str, LevelOrText, Kind, int]]:
    """Yield system, noise, information and seed of each agent, the first seed of all first."""
    for seed in range(seeds):
        for system, own in levels.items():
            for level in own:
                most = RECURRENT_SEEDS if level == own[0] else SECOND_NOISE_RECURRENT_SEEDS
                for kind in information:
                    if seed < most or not kind.startswith("recurrent"):
                        yield system, level, kind, seed


def noise_levels(systems: Sequence[str] = tuple(TASKS), second: bool = True) -> dict[str, tuple[Level, ...]]:
    """Levels of measurement noise by system."""
    further = {name: (SECOND_NOISE[name],) if second and name in SECOND_NOISE else () for name in systems}
    return {name: (get_task(name).measurement_noise, *further[name]) for name in systems}


def planned(
    out: Path,
    *,
    systems: Sequence[str] = tuple(TASKS),
    information: Sequence[Kind] = USUAL_KINDS,
    seeds: int = SEEDS,
    episodes: int = 100,
    timesteps: int | None = None,
    more_noise: bool = True,
    observers: Mapping[str, str] | None = None,
) -> list[SystemAgent]:
    """All agents of a comparison; the defaults are the full set."""
    names = {system: get_system(system).name for system in systems}
    return [
        SystemAgent(
            system=system,
            measurement_noise=level,
            information=kind,
            seed=seed,
            episodes=episodes,
            timesteps=timesteps,
            folder=out / "jobs" / f"{names[system]}-{as_name(level)}" / kind / str(seed),
            observer=(observers or {}).get(names[system]),
        )
        for system, level, kind, seed in combinations(noise_levels(systems, more_noise), information, seeds)
    ]


def collect(agents: Sequence[SystemAgent]) -> "pd.DataFrame":
    """Results of the agents that are done, a row each."""
    import pandas as pd

    idle: dict[tuple[str, Level], float] = {}
    rows = []
    for agent in agents:
        if not agent.done:
            continue
        task = (agent.system, agent.measurement_noise)
        if task not in idle:
            idle[task] = idle_score(*task, agent.episodes)
        with explained(agent.folder / agent.result, ValueError):
            result = json.loads((agent.folder / agent.result).read_text())
            rows.append(
                {
                    "system": get_system(agent.system).name,
                    "noise": as_cell(agent.measurement_noise),
                    "knows": agent.information,
                    "seed": agent.seed,
                    "score": np.mean(result["scores"]),
                    "success": np.mean(result["successes"]),
                    "idle": idle[task],
                    "seconds": result["seconds"],
                }
            )
    return pd.DataFrame(rows)
