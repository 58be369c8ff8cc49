"""What information is worth: agents on every information set, several seeds each, on the same unseen episodes."""

import json
import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import numpy as np

import kkl_gym
from kkl_gym import get_system
from observers.storage import explained, write
from training.agents.agent import fingerprint, rules, versioned
from training.agents.information import OBSERVED, make, observer_of
from training.agents.play import Policy, play
from training.agents.tasks import TASKS, get_task, scores, successes
from training.evaluation.levels import Level, as_cell, as_name
from training.jobs import check_identity, claimed_job
from training.seeds import AGENT_EVALUATION_SEED
from training.systems import PROFILES

if TYPE_CHECKING:
    import pandas as pd

# What agents know: an information set of training.agents.information, or y or the state with a policy that remembers.
Compared = Literal["state", "ekf", "x_hat", "x_hat_std", "z", "stacked", "y", "recurrent", "recurrent-state"]
ALL: tuple[Compared, ...] = get_args(Compared)
ASKED_FOR = ("x_hat_std",)  # compared where somebody asks for it: not every observer has error bars
COMPARED: tuple[Compared, ...] = tuple(knows for knows in ALL if knows not in ASKED_FOR)

MORE_NOISE = {name: found.second_noise for name, found in PROFILES.items() if found.second_noise}
SEEDS = 5
RECURRENT_SEEDS = 3
MORE_NOISE_RECURRENT_SEEDS = 1
Key = TypeVar("Key", bound=Hashable)  # a level, or how a table shows it

MANY = 1000  # seeds, more than anyone trains
OTHER = "an agent of another comparison"
PROTOCOL = 1  # changes where results must not be mixed with earlier ones


