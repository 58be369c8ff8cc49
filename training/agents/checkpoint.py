"""Where an agent's training stands: what stable-baselines3 needs to go on, without its own files, which are pickled."""

import time
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat

from training import checkpoints

CURVE = "progress.csv"  # the learning curve, as stable-baselines3 calls it
_STORED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")  # in SAC's replay buffer


class Checkpoint(BaseCallback):
    """Writes a checkpoint now and then, between two rollouts, and at the end.

    It holds networks, optimisers, counters, the learning curve and SAC's replay buffer. It holds neither the
    environments nor random generators: a training that goes on begins new episodes, with random numbers of its own.
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        super().__init__()
        self.path, self.fingerprint, self.resumed = path, fingerprint, 0
        self._curve = path.with_name(CURVE)

    def restore(self, model: BaseAlgorithm, timesteps: int) -> None:
        """Take up what was saved, if anything was; the learning curve's file is as it was then."""
        if not self.path.exists():
            return
        found = checkpoints.load(self.path, fingerprint=self.fingerprint)
        with checkpoints.restoring(self.path):
            model.set_parameters(found["parameters"], device="cpu")
            model.num_timesteps, model._n_updates, model._episode_num = map(int, found["counters"])
            if isinstance(model, SAC):
                _restore_buffer(model, found)
            self.resumed = int(found["resumed"]) + (model.num_timesteps < timesteps)
            for curve in model.logger.output_formats:
                if isinstance(curve, CSVOutputFormat) and found["curve"]:
                    curve.file.write(found["curve"])
                    curve.file.flush()
                    curve.keys = found["curve"].partition("\n")[0].split(",")

    def _on_training_start(self) -> None:
        self._saved_at = time.monotonic()

    def _on_rollout_start(self) -> None:
        if time.monotonic() - self._saved_at > checkpoints.SECONDS:
            self._save()
            self._saved_at = time.monotonic()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._save()

    def _save(self) -> None:
        model = self.model
        state: dict[str, Any] = {
            "parameters": model.get_parameters(),
            "counters": [model.num_timesteps, model._n_updates, model._episode_num],
            "resumed": self.resumed,
            "curve": self._curve.read_text(encoding="utf-8") if self._curve.exists() else "",
        }
        if isinstance(model, SAC):
            state |= _buffer(model)
        checkpoints.save(self.path, state, fingerprint=self.fingerprint)


def _buffer(model: SAC) -> dict[str, Any]:
    """What SAC keeps beside its networks: the replay buffer, as far as it is filled, and the weight of the entropy."""
    buffer, weight = model.replay_buffer, model.log_ent_coef
    assert buffer is not None
    assert weight is not None
    rows = buffer.size()
    stored = {name: torch.from_numpy(getattr(buffer, name)[:rows].copy()) for name in _STORED}
    return {"stored": stored, "position": buffer.pos, "log_ent_coef": weight.detach().clone()}


def _restore_buffer(model: SAC, found: dict[str, Any]) -> None:
    buffer, weight = model.replay_buffer, model.log_ent_coef
    assert buffer is not None
    assert weight is not None
    rows = len(found["stored"]["rewards"])
    for name in _STORED:
        getattr(buffer, name)[:rows] = found["stored"][name].numpy()
    buffer.pos, buffer.full = int(found["position"]), rows == buffer.buffer_size
    weight.data.copy_(found["log_ent_coef"])
