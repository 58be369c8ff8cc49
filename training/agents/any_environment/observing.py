"""An observer for an agent: from the first steps that it makes in an environment, and from later ones."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from training.agents.any_environment.information import part_of
from training.agents.any_environment.task import CLEAN_Y, HiddenTask
from training.maps.coordinates import SETTLED
from training.progress import ProgressBars
from training.recorded.config import NOISE_SHARE, recorded_config
from training.recorded.fit import train_recorded
from training.records import Record
from training.rollouts.callback import KKLTrainingCallback
from training.rollouts.playing import Recorder
from training.rollouts.policies import WANDERING, policy_of
from training.spectrum import evenly_spaced

OBSERVER = "observer.safetensors"
HEADROOM = 1.5  # of the noise that a map is trained for over the noise that there is
# Per step, of filters under noise: more and slower modes, which average over more steps.
MODES_UNDER_NOISE, SLOWEST_UNDER_NOISE, FASTEST_UNDER_NOISE = 8, 0.05, 1.0
SETTINGS: dict[str, Any] = {"inverse_steps": 2000, "members": 1}


class Told:
    """Environments in which an agent is told what an observer is to estimate, and which keep what happens.

    Parameters
    ----------
    task : HiddenTask
        Of which environment, and what is measured.
    """

    def __init__(self, task: HiddenTask) -> None:
        self._task, self._recorders = task, list[Recorder]()

    def make(self) -> gym.Env[np.ndarray, Any]:
        """Make one environment.

        Returns
        -------
        gymnasium.Env
            Its observations are those of an agent on estimates, had these no error.
        """
        task = self._task
        env = task.make(noisy=False)
        space: Any = env.observation_space
        size = space.shape[0]
        env = Recorder(env, measured=[str(i) for i in task.measured], hidden=task.estimated(size))
        self._recorders.append(env)
        return part_of(env, task.told(size), bounded=not task.measurement_noise)

    def wander(self, steps: int, *, seed: int, progress: ProgressBars) -> None:
        """Act at random in one of them, each action held for a while.

        Parameters
        ----------
        steps : int
            Of the environment.
        seed : int
            Of the environment and the actions.
        progress : ProgressBars
            Where a bar is shown.
        """
        with self.make() as env, progress.phase(f"playing {self._task.env_id}", steps) as report:
            env.action_space.seed(seed)
            policy, over = policy_of(WANDERING, env), True
            for step in range(steps):
                if over:
                    observation, _ = env.reset(seed=None if step else seed)
                observation, _, terminated, truncated, _ = env.step(policy(observation))
                over = terminated or truncated
                report(step + 1)

    def records(self) -> list[Record]:
        """Read what happened in all of them.

        Returns
        -------
        list of Record
            One of each episode.
        """
        return [record for recorder in self._recorders for record in recorder.rollouts().records()]


def learn_observer(
    task: HiddenTask, records: Sequence[Record], folder: Path, *, seed: int, progress: ProgressBars
) -> Path:
    """Learn an observer from an agent's first steps.

    Parameters
    ----------
    task : HiddenTask
        Of which environment, and what is measured.
    records : sequence of Record
        Of these steps, without noise.
    folder : Path
        Receives observer.safetensors.
    seed : int
        Of the training.
    progress : ProgressBars
        Where bars are shown.

    Returns
    -------
    Path
        The observer's file.
    """
    changes: dict[str, Any] = {"seed": seed, **SETTINGS}
    if task.measurement_noise:
        spread = np.std(np.concatenate([record.y for record in records]), 0)
        changes["measurement_noise_max"] = tuple(np.maximum(NOISE_SHARE * spread, HEADROOM * task.measurement_noise))
        dt = float(np.diff(records[0].t[:2])[0])
        # The filter has to settle in one episode at least; those of a beginner may be short.
        slowest = max(SLOWEST_UNDER_NOISE / dt, 1.001 * SETTLED / max(record.duration for record in records))
        changes["eigenvalues"] = tuple(evenly_spaced(MODES_UNDER_NOISE, -slowest, -FASTEST_UNDER_NOISE / dt))
    config = recorded_config(list(records), changes)
    with tempfile.TemporaryDirectory() as scratch:  # a training of agents begins anew, and so do its observers
        run = Path(scratch) / "observer"
        artifact = train_recorded(list(records), config, run, name=task.env_id, console=progress).artifact
    path = folder / OBSERVER
    artifact.save(path)
    return path


def refitting(task: HiddenTask, times: int, steps: int, rehearsal: int, path: Path) -> KKLTrainingCallback:
    """Make what fits an observer again to an agent's own steps, at equal distances.

    Parameters
    ----------
    task : HiddenTask
        Where the agent acts.
    times : int
        How often.
    steps : int
        Of the agent's training.
    rehearsal : int
        Steps after them in which the agent acts without exploration, for a last refit.
    path : Path
        Receives the observer in use at each time.

    Returns
    -------
    KKLTrainingCallback
        For the training.
    """
    outputs = CLEAN_Y if task.measurement_noise else "y"
    return KKLTrainingCallback(
        max(1, steps // (times + 1)), rehearsal=rehearsal, outputs=outputs, path=path, **SETTINGS
    )


__all__ = ["OBSERVER", "Told", "learn_observer", "refitting"]
