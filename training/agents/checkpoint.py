"""Checkpoints of an agent's training: unlike the files of stable-baselines3, they are read without running code."""

import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from observers.storage import replacing
from training import run
from training.records import Record

CURVE = "curve.csv"
_STORED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")  # arrays of replay buffers
_ARRAYS = ("t", "y", "u", "x")  # arrays of a record


class Checkpoint(BaseCallback):
    """Writes a checkpoint and the learning curve at the end of a training and, at intervals, between two rollouts.

    A checkpoint holds networks, optimisers, counters, the scaling of observations and rewards, the replay buffer, the
    learning curve, KKLMemory's weights and the recorded samples that train an observer. It holds neither environments
    nor random generators: a resumed training begins new episodes with other random numbers. The learning curve has a
    row for each episode: the training's steps and CPU seconds at the episode's end, and its return.
    """

    def __init__(self, path: Path, fingerprint: str, *, resume: bool) -> None:
        super().__init__()
        self.path, self._fingerprint, self._curve_path = path, fingerprint, path.with_name(CURVE)
        self.resumed = self.restarts = 0  # number of resumptions, and how often all environments were made again
        self.spent = 0  # number of random steps before the algorithm's first step
        self.privileged = False  # whether the agent sees true hidden signals instead of estimates
        self.records: Callable[[], Sequence[Record]] = list  # returns the records to save
        self._curve, self._began = list[tuple[float, ...]](), time.process_time()
        if not resume:
            path.unlink(missing_ok=True)
        self.saved = run.load_checkpoint(path, fingerprint=fingerprint) if path.exists() else None
        self.weights = (self.saved or {}).get("weights")  # of KKLMemory

    def restore(self, model: BaseAlgorithm, steps: int) -> None:
        """Restore the saved training, if there is one; ``steps`` is the number of steps at which learning ends."""
        if (saved := self.saved) is None:
            return
        with run.restoring(self.path):
            model.set_parameters(saved["parameters"], device="cpu")
            for name, value in saved["counters"].items():
                setattr(model, name, int(value))
            if isinstance(model, OffPolicyAlgorithm):
                _restore_buffer(model, saved)
            for name, moments in saved["moments"].items():
                running = getattr(model.get_vec_normalize_env(), name)
                running.mean, running.var = (moments[key].numpy() for key in ("mean", "var"))
                running.count = float(moments["count"])
            goes_on = model.num_timesteps < steps
            self.resumed, self.restarts = (int(saved[name]) + goes_on for name in ("resumed", "restarts"))
            self._curve = [tuple(row) for row in saved["curve"].tolist()]
            self._began -= self._curve[-1][1] if self._curve else 0.0
        self.saved = None  # frees memory

    def saved_records(self, like: Record) -> list[Record]:
        """Return the saved records; only samples are saved, and ``like`` gives all other fields."""
        if self.saved is None:
            return []
        with run.restoring(self.path):
            return [replace(like, **{key: one[key].numpy() for key in _ARRAYS}) for one in self.saved["records"]]

    def _on_training_start(self) -> None:
        self._saved_at = time.monotonic()

    def _on_rollout_start(self) -> None:
        if time.monotonic() - self._saved_at > run.CHECKPOINT_SECONDS:
            self._save()
            self._saved_at = time.monotonic()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            # VecMonitor adds this key at the end of an episode.
            if "episode" in info:
                seconds = round(time.process_time() - self._began, 2)
                self._curve.append((self.num_timesteps + self.spent, seconds, round(float(info["episode"]["r"]), 4)))
        return True

    def _on_training_end(self) -> None:
        self._save()

    def _save(self) -> None:
        model = self.model
        counters = ("num_timesteps", "_n_updates", "_episode_num", "_n_calls")  # only DQN has _n_calls
        kept = [{key: torch.from_numpy(getattr(one, key)) for key in _ARRAYS} for one in self.records()]
        state: dict[str, Any] = {
            "parameters": model.get_parameters(),
            "counters": {name: getattr(model, name) for name in counters if hasattr(model, name)},
            "resumed": self.resumed,
            "restarts": self.restarts,
            "privileged": self.privileged,
            "records": kept,
            "weights": self.weights,
            "curve": torch.tensor(self._curve, dtype=torch.float64).reshape(-1, 3),
            "moments": _moments(model.get_vec_normalize_env()),
        }
        if isinstance(model, OffPolicyAlgorithm):
            state |= _buffer(model)
        with replacing(self._curve_path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("steps", "seconds", "return"))
            writer.writerows((int(steps), seconds, value) for steps, seconds, value in self._curve)
        run.save_checkpoint(self.path, state, fingerprint=self._fingerprint)


def _moments(scaling: VecNormalize | None) -> dict[str, Any]:
    """Return the running moments by which observations and rewards are scaled."""
    if scaling is None:
        return {}
    pairs: dict[str, Any] = {name: getattr(scaling, name) for name in ("obs_rms", "ret_rms")}
    return {
        name: {"mean": torch.tensor(one.mean), "var": torch.tensor(one.var), "count": float(one.count)}
        for name, one in pairs.items()
    }


def _buffer(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """Return the filled part of the replay buffer, and the log of the entropy coefficient if SAC or TQC learns it."""
    buffer, weight = model.replay_buffer, getattr(model, "log_ent_coef", None)
    assert buffer is not None
    rows = buffer.size()
    stored = {name: torch.from_numpy(getattr(buffer, name)[:rows].copy()) for name in _STORED}
    weights = {} if weight is None else {"log_ent_coef": weight.detach().clone()}
    return {"stored": stored, "position": buffer.pos, **weights}


def _restore_buffer(model: OffPolicyAlgorithm, saved: dict[str, Any]) -> None:
    buffer: Any = model.replay_buffer
    rows = len(saved["stored"]["rewards"])
    for name in _STORED:
        getattr(buffer, name)[:rows] = saved["stored"][name].numpy()
    buffer.pos, buffer.full = int(saved["position"]), rows == buffer.buffer_size
    if "log_ent_coef" in saved:
        model.log_ent_coef.data.copy_(saved["log_ent_coef"])  # type: ignore[attr-defined]
