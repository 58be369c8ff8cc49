"""What the lessons of a training share: its folder, progress, checkpoints, and how errors fell."""

import hashlib
import json
import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from training.config import Config
from training.maps.optimise import Log, Loss, Stage, log_to, optimise
from training.progress import LOG, ProgressBars, progress_bars


@dataclass
class Run:
    """A training under way; :func:`Run.alone` makes one for a lesson by itself."""

    config: Config
    folder: Path
    fingerprint: str
    progress: ProgressBars
    device: torch.device
    resume: bool = False
    log: Log | None = None
    losses: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    samples: dict[str, int] = field(default_factory=dict)  # distinct ones, for certificates

    @classmethod
    @contextmanager
    def begin(
        cls,
        config: Config,
        identity: Mapping[str, Any],
        folder: Path,
        *,
        console: Any = None,
        device: torch.device | None = None,
        resume: bool = False,
    ) -> Iterator["Run"]:
        """Begin in a folder, with a log and TensorBoard's scalars."""
        fingerprint = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
        device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.manual_seed(config.seed)
        with log_to(folder) as log, progress_bars(console, folder / LOG) as progress:
            yield cls(config, folder, fingerprint, progress, device, resume, log)

    @classmethod
    @contextmanager
    def alone(cls, config: Config, console: Any = None, device: torch.device | None = None) -> Iterator["Run"]:
        """Run a lesson by itself; nothing is kept."""
        with tempfile.TemporaryDirectory() as folder, progress_bars(console) as progress:
            torch.manual_seed(config.seed)
            yield cls(config, Path(folder), "", progress, device or torch.device("cpu"))

    def minimise(
        self, name: str, problem: nn.Module, loss: Loss, steps: int, *, share: float = 1.0, **settings: Any
    ) -> None:
        """Train a stage's network within its share of the CPU time."""
        config = self.config
        stage = Stage(
            name=name,
            steps=steps,
            folder=self.folder,
            fingerprint=self.fingerprint,
            cpu_seconds=math.inf if config.cpu_seconds is None else config.cpu_seconds * share,
            **{
                "learning_rate": config.learning_rate,
                "seed": config.seed,
                "optimiser": config.optimiser,
                **settings,
            },
        )
        with self.timed(name):
            self.losses[name] = optimise(stage, problem, loss, self.progress, log=self.log, resume=self.resume)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the CPU seconds of what happens inside to those of a stage."""
        began = time.process_time()
        yield
        self.seconds[name] += time.process_time() - began


__all__ = ["Run"]
