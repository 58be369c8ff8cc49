"""A training under way: its folder, progress and checkpoints, and one optimisation loop for every network."""

import hashlib
import json
import math
import operator
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress
from torch import nn

from observers.storage import naming
from training import checkpoints
from training.config import Config, Optimiser
from training.progress import LOG, ProgressBars, progress_bars

LOG_EVERY = 100
WARM_UP = 0.01  # part of a stage in which the learning rate rises

# A batch is drawn with the generator it is given and nothing else, so that a resumed run goes on as it would have.
Loss = Callable[[torch.Generator], dict[str, torch.Tensor]]

Log = Callable[[str, float, int], object]
"""Takes the name of a scalar, its value and the number of the batch."""


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
        """Train a stage's network within its share of the CPU time, with the configuration's settings or others."""
        config = self.config
        seconds = math.inf if config.cpu_seconds is None else config.cpu_seconds * share
        usual = {key: getattr(config, key) for key in ("learning_rate", "seed", "optimiser")}
        where: dict[str, Any] = {"folder": self.folder, "fingerprint": self.fingerprint, "cpu_seconds": seconds}
        stage = Stage(name=name, steps=steps, **{**where, **usual, **settings})
        with self.timed(name):
            self.losses[name] = optimise(stage, problem, loss, self.progress, log=self.log, resume=self.resume)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the CPU seconds of what happens inside to those of a stage."""
        began = time.process_time()
        yield
        self.seconds[name] += time.process_time() - began


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One optimisation within a run."""

    name: str
    steps: int
    learning_rate: float
    folder: Path
    fingerprint: str
    seed: int
    cpu_seconds: float = math.inf
    optimiser: Optimiser = "adam"

    @property
    def checkpoint(self) -> Path:
        """The file that keeps how far it has come."""
        return self.folder / f"{self.name}{checkpoints.SUFFIX}"


class _Course:
    """How far a stage has come: batches done, CPU seconds spent, the error by batch, and what a checkpoint holds."""

    def __init__(self, stage: Stage, module: nn.Module) -> None:
        self.stage, self.step, self.history = stage, 0, list[tuple[int, float]]()
        self._spent, self._began = 0.0, time.process_time()
        self.generator = torch.Generator(next(module.parameters()).device).manual_seed(stage.seed)
        self.optimiser = _optimiser(stage, module)
        self._parts: dict[str, Any] = {"module": module, "optimiser": self.optimiser}

    @property
    def seconds(self) -> float:
        return self._spent + time.process_time() - self._began

    @property
    def part(self) -> float:
        return max(self.step / self.stage.steps, min(1.0, self.seconds / self.stage.cpu_seconds))

    @property
    def learning_rate(self) -> float:
        done = self.part
        warm = min(1.0, (done + 1 / self.stage.steps) / WARM_UP)
        return self.stage.learning_rate * (warm * 0.5 * (1.0 + math.cos(math.pi * done)))

    @property
    def over(self) -> bool:
        return self.step >= self.stage.steps or self.seconds >= self.stage.cpu_seconds

    def save(self) -> None:
        state = {name: part.state_dict() for name, part in self._parts.items()}
        state |= {"generator": self.generator.get_state(), "step": self.step, "seconds": self.seconds}
        checkpoints.save(self.stage.checkpoint, state | {"history": self.history}, fingerprint=self.stage.fingerprint)

    def restore(self) -> None:
        state = checkpoints.load(self.stage.checkpoint, fingerprint=self.stage.fingerprint)
        with checkpoints.restoring(self.stage.checkpoint):
            for name, part in self._parts.items():
                part.load_state_dict(state[name])
            self.generator.set_state(state["generator"])
            self.history = [(int(step), float(error)) for step, error in state["history"]]
            self.step, self._spent = operator.index(state["step"]), float(state["seconds"])