@dataclass(frozen=True)
class Case:
    """One agent: trained, then played on the evaluation's episodes.

    Shapes: ``measurement_noise`` of length ny.
    """

    system: str
    measurement_noise: Level
    information: Compared
    seed: int
    episodes: int
    timesteps: int | None
    folder: Path
    observer: str | None = None

    @property
    def name(self) -> str:
        """For people."""
        system, noise = get_system(self.system).name, as_name(self.measurement_noise)
        return f"{system} at noise {noise}/{self.information}/{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """What must not differ between a result that is there and one that is asked for."""
        from training.agents.learn import hyperparameters

        task = get_task(self.system, self.measurement_noise)
        recurrent = self.information.startswith("recurrent")
        named = versioned(self.observer or observer_of(get_system(task.system))) if self._observes else None
        return {
            "protocol": PROTOCOL,
            "episodes": self.episodes,
            "timesteps": self.timesteps,
            "task": asdict(task),
            "rules": rules(task),
            "hyperparameters": hyperparameters(task, "ppo_lstm" if recurrent else None),
            "observer": None if named is None else [named, fingerprint(named)],
            "version": kkl_gym.__version__,
        }

    @property
    def _observes(self) -> bool:
        return self.information in OBSERVED

    @property
    def done(self) -> bool:
        """Whether its result is there; raises ValueError if the folder holds an agent of another comparison."""
        if not (self.folder / "scores.json").exists():
            return False
        check_identity(self.folder / "job.json", self.identity, OTHER)
        return True


def run_case(case: Case) -> None:
    """Train and evaluate an agent, unless that is done."""
    with claimed_job(case.folder, case.identity, OTHER):
        if not case.done:
            _run(case)


def _run(case: Case) -> None:
    import torch

    from training.agents.learn import learn, learn_recurrent

    torch.set_num_threads(1)
    task = get_task(case.system, case.measurement_noise)
    began = time.process_time()
    policy: Policy
    if case.information in ("recurrent", "recurrent-state"):
        of: Literal["y", "state"] = "y" if case.information == "recurrent" else "state"
        policy = learn_recurrent(task, of, case.folder, seed=case.seed, timesteps=case.timesteps)()
        env = make(task, of, case.episodes, autoreset_mode="Disabled", with_action=True)
    else:
        information: Any = case.information
        observer = case.observer if case._observes else None
        policy = agent = learn(
            task, information, case.folder, seed=case.seed, timesteps=case.timesteps, observer=observer
        )
        env = agent.make(case.episodes, system=task.system)
    seconds = time.process_time() - began
    x = play(env, policy, steps=task.steps, seed=AGENT_EVALUATION_SEED).x
    result = {
        "scores": scores(get_system(task.system), x).round(6).tolist(),
        "successes": successes(task, x).tolist(),
        "seconds": round(seconds, 1),
    }
    write(case.folder / "scores.json", json.dumps(result) + "\n")


def idle(system: str, measurement_noise: Level, episodes: int) -> np.ndarray:
    """Scores of zero input on the evaluation's episodes.

    Shapes: ``measurement_noise`` of length ny; returns (episodes,).
    """
    task = get_task(system, measurement_noise)
    env = make(task, "state", episodes, autoreset_mode="Disabled")
    (nu,) = env.single_action_space.shape  # type: ignore[misc]
    x = play(env, lambda obs: np.zeros((len(obs), nu)), steps=task.steps, seed=AGENT_EVALUATION_SEED).x
    return scores(get_system(task.system), x)


def kinds(
    levels: Mapping[str, Sequence[Key]], information: Sequence[Compared] = COMPARED, seeds: int = SEEDS
) -> Iterator[tuple[str, Key, Compared, int]]:
    """Agents of a comparison, the first seed of each first."""
    for seed in range(seeds):
        for system, at in levels.items():
            for level in at:
                for what in information:
                    most = RECURRENT_SEEDS if level == at[0] else MORE_NOISE_RECURRENT_SEEDS
                    if seed < most or not what.startswith("recurrent"):
                        yield system, level, what, seed


def noise_levels(systems: Sequence[str] = tuple(TASKS), more_noise: bool = True) -> dict[str, tuple[Level, ...]]:
    """Levels of measurement noise at which agents are compared on each system."""
    more = MORE_NOISE if more_noise else {}
    further = {system: (more[system],) if system in more else () for system in systems}
    return {system: (get_task(system).measurement_noise, *further[system]) for system in systems}


def planned(
    out: Path,
    *,
    systems: Sequence[str] = tuple(TASKS),
    information: Sequence[Compared] = COMPARED,
    seeds: int = SEEDS,
    episodes: int = 100,
    timesteps: int | None = None,
    more_noise: bool = True,
    observers: Mapping[str, str] | None = None,
) -> list[Case]:
    """All agents of a comparison; the defaults are the full set."""
    names = {system: get_system(system).name for system in systems}
    return [
        Case(
            system=system,
            measurement_noise=level,
            information=what,
            seed=seed,
            episodes=episodes,
            timesteps=timesteps,
            folder=out / "jobs" / f"{names[system]}-{as_name(level)}" / what / str(seed),
            observer=(observers or {}).get(names[system]),
        )
        for system, level, what, seed in kinds(noise_levels(systems, more_noise), information, seeds)
    ]


def collect(
    out: Path,
    *,
    episodes: int,
    timesteps: int | None,
    own: Sequence[str] = (),
    observers: Mapping[str, str] | None = None,
) -> "pd.DataFrame":
    """What there is in a comparison's folder of shipped systems and some others, whichever run it is from."""
    import pandas as pd

    systems = (*TASKS, *own)
    plan = planned(
        out,
        systems=systems,
        information=ALL,
        seeds=MANY,
        episodes=episodes,
        timesteps=timesteps,
        observers=observers,
    )
    idle_scores: dict[tuple[str, Level], float] = {}
    rows = []
    for case in plan:
        if not case.done:
            continue
        key = (case.system, case.measurement_noise)
        if key not in idle_scores:
            idle_scores[key] = float(idle(*key, case.episodes).mean())
        with explained(case.folder / "scores.json", ValueError):
            result = json.loads((case.folder / "scores.json").read_text())
            rows.append(
                {
                    "system": get_system(case.system).name,
                    "noise": as_cell(key[1]),
                    "knows": case.information,
                    "seed": case.seed,
                    "score": np.mean(result["scores"]),
                    "success": np.mean(result["successes"]),
                    "idle": idle_scores[key],
                    "seconds": result["seconds"],
                }
            )
    return pd.DataFrame(rows)
