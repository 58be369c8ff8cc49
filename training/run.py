"""A running training: its folder, progress and checkpoints, and the optimisation loop of all networks."""

import hashlib
import io
import json
import math
import operator
import tempfile
import time
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress
from torch import nn

from observers.storage import replacing
from training.config import Config, Optimiser
from training.files import claimed_run
from training.progress import LOG, ProgressBars, progress_bars

LOG_EVERY = 100  # batches between two entries of the error history
CHECKPOINT_SECONDS = 20.0  # s, least time from one checkpoint to the next, except to the last of a stage
CHECKPOINT = ".checkpoint.pt"  # suffix of checkpoint files
WARM_UP = 0.01  # the learning rate rises over this first share of a stage

# A loss draws its batch from the given generator alone, so that a resumed run continues as if it had not stopped.
Loss = Callable[[torch.Generator], dict[str, torch.Tensor]]


@dataclass
class Run:
    """A running training; ``with Run.begin(config) as run`` makes one for :func:`training.learn_map` or ``learn_flow``.

    Attributes
    ----------
    config : Config
        The settings.
    folder : Path
        Folder of the checkpoints.
    fingerprint : str
        Hash of the run's identity, which checkpoints must match.
    progress : ProgressBars
        Where progress is shown.
    device : torch.device
        Where networks are trained.
    resume : bool
        Whether stages resume from their checkpoints.
    losses : dict of str to list of (int, float)
        For each stage, pairs (batches so far, mean error over the last 100 of them or fewer).
    seconds : dict of str to float
        CPU seconds of each stage.
    samples : dict of str to int
        Numbers of distinct samples, by name, from stages that count their samples.
    """

    config: Config
    folder: Path
    fingerprint: str
    progress: ProgressBars
    device: torch.device
    resume: bool = False
    losses: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    samples: dict[str, int] = field(default_factory=dict)

    @classmethod
    @contextmanager
    def begin(
        cls,
        config: Config,
        folder: Path | None = None,
        *,
        identity: Mapping[str, Any] | None = None,
        console: Any = None,
        device: torch.device | None = None,
        resume: bool = False,
    ) -> Iterator["Run"]:
        """Begin a run in a folder, which is locked and receives a log; without a folder nothing is kept."""
        described = json.dumps(identity or {}, sort_keys=True)
        fingerprint = hashlib.sha256(described.encode()).hexdigest()[:16]
        device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.manual_seed(config.seed)
        place: AbstractContextManager[Any] = (
            tempfile.TemporaryDirectory() if folder is None else claimed_run(folder, identity or {}, resume)
        )
        with place as temporary, progress_bars(console, folder and folder / LOG) as progress:
            yield cls(config, folder or Path(temporary), fingerprint, progress, device, resume)

    def minimise(
        self, name: str, problem: nn.Module, loss: Loss, steps: int, *, share: float = 1.0, **settings: Any
    ) -> None:
        """Train a stage's network within a share of the CPU time; ``settings`` replace the configuration's."""
        config = self.config
        seconds = math.inf if config.cpu_seconds is None else config.cpu_seconds * share
        usual = {key: getattr(config, key) for key in ("learning_rate", "seed", "optimiser")}
        where: dict[str, Any] = {"folder": self.folder, "fingerprint": self.fingerprint, "cpu_seconds": seconds}
        stage = Stage(name=name, steps=steps, **{**where, **usual, **settings})
        with self.timed(name):
            self.losses[name] = optimise(stage, problem, loss, self.progress, resume=self.resume)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the CPU seconds of the ``with`` block to those of a stage."""
        began = time.process_time()
        yield
        self.seconds[name] += time.process_time() - began


@dataclass(kw_only=True)
class Stage:
    """One optimisation within a run, and its state: batches done, history of errors, and start of its CPU time."""

    name: str
    steps: int
    learning_rate: float
    folder: Path
    fingerprint: str
    seed: int
    cpu_seconds: float = math.inf
    optimiser: Optimiser = "adam"
    step: int = 0
    history: list[tuple[int, float]] = field(default_factory=list)
    began: float = field(default_factory=lambda: time.process_time())

    @property
    def part(self) -> float:
        """Share of the stage that is done, by steps or by CPU time, whichever is larger."""
        return max(self.step / self.steps, min(1.0, (time.process_time() - self.began) / self.cpu_seconds))


def optimise(
    stage: Stage, module: nn.Module, loss: Loss, progress: Progress, *, resume: bool
) -> list[tuple[int, float]]:
    """Minimise a loss over a module's parameters, with checkpoints; a GPU draws other batches than a CPU."""
    generator = torch.Generator(next(module.parameters()).device).manual_seed(stage.seed)
    optimiser = _optimiser(stage, module)
    parts: dict[str, Any] = {"module": module, "optimiser": optimiser}
    checkpoint = stage.folder / f"{stage.name}{CHECKPOINT}"
    if resume and checkpoint.exists():
        state = load_checkpoint(checkpoint, fingerprint=stage.fingerprint)
        with restoring(checkpoint):
            for name, part in parts.items():
                part.load_state_dict(state[name])
            generator.set_state(state["generator"])
            stage.history = [(int(step), float(error)) for step, error in state["history"]]
            stage.step, stage.began = operator.index(state["step"]), time.process_time() - float(state["seconds"])
    task = progress.add_task(stage.name, total=stage.steps, completed=stage.step)
    total, saved_at, done = torch.zeros((), device=generator.device), time.monotonic(), stage.part
    while done < 1:
        warm = min(1.0, (done + 1 / stage.steps) / WARM_UP)
        for group in optimiser.param_groups:
            group["lr"] = stage.learning_rate * (warm * 0.5 * (1.0 + math.cos(math.pi * done)))
        terms = loss(generator)
        module.zero_grad()
        terms["loss"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()
        total += terms.get("error", terms["loss"]).detach()
        stage.step += 1
        done = stage.part
        if stage.step % LOG_EVERY and done < 1:
            continue
        mean = float(total) / ((stage.step - 1) % LOG_EVERY + 1)
        if math.isnan(mean):
            raise FloatingPointError(f"the error of stage {stage.name!r} is NaN at step {stage.step}")
        total.zero_()
        stage.history.append((stage.step, mean))
        expected = round(stage.step / done)  # total number of batches, which the limit of CPU time may reduce
        progress.update(task, completed=stage.step, total=expected, description=f"{stage.name} (error {mean:.3g})")
        if done >= 1 or time.monotonic() - saved_at > CHECKPOINT_SECONDS:
            state = {name: part.state_dict() for name, part in parts.items()} | {"generator": generator.get_state()}
            state |= {"step": stage.step, "seconds": time.process_time() - stage.began, "history": stage.history}
            save_checkpoint(checkpoint, state, fingerprint=stage.fingerprint)
            saved_at = time.monotonic()
    return stage.history


def _optimiser(stage: Stage, module: nn.Module) -> torch.optim.Optimizer:
    if stage.optimiser == "adam":
        on_gpu = next(module.parameters()).is_cuda  # on a GPU a fused step is one kernel
        return torch.optim.Adam(module.parameters(), lr=stage.learning_rate, fused=on_gpu)
    from pytorch_optimizer import SOAP

    return SOAP(module.parameters(), lr=stage.learning_rate, weight_decay=0.0)


def save_checkpoint(path: Path, state: Mapping[str, Any], *, fingerprint: str) -> None:
    """Write tensors and plain values in torch's own format, whole or not at all."""
    content = io.BytesIO()  # if torch wrote to a file, it would report a full disk as "unexpected pos"
    torch.save({**state, "fingerprint": fingerprint}, content)
    with replacing(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def load_checkpoint(path: Path, *, fingerprint: str | None = None) -> dict[str, Any]:
    """Read a checkpoint without running any code from it."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"the checkpoint {path} cannot be read: {error.strerror}") from error
    with restoring(path):
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            if part := file.testzip():  # torch writes checksums, but does not verify them
                raise ValueError(f"the checksum of {part} is wrong")
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        belongs_to = state.pop("fingerprint")
    if fingerprint not in (None, belongs_to):
        raise ValueError(f"the checkpoint {path} belongs to another configuration; train into another folder")
    return dict(state)


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Turn errors in restoring a checkpoint into a ValueError that names the file."""
    try:
        yield
    except Exception as error:  # pickle, zip and torch raise many kinds of errors
        line = (str(error) if not isinstance(error, KeyError) else f"it lacks {error}").partition("\n")[0]
        raise ValueError(
            f"the checkpoint {path} is damaged or of another version; remove it to train that stage again: {line}"
        ) from error
