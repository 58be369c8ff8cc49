"""Observers that are learned from an agent's first steps in an environment and refitted to its later steps."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym.wrappers.vector import VectorEnv
from training.agents.environments import CLEAN, CLEAN_Y, single, vector
from training.agents.information import FeatureObservation
from training.agents.tasks import Task
from training.lessons import train
from training.progress import ProgressBars
from training.records import Record
from training.rollouts.callback import KKLTrainingCallback
from training.rollouts.playing import WANDERING, Recorder, policy_of, roll_out
from training.sources.recorded import RECORDED_NOISE, RecordedSource, recorded_preset

OBSERVER = "observer.safetensors"
HEADROOM = 1.5  # T_inv's training covers noise levels up to at least this multiple of the task's
HELD_OUT = 0.2  # held-out share of the episodes
KEPT = 100_000  # number of latest steps from which an observer is learned
SETTINGS: dict[str, Any] = {"inverse_steps": 2000, "members": 1}


def hidden_entries(task: Task, size: int) -> tuple[int, ...]:
    """Return the indices of the hidden entries of an observation with ``size`` entries."""
    return tuple(i for i in range(size) if i not in task.measured) if task.hidden is None else task.hidden


def estimated_entries(task: Task, size: int) -> tuple[int, ...]:
    """Return the indices of the entries that an observer estimates: the hidden and, under noise, the measured ones."""
    hidden = hidden_entries(task, size)
    return tuple(sorted({*hidden, *task.measured})) if task.measurement_noise else hidden


def signals(task: Task, env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Return the signals to record in a task's environment, as arguments of :class:`Recorder`."""
    source = f"info[{CLEAN}]" if task.measurement_noise else "obs"
    hidden = [f"{source}[{i}]" for i in estimated_entries(task, gym.spaces.flatdim(env.observation_space))]
    return {"measured": [str(i) for i in task.measured], "hidden": hidden}


class Privileged:
    """Makes environments that show the true hidden signals in place of estimates, and records their latest steps.

    ``rows`` is the number of environments; ``earlier`` are records of an interrupted training, in order of time.
    """

    def __init__(self, task: Task, rows: int, earlier: Sequence[Record] = ()) -> None:
        self._task, self._rows, self._earlier = task, rows, list(earlier)
        self._recorders = list[Recorder]()

    def make(self) -> VectorEnv:
        """Make the environments, which show the measured and then the hidden entries."""
        env = vector(self._task, self._rows, each=self._each)
        entries = [*self._task.measured, *hidden_entries(self._task, gym.spaces.flatdim(env.single_observation_space))]
        return FeatureObservation(env, lambda at: at["obs"][:, entries], len(entries))

    def _each(self) -> gym.Env[Any, Any]:
        env = single(self._task)
        self._recorders.append(Recorder(env, **signals(self._task, env), keep=max(1, KEPT // self._rows)))
        return self._recorders[-1]

    def records(self) -> list[Record]:
        """Return the latest records, those of the interrupted training first, in the order of their ends."""
        rows = [recorder.rollouts(going_on=True).records() for recorder in self._recorders]
        return latest([*self._earlier, *oldest_first(rows)])


def latest(records: Sequence[Record]) -> list[Record]:
    """Return the fewest latest records that hold ``KEPT`` steps, or all records if they hold fewer."""
    kept, steps = list[Record](), 0
    for record in reversed(records):
        if steps >= KEPT:
            break
        kept.insert(0, record)
        steps += len(record.t) - 1
    return kept


def oldest_first(rows: Sequence[Sequence[Record]]) -> list[Record]:
    """Merge the records of environments that were stepped together, in the order of their ends."""
    dated = list[tuple[int, Record]]()
    for records in rows:
        after = 0  # number of steps from the end of a record to the last step
        for record in reversed(records):
            dated.append((after, record))
            after += len(record.t) - 1
    return [record for _, record in sorted(dated, key=lambda one: -one[0])]


def wander(task: Task, steps: int, *, seed: int, progress: ProgressBars) -> list[Record]:
    """Record episodes with random actions, each held for several steps."""
    with single(task, noisy=False) as env, progress.phase(f"playing {task.env_id}", steps) as report:
        policy = policy_of(WANDERING, env)
        rollouts = roll_out(env, policy, **signals(task, env), steps=steps, seed=seed, report=report)
    return rollouts.records()


def learn_observer(
    task: Task,
    records: Sequence[Record],
    folder: Path,
    *,
    seed: int,
    progress: ProgressBars,
    tracking: bool | None = None,
) -> Path:
    """Learn an observer from records, and return its file; by default the observer tracks only under noise."""
    changes: dict[str, Any] = {"seed": seed, "held_out": HELD_OUT, **SETTINGS}
    changes["tracking"] = bool(task.measurement_noise) if tracking is None else tracking
    if task.measurement_noise:
        spread = np.std(np.concatenate([record.y for record in records]), 0)
        changes["measurement_noise_max"] = tuple(
            np.maximum(RECORDED_NOISE * spread, HEADROOM * np.asarray(task.measurement_noise))
        )
    source = RecordedSource(records, recorded_preset(records, changes), task.env_id)
    artifact = train(source, console=progress).artifact
    path = folder / OBSERVER
    artifact.save(path)
    return path


def refits(task: Task, every: int, rehearsal: int, path: Path, records: Sequence[Record]) -> KKLTrainingCallback:
    """Return a callback that refits an observer to the agent's steps and to earlier ``records``."""
    outputs = CLEAN_Y if task.measurement_noise else "y"
    return KKLTrainingCallback(
        every, keep=KEPT, records=records, rehearsal=rehearsal, outputs=outputs, path=path, **SETTINGS
    )
