"""An observer for an agent: from the first steps that it makes in an environment, and from later ones."""

from pathlib import Path
from typing import Any

import numpy as np

from training.agents.any_environment.task import CLEAN_Y, HiddenTask
from training.progress import ProgressBars
from training.recorded.config import NOISE_SHARE, recorded_config
from training.recorded.fit import train_recorded
from training.rollouts.callback import KKLTrainingCallback
from training.rollouts.playing import roll_out
from training.rollouts.policies import WANDERING, policy_of
from training.spectrum import evenly_spaced

OBSERVER = "observer.safetensors"
HEADROOM = 1.5  # of the noise that a map is trained for over the noise that there is
# Per step, of filters under noise: more and slower modes, which average over more steps.
MODES_UNDER_NOISE, SLOWEST_UNDER_NOISE, FASTEST_UNDER_NOISE = 8, 0.05, 1.0
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
    with task.make(noisy=False) as env, progress.phase(f"playing {task.env_id}", steps) as report:
        space: Any = env.observation_space
        rollouts = roll_out(
            env,
            policy_of(WANDERING, env),
            measured=[str(i) for i in task.measured],
            hidden=task.estimated(space.shape[0]),
            steps=steps,
            seed=seed,
            report=report,
        )
    records = rollouts.records()
    changes: dict[str, Any] = {"seed": seed, **SETTINGS}
    if task.measurement_noise:
        spread = np.std(np.concatenate([record.y for record in records]), 0)
        changes["measurement_noise_max"] = tuple(np.maximum(NOISE_SHARE * spread, HEADROOM * task.measurement_noise))
        slowest, fastest = (-rate / rollouts.dt for rate in (SLOWEST_UNDER_NOISE, FASTEST_UNDER_NOISE))
        changes["eigenvalues"] = tuple(evenly_spaced(MODES_UNDER_NOISE, slowest, fastest))
    config = recorded_config(records, changes)
    artifact = train_recorded(records, config, folder / "observer", name=task.env_id, console=progress).artifact
    path = folder / OBSERVER
    artifact.save(path)
    return path


def refitting(task: HiddenTask, times: int, steps: int, path: Path) -> KKLTrainingCallback:
    """Make what fits an observer again to an agent's own steps, at equal distances.

    Parameters
    ----------
    task : HiddenTask
        Where the agent acts.
    times : int
        How often.
    steps : int
        Of the agent's training.
    path : Path
        Receives the observer in use at each time.

    Returns
    -------
    KKLTrainingCallback
        For the training.
    """
    outputs = CLEAN_Y if task.measurement_noise else "y"
    return KKLTrainingCallback(max(1, steps // (times + 1)), outputs=outputs, path=path, **SETTINGS)


__all__ = ["OBSERVER", "learn_observer", "refitting"]
