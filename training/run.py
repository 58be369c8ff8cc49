"""A training under way: its folder, progress and checkpoints, and one optimisation loop for every network."""

import hashlib
import json
import math
import operator
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress
from torch import nn

from observers.storage import naming
from training import checkpoints
from training.config import Config, Optimiser
from training.files import claimed_run
from training.progress import LOG, ProgressBars, progress_bars

LOG_EVERY = 100
WARM_UP = 0.01  # part of a stage in which the learning rate rises

# A batch is drawn with the generator it is given and nothing else, so that a resumed run goes on as it would have.
Loss = Callable[[torch.Generator], dict[str, torch.Tensor]]

Log = Callable[[str, float, int], object]
"""Takes the name of a scalar, its value and the number of the batch."""


@dataclass
class Run:
    """A training under way; ``with Run.begin(config) as run`` makes one for a lesson by itself."""

    config: Config
    folder: Path
    fingerprint: str
    progress: ProgressBars
    device: torch.device
    resume: bool = False
    log: Log | None = None
    losses: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    samples: dict[str, int] = field(default_factory=dict)  # distinct ones of each stage

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
        """Begin in a folder, which is locked, with a log and TensorBoard's scalars; without one nothing is kept."""
        described = json.dumps(identity or {}, sort_keys=True)
        torch.manual_seed(config.seed)
        with ExitStack() as stack:
            log: Log | None = None
            lines = None if folder is None else folder / LOG
            if folder is None:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            else:
                stack.enter_context(claimed_run(folder, identity or {}, resume))
                with suppress(ImportError):  # TensorBoard is an extra
                    from torch.utils.tensorboard import SummaryWriter

                    stack.enter_context(naming(folder))
                    log = stack.enter_context(SummaryWriter(folder)).add_scalar
            progress = stack.enter_context(progress_bars(console, lines))
            device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")
            fingerprint = hashlib.sha256(described.encode()).hexdigest()[:16]
            yield cls(config, folder, fingerprint, progress, device, resume, log)

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


@dataclass(kw_only=True)
class Stage:
    """One optimisation within a run, and how far it has come: batches, CPU seconds, and the error by batch."""

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
    def checkpoint(self) -> Path:
        """The file that a resumed stage goes on from."""
        return self.folder / f"{self.name}{checkpoints.SUFFIX}"

    @property
    def seconds(self) -> float:
        """CPU time spent."""
        return time.process_time() - self.began

    @property
    def part(self) -> float:
        """Share of the stage that is done, by steps or by CPU time."""
        return max(self.step / self.steps, min(1.0, self.seconds / self.cpu_seconds))

    @property
    def rate(self) -> float:
        """The learning rate of the next batch."""
        done = self.part
        warm = min(1.0, (done + 1 / self.steps) / WARM_UP)
        return self.learning_rate * (warm * 0.5 * (1.0 + math.cos(math.pi * done)))

    def save(self, state: Mapping[str, Any]) -> None:
        """Write a checkpoint."""
        own = {"step": self.step, "seconds": self.seconds, "history": self.history}
        checkpoints.save(self.checkpoint, {**state, **own}, fingerprint=self.fingerprint)

    def restore(self, parts: Mapping[str, Any], generator: torch.Generator) -> None:
        """Go on from the checkpoint."""
        state = checkpoints.load(self.checkpoint, fingerprint=self.fingerprint)
        with checkpoints.restoring(self.checkpoint):
            for name, part in parts.items():
                part.load_state_dict(state[name])
            generator.set_state(state["generator"])
            self.history = [(int(step), float(error)) for step, error in state["history"]]
            self.step, self.began = operator.index(state["step"]), time.process_time() - float(state["seconds"])


def optimise(
    stage: Stage, module: nn.Module, loss: Loss, progress: Progress, *, log: Log | None = None, resume: bool
) -> list[tuple[int, float]]:
    """Minimise a loss over the parameters of a module, with checkpoints.

    Every tensor in ``module.state_dict()`` is part of the checkpoint, buffers included.

    On a GPU the gradients of a ``capturable`` module replay one CUDA graph, with TF32 matrix products unless
    NVIDIA_TF32_OVERRIDE=0. Data and initial weights of a seed are those on a CPU; batches are not, as the generators
    differ, so that errors agree but for chance.
    """
    generator = torch.Generator(next(module.parameters()).device).manual_seed(stage.seed)
    optimiser = _optimiser(stage, module)
    parts: dict[str, Any] = {"module": module, "optimiser": optimiser}
    if resume and stage.checkpoint.exists():
        stage.restore(parts, generator)
    task = progress.add_task(stage.name, total=stage.steps, completed=stage.step)
    batch = Gradients(module, loss, generator)
    captured = generator.device.type == "cuda" and getattr(module, "capturable", False)
    run, saved_at = Captured(batch, generator) if captured else batch, time.monotonic()
    over = stage.part >= 1
    while not over:
        for group in optimiser.param_groups:
            group["lr"] = stage.rate
        run()
        optimiser.step()
        stage.step += 1
        over = stage.part >= 1
        if stage.step % LOG_EVERY and not over:
            continue
        mean = float(batch.total) / ((stage.step - 1) % LOG_EVERY + 1)
        if mean != mean:
            raise FloatingPointError(f"the error of stage {stage.name!r} is not a number at step {stage.step}")
        batch.total.zero_()
        stage.history.append((stage.step, mean))
        if log is not None:
            for name, value in batch.terms.items():
                log(f"{stage.name}/{name}", float(value), stage.step)
        total = round(stage.step / stage.part)  # that there will be by the time the clock ends it
        progress.update(task, completed=stage.step, total=total, description=f"{stage.name} (error {mean:.3g})")
        if over or time.monotonic() - saved_at > checkpoints.SECONDS:
            state = {name: part.state_dict() for name, part in parts.items()}
            stage.save({**state, "generator": generator.get_state()})
            saved_at = time.monotonic()
    return stage.history


def _optimiser(stage: Stage, module: nn.Module) -> torch.optim.Optimizer:
    if stage.optimiser == "adam":
        on_gpu = next(module.parameters()).is_cuda  # where a fused step is one kernel
        return torch.optim.Adam(module.parameters(), lr=stage.learning_rate, fused=on_gpu)
    from pytorch_optimizer import SOAP

    return SOAP(module.parameters(), lr=stage.learning_rate, weight_decay=0.0)


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
