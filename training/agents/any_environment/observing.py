"""An observer for an agent, from the first steps that it makes in an environment."""

from pathlib import Path
from typing import Any

import numpy as np

from training.agents.any_environment.task import HiddenTask
from training.progress import ProgressBars
from training.recorded.config import NOISE_SHARE, recorded_config
from training.recorded.fit import train_recorded
from training.rollouts.playing import roll_out
from training.rollouts.policies import WANDERING, policy_of

HEADROOM = 1.5  # of the noise that a map is trained for over the noise that there is
# Per step, of the filters of observers under noise: their slowest modes average over some more steps.
SLOWEST_UNDER_NOISE = 0.05
SETTINGS: dict[str, Any] = {"inverse_steps": 2000, "members": 1}


def learn_observer(task: HiddenTask, folder: Path, *, steps: int, seed: int, progress: ProgressBars) -> Path:
    """Learn an observer from random actions, each held for a while.

    Parameters
    ----------
    task : HiddenTask
        Of which environment, and what is measured.
    folder : Path
        Receives observer.safetensors.
    steps : int
        Of the environment.
    seed : int
        Of the environment, the actions and the training.
    progress : ProgressBars
        Where bars are shown.

    Returns
    -------
    Path
        The observer's file.
    """
    clean = HiddenTask(task.env_id, task.measured, env_kwargs=task.env_kwargs)
    with clean.make() as env, progress.phase(f"playing {task.env_id}", steps) as report:
        size = env.observation_space.shape[0]  # type: ignore[index]
        rollouts = roll_out(
            env,
            policy_of(WANDERING, env),
            measured=[str(i) for i in task.measured],
            hidden=[str(i) for i in task.estimated(size)],
            steps=steps,
            seed=seed,
            report=report,
        )
    records = rollouts.records()
    changes: dict[str, Any] = {"seed": seed, **SETTINGS}
    if task.measurement_noise:
        spread = np.std(np.concatenate([record.y for record in records]), 0)
        changes["measurement_noise_max"] = tuple(np.maximum(NOISE_SHARE * spread, HEADROOM * task.measurement_noise))
    config = recorded_config(records, changes)
    artifact = train_recorded(records, config, folder / "observer", name=task.env_id, console=progress).artifact
    path = folder / "observer.safetensors"
    artifact.save(path)
    return path


__all__ = ["learn_observer"]
