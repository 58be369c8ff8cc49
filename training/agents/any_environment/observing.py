"""An observer for an agent: from the first steps that it makes in an environment, and from later ones."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from training.agents.any_environment.information import part_of, show
from training.agents.any_environment.task import CLEAN_Y, HiddenTask
from training.maps.coordinates import SETTLED
from training.progress import ProgressBars
from training.records import Record
from training.rollouts.callback import KKLTrainingCallback
from training.rollouts.playing import WANDERING, Recorder, policy_of, roll_out
from training.sources.recorded import RECORDED_NOISE, RecordedSource, recorded_preset, split
from training.spectrum import evenly_spaced
from training.train_observer import train

OBSERVER = "observer.safetensors"
HEADROOM = 1.5  # of the noise that a map is trained for over the noise that there is
# Per step, of filters under noise: more and slower modes, which average over more steps.
MODES_UNDER_NOISE, SLOWEST_UNDER_NOISE, FASTEST_UNDER_NOISE = 8, 0.05, 1.0
HELD_OUT = 0.2  # of the episodes
KEPT = 100_000  # steps that an observer is learned from, the latest
SETTINGS: dict[str, Any] = {"inverse_steps": 2000, "members": 1}


class Told:
    """Environments in which an agent is told what an observer is to estimate, and which keep what happened last."""

    def __init__(self, task: HiddenTask, rows: int) -> None:
        self._task, self._each, self._recorders = task, max(1, KEPT // rows), list[Recorder]()

    def make(self) -> gym.Env[np.ndarray, Any]:
        """Make one environment."""
        env = self._task.make()
        recorder = Recorder(env, **self._task.signals(_size(env)), keep=self._each)
        self._recorders.append(recorder)
        return part_of(recorder, self._task.told(_size(env)))

    def records(self) -> list[Record]:
        """Read what they keep."""
        return [record for records in self._rows() for record in records]

    def oldest_first(self) -> list[Record]:
        """Read what they keep, those that ended first at the beginning."""
        return oldest_first(self._rows())

    def _rows(self) -> list[list[Record]]:
        return [recorder.rollouts().records() for recorder in self._recorders]


def oldest_first(rows: Sequence[Sequence[Record]]) -> list[Record]:
    """Put together what environments have kept that were stepped together."""
    dated = list[tuple[int, Record]]()
    for records in rows:
        after = 0  # steps that were made since
        for record in reversed(records):
            dated.append((after, record))
            after += len(record.t) - 1
    return [record for _, record in sorted(dated, key=lambda one: -one[0])]


def wander(task: HiddenTask, steps: int, *, seed: int, progress: ProgressBars) -> list[Record]:
    """Act at random, each action held for a while."""
    with task.make(noisy=False) as env, progress.phase(f"playing {task.env_id}", steps) as report:
        policy = policy_of(WANDERING, env)
        rollouts = roll_out(env, policy, **task.signals(_size(env)), steps=steps, seed=seed, report=report)
    return rollouts.records()


def _size(env: gym.Env[np.ndarray, Any]) -> int:
    space: Any = env.observation_space
    return int(space.shape[0])


def learn_observer(
    task: HiddenTask, records: Sequence[Record], folder: Path, *, seed: int, progress: ProgressBars
) -> Path:
    """Learn an observer from an agent's first steps."""
    changes: dict[str, Any] = {"seed": seed, "held_out": HELD_OUT, "tracking": False, **SETTINGS}
    if task.measurement_noise:
        spread = np.std(np.concatenate([record.y for record in records]), 0)
        changes["measurement_noise_max"] = tuple(np.maximum(RECORDED_NOISE * spread, HEADROOM * task.measurement_noise))
        dt = float(np.diff(records[0].t[:2])[0])
        # The filter has to settle in one episode at least of those that are trained on; a beginner's may be short.
        longest = max(record.duration for record in split(records, HELD_OUT, seed)[0])
        fastest = FASTEST_UNDER_NOISE / dt
        slowest = min(max(SLOWEST_UNDER_NOISE / dt, 1.1 * SETTLED / longest), fastest / 2)
        changes["eigenvalues"] = tuple(evenly_spaced(MODES_UNDER_NOISE, -slowest, -fastest))
    source = RecordedSource(records, recorded_preset(records, changes), task.env_id)
    artifact = train(source, console=progress).artifact
    path = folder / OBSERVER
    artifact.save(path)
    return path


def refits(
    task: HiddenTask,
    learn: Callable[[Sequence[Record]], Path],
    every: int,
    rehearsal: int,
    path: Path,
    records: Sequence[Record],
) -> BaseCallback:
    """Make what fits an observer again to an agent's own steps, beside those of ``records``."""
    outputs = CLEAN_Y if task.measurement_noise else "y"
    return KKLTrainingCallback(
        every, keep=KEPT, records=records, rehearsal=rehearsal, outputs=outputs, path=path, **SETTINGS
    )


def show_estimates(task: HiddenTask, path: str, keep: int | None) -> gym.Env[np.ndarray, Any]:
    """Make the environment that shows an observer's estimates; :class:`KKLTrainingCallback` keeps the steps."""
    return show(task, "x_hat", path)


@dataclass(frozen=True)
class Estimation:
    """How estimates of hidden signals are learned from an agent's steps, shown to it, and learned again."""

    learn: Callable[..., Path]
    show: Callable[[HiddenTask, str, int | None], gym.Env[np.ndarray, Any]]
    refits: Callable[..., BaseCallback]


KKL = Estimation(learn_observer, show_estimates, refits)

__all__ = ["KEPT", "KKL", "OBSERVER", "SETTINGS", "Estimation", "Told", "learn_observer", "oldest_first", "wander"]
