"""One optimisation loop for every network: Adam or SOAP, cosine decay, checkpoints, resuming, progress."""

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from rich.progress import Progress
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn
from torch.utils.tensorboard import SummaryWriter

CHECKPOINT_SECONDS = 20.0
LOG_EVERY = 100
WARM_UP = 0.01  # part of a stage in which the learning rate rises

# SOAP runs Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al., arXiv:2409.11321). For networks as small as
# these, on batches as large, it takes about as long a step, and far fewer of them.
Optimiser = Literal["adam", "soap"]

# A batch is drawn with the generator it is given and nothing else, so that a resumed run goes on as it would have.
Loss = Callable[[torch.Generator], dict[str, torch.Tensor]]


@dataclass(frozen=True)
class Stage:
    """One optimisation within a run.

    name : of its checkpoint and its scalars.
    steps : number of batches.
    learning_rate : at its highest; it decays to zero along a cosine after a short linear warm-up.
    folder : where checkpoints go.
    fingerprint : identifies the run's configuration; a checkpoint of another one is refused.
    seed : of the batches.
    cap : CPU seconds after which the stage ends if its steps are not done; the learning rate then follows the clock.
    optimiser : "adam" or "soap".
    """

    name: str
    steps: int
    learning_rate: float
    folder: Path
    fingerprint: str
    seed: int
    cap: float = math.inf
    optimiser: Optimiser = "adam"


def optimise(
    stage: Stage, module: nn.Module, loss: Loss, progress: Progress, writer: SummaryWriter, resume: bool
) -> list[tuple[int, float]]:
    """Minimise ``loss()["loss"]`` over the parameters of ``module``; returns its course by step.

    The course is that of ``loss()["error"]`` where there is one, else of the loss, averaged over LOG_EVERY steps.

    Every tensor in ``module.state_dict()`` is part of the checkpoint, buffers included.

    Raises FloatingPointError if the loss stops being a number; the last checkpoint then remains.
    """
    device = next(module.parameters()).device
    generator = torch.Generator(device).manual_seed(stage.seed)
    optimiser = _optimiser(stage, module)
    began = time.process_time()

    def seconds() -> float:
        return spent + time.process_time() - began

    def rate(step: int) -> float:
        done = max(step / stage.steps, min(1.0, seconds() / stage.cap))
        return min(1.0, (done + 1 / stage.steps) / WARM_UP) * 0.5 * (1.0 + math.cos(math.pi * done))

    checkpoint = stage.folder / f"{stage.name}.checkpoint.safetensors"
    start, spent = 0, 0.0
    history: list[tuple[int, float]] = []
    if resume and checkpoint.exists():
        start, spent, history = _restore(checkpoint, stage, module, optimiser, generator)
    task = progress.add_task(stage.name, total=stage.steps, completed=start)
    total, saved_at = torch.zeros((), device=device), time.monotonic()
    for step in range(start, stage.steps if spent < stage.cap else start):
        for group in optimiser.param_groups:
            group["lr"] = stage.learning_rate * rate(step)
        terms = loss(generator)
        optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()
        total += terms.get("error", terms["loss"]).detach()
        last = step + 1 == stage.steps or seconds() >= stage.cap
        if (step + 1) % LOG_EVERY == 0 or last:
            mean = float(total) / ((step % LOG_EVERY) + 1)
            if mean != mean:
                raise FloatingPointError(f"the error of stage {stage.name!r} is not a number at step {step + 1}")
            total.zero_()
            history.append((step + 1, mean))
            for name, value in terms.items():
                writer.add_scalar(f"{stage.name}/{name}", float(value.detach()), step + 1)
            progress.update(task, completed=step + 1, description=f"{stage.name} (error {mean:.3g})")
            if not progress.console.is_terminal and not progress.disable and (step + 1) % (20 * LOG_EVERY) == 0:
                progress.console.print(f"{stage.name}: {step + 1} of {stage.steps} batches, error {mean:.3g}")
            if time.monotonic() - saved_at > CHECKPOINT_SECONDS or last:
                _save(checkpoint, stage, module, optimiser, generator, step + 1, seconds(), history)
                saved_at = time.monotonic()
        if last:
            break
    return history


def _optimiser(stage: Stage, module: nn.Module) -> torch.optim.Optimizer:
    if stage.optimiser == "adam":
        return torch.optim.Adam(module.parameters(), lr=stage.learning_rate)
    from pytorch_optimizer import SOAP

    return SOAP(module.parameters(), lr=stage.learning_rate, weight_decay=0.0)


def seconds_spent(folder: Path) -> float:
    """CPU seconds of all stages whose checkpoints are in a folder, interruptions included."""
    total = 0.0
    for path in folder.glob("*.checkpoint.safetensors"):
        with safe_open(path, framework="pt") as opened:
            total += json.loads(opened.metadata()["checkpoint"])["seconds"]
    return total


def _save(
    path: Path,
    stage: Stage,
    module: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
    step: int,
    seconds: float,
    history: list[tuple[int, float]],
) -> None:
    tensors = {f"module.{name}": value.contiguous() for name, value in module.state_dict().items()}
    tensors["generator"] = generator.get_state()
    meta = {
        "fingerprint": stage.fingerprint,
        "step": step,
        "seconds": seconds,
        "history": history,
        "optimiser": _packed(optimiser.state_dict(), "optimiser", tensors),
    }
    temporary = path.with_name(f".{path.name}.new")
    save_file(tensors, temporary, metadata={"checkpoint": json.dumps(meta)})
    os.replace(temporary, path)


def _restore(
    path: Path, stage: Stage, module: nn.Module, optimiser: torch.optim.Optimizer, generator: torch.Generator
) -> tuple[int, float, list[tuple[int, float]]]:
    try:
        with safe_open(path, framework="pt") as opened:
            meta = json.loads(opened.metadata()["checkpoint"])
            fingerprint, packed = meta["fingerprint"], meta["optimiser"]
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"the checkpoint {path} is damaged or of an older version, remove it to train that stage anew: {error}"
        ) from error
    if fingerprint != stage.fingerprint:
        raise ValueError(f"the checkpoint {path} belongs to another configuration; train into another folder")
    module.load_state_dict({k.removeprefix("module."): v for k, v in tensors.items() if k.startswith("module.")})
    optimiser.load_state_dict(_unpacked(packed, tensors))
    generator.set_state(tensors["generator"].cpu())
    history = [(int(step), float(value)) for step, value in meta["history"]]
    return int(meta["step"]), float(meta.get("seconds", 0.0)), history


def _packed(value: Any, name: str, tensors: dict[str, torch.Tensor]) -> Any:
    """An optimiser's state for JSON: its tensors go into ``tensors``, their names stand for them."""
    if isinstance(value, torch.Tensor):
        # The order in memory is kept: products of matrices round differently in the other one.
        across = value.ndim == 2 and not value.is_contiguous()
        tensors[name] = (value.T if across else value).contiguous()
        return {"tensor": name, "across": across}
    if isinstance(value, dict):
        return {"keys": [[key, _packed(entry, f"{name}.{key}", tensors)] for key, entry in value.items()]}
    if isinstance(value, list | tuple):
        return [_packed(entry, f"{name}.{i}", tensors) for i, entry in enumerate(value)]
    return value


def _unpacked(packed: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(packed, list):
        return [_unpacked(entry, tensors) for entry in packed]
    if isinstance(packed, dict):
        if "tensor" in packed:
            stored = tensors[packed["tensor"]]
            return stored.T if packed["across"] else stored
        return {key: _unpacked(entry, tensors) for key, entry in packed["keys"]}
    return packed