def optimise(
    stage: Stage, module: nn.Module, loss: Loss, progress: Progress, *, log: Log | None = None, resume: bool
) -> list[tuple[int, float]]:
    """Minimise a loss over the parameters of a module, with checkpoints.

    Every tensor in ``module.state_dict()`` is part of the checkpoint, buffers included.

    On a GPU the gradients of a ``capturable`` module replay one CUDA graph, with TF32 matrix products unless
    NVIDIA_TF32_OVERRIDE=0. Data and initial weights of a seed are those on a CPU; batches are not, as the generators
    differ, so that errors agree but for chance.
    """
    course = _Course(stage, module)
    if resume and stage.checkpoint.exists():
        course.restore()
    task = progress.add_task(stage.name, total=stage.steps, completed=course.step)
    batch = Gradients(module, loss, course.generator)
    captured = course.generator.device.type == "cuda" and getattr(module, "capturable", False)
    run, saved_at, over = Captured(batch, course.generator) if captured else batch, time.monotonic(), course.over
    while not over:
        for group in course.optimiser.param_groups:
            group["lr"] = course.learning_rate
        run()
        course.optimiser.step()
        course.step += 1
        over = course.over
        if course.step % LOG_EVERY and not over:
            continue
        mean = float(batch.total) / ((course.step - 1) % LOG_EVERY + 1)
        if mean != mean:
            raise FloatingPointError(f"the error of stage {stage.name!r} is not a number at step {course.step}")
        batch.total.zero_()
        course.history.append((course.step, mean))
        if log is not None:
            for name, value in batch.terms.items():
                log(f"{stage.name}/{name}", float(value), course.step)
        total = round(course.step / course.part)  # that there will be by the time the clock ends it
        progress.update(task, completed=course.step, total=total, description=f"{stage.name} (error {mean:.3g})")
        if over or time.monotonic() - saved_at > checkpoints.SECONDS:
            course.save()
            saved_at = time.monotonic()
    return course.history


def _optimiser(stage: Stage, module: nn.Module) -> torch.optim.Optimizer:
    if stage.optimiser == "adam":
        return torch.optim.Adam(module.parameters(), lr=stage.learning_rate)
    from pytorch_optimizer import SOAP

    return SOAP(module.parameters(), lr=stage.learning_rate, weight_decay=0.0)


@contextmanager
def log_to(folder: Path) -> Iterator[Log | None]:
    """TensorBoard scalars in a folder, where TensorBoard is installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        yield None
        return
    with naming(folder), SummaryWriter(folder) as writer:
        yield writer.add_scalar


class Gradients:
    """Draws a batch and puts the clipped gradients of its loss, and the sum of errors, in tensors that stay in place.

    The optimiser steps outside, because the eigenvectors of SOAP cannot be part of a CUDA graph.
    """

    def __init__(self, module: nn.Module, loss: Loss, generator: torch.Generator) -> None:
        self.module, self.loss, self.generator = module, loss, generator
        self.total, self.terms = torch.zeros((), device=generator.device), dict[str, torch.Tensor]()

    def __call__(self) -> None:
        """Run it."""
        terms = self.loss(self.generator)
        self.module.zero_grad(set_to_none=True)
        terms["loss"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        self.total += terms.get("error", terms["loss"]).detach()
        self.terms = {name: value.detach() for name, value in terms.items()}


class Captured:
    """A function of tensors that stay in place: its first calls run as they are, the others replay a CUDA graph."""

    WARM_UP = 3  # calls in which torch's libraries allocate what they keep

    def __init__(self, function: Callable[[], None], generator: torch.Generator) -> None:
        self._function, self._generator, self._calls = function, generator, 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Run the function, or replay it."""
        if self._calls < self.WARM_UP:
            stream, current = torch.cuda.Stream(), torch.cuda.current_stream()  # type: ignore[no-untyped-call]
            stream.wait_stream(current)
            with _on_gpu(), torch.cuda.stream(stream):
                self._function()
            current.wait_stream(stream)
        else:
            self._graph = self._graph or self._captured()
            self._graph.replay()
        self._calls += 1

    def _captured(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        try:
            with _on_gpu(), torch.cuda.graph(graph):
                self._function()
        except RuntimeError as error:
            raise RuntimeError(
                f"a batch cannot be captured as a CUDA graph, as if f or h copied tensors to the host: {error}; train "
                "with --device cpu"
            ) from error
        return graph


@contextmanager
def _on_gpu() -> Iterator[None]:
    """TF32 matrix products, and functions uncompiled that the compiler fails on."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        with torch._dynamo.config.patch(suppress_errors=True):
            yield
    finally:
        torch.set_float32_matmul_precision(before)
