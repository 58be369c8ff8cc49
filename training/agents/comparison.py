"""What knowing is worth: agents on every information set, several seeds each, on the same unseen episodes."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
import torch
from filelock import FileLock, Timeout

import kkl_gym
from kkl_gym import get_system
from observers.storage import write
from training.agents.agent import fingerprint, rules, versioned
from training.agents.information import make, observer_of
from training.agents.play import Policy, play
from training.agents.tasks import TASKS, get_task, scores, successes
from training.seeds import AGENT_EVALUATION_SEED
from training.systems import PROFILES

Knows = Literal["state", "ekf", "x_hat", "z", "stacked", "y", "recurrent", "recurrent-state"]


KNOWS: tuple[Knows, ...] = get_args(Knows)


MORE_NOISE = {name: found.second_noise for name, found in PROFILES.items() if found.second_noise}
RECURRENT_SEEDS = 3
MORE_NOISE_RECURRENT_SEEDS = 1
MANY = 1000  # seeds, more than anyone trains
PROTOCOL = 1  # changes where results must not be mixed with earlier ones


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
        policy = learn_recurrent(task, of, case.folder, seed=case.seed, timesteps=case.timesteps)()
        env = make(task, of, case.episodes, "Disabled", with_action=True)
    else:
        information: Any = case.knows
        policy = agent = learn(task, information, case.folder, seed=case.seed, timesteps=case.timesteps)
        env = agent.make(case.episodes)
    seconds = time.process_time() - began
    x = play(env, policy, task.steps, AGENT_EVALUATION_SEED).x
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
    x = play(env, lambda obs: np.zeros((len(obs), nu)), task.steps, AGENT_EVALUATION_SEED).x
    return scores(get_system(task.system), x)


def planned(
    out: Path,
    *,
    systems: Sequence[str] = tuple(TASKS),
    knows: Sequence[Knows] = KNOWS,
    seeds: int = 5,
    episodes: int = 100,
    timesteps: int | None = None,
    more_noise: bool = True,
) -> list[Case]:
    """All agents of a comparison, the first seed of each first; the defaults are the full set."""
    noise: dict[str, tuple[float, ...]] = {system: (get_task(system).measurement_noise,) for system in systems}
    if more_noise:
        noise |= {name: (*noise[name], level) for name, level in MORE_NOISE.items() if name in noise}
    return [
        Case(
            system=system,
            measurement_noise=level,
            knows=what,
            seed=seed,
            episodes=episodes,
            timesteps=timesteps,
            folder=out / "jobs" / f"{system}-{level:g}" / what / str(seed),
        )
        for seed in range(seeds)
        for system in systems
        for level in noise[system]
        for what in knows
        if not what.startswith("recurrent")
        or seed < (RECURRENT_SEEDS if level == noise[system][0] else MORE_NOISE_RECURRENT_SEEDS)
    ]


def collect(out: Path, episodes: int, timesteps: int | None) -> pd.DataFrame:
    """One row for each agent in the folder, whoever trained it; raises ValueError if some are of another comparison."""
    plan = planned(out, seeds=MANY, episodes=episodes, timesteps=timesteps)
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
