"""``python -m examples.research torch``."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from rich.console import Console

import kkl_gym
from examples.research.speed.observers import in_turns, noisy_samples, seconds_of
from kkl_gym.memory import Memory
from observers import KKLObserver, load
from training import TorchMemory, TorchObserver
from training.files import table

MOTIONS, SETTLED, STEPS = 1024, 60, 5  # numbers of motions, of samples before the timed ones, and of timed steps
NY, NU, TAU, TAU_U = 8, 2, (1.0, 2.0, 4.0, 8.0), (1.0, 4.0)  # the memory's sizes, and its time constants in steps
WAYS = ("NumPy", "Numba", "Torch")

Task = Callable[[], float]


@dataclass(frozen=True)
class TorchSpeed:
    """Compare a step's times in NumPy, Numba and Torch, for the default observers, and for the memory without Numba.

    Prints microseconds per row on one CPU thread: medians over turns, each of which times every variant.
    """

    rows: tuple[int, ...] = (1024, 65_536)
    """Numbers of rows in a batch."""
    turns: int = 3
    """Number of turns."""

    def run(self, console: Console) -> list[list[str]]:
        """Measure the times, print a table and return its rows."""
        if self.turns < 1 or not self.rows or min(self.rows) < 1:
            raise ValueError(f"turns and rows must be positive, got {self.turns} and {self.rows}")
        torch.set_num_threads(1)
        lines = []
        for name in (*kkl_gym.SYSTEMS, "memory"):
            for rows in self.rows:
                with torch.no_grad():
                    seconds = in_turns(_memories(rows) if name == "memory" else _observers(name, rows), self.turns)
                each = {way: f"{1e6 * np.median(of) / rows:.2f}" for way, of in seconds.items()}
                lines.append([name, f"{rows:,}", *(each.get(way, "–") for way in WAYS)])
                console.print(*lines[-1])
        console.print("\n".join(table(["", "rows", *WAYS], lines)), soft_wrap=True, markup=False, highlight=False)
        return lines


def _observers(name: str, rows: int) -> dict[str, Task]:
    artifact, system = load(name).artifact, kkl_gym.get_system(name)
    y = noisy_samples(artifact, system, MOTIONS, SETTLED + STEPS)
    y = np.resize(y.swapaxes(0, 1), (rows, *y.shape[::2])).swapaxes(0, 1)
    u, tasks = np.zeros((rows, artifact.nu)), dict[str, Task]()
    for way, compiled in (("NumPy", False), ("Numba", True)):
        observer = KKLObserver(artifact, compiled=compiled)
        observer.reset(y[0])
        for sample in y[1:SETTLED]:
            observer.step(sample, u)
        tasks[way] = _timed(partial(observer.step, u=u), y)
    return {**tasks, "Torch": _module(TorchObserver(artifact), y, u)}


def _memories(rows: int) -> dict[str, Task]:
    y, u = np.random.default_rng(0).normal(size=(SETTLED + STEPS, rows, NY)), np.zeros((rows, NU))
    memory = Memory(NY, NU, time_constants=TAU, input_time_constants=TAU_U)
    memory.reset(y[0])
    module = TorchMemory(NY, NU, time_constants=TAU, input_time_constants=TAU_U)
    return {"NumPy": _timed(partial(memory.advance, u=u), y), "Torch": _module(module, y, u)}


def _module(module: torch.nn.Module, y: np.ndarray, u: np.ndarray) -> Task:
    samples, inputs = (torch.tensor(each, dtype=torch.float32) for each in (y, u))
    state, _ = module(module.start(y.shape[1]), samples[0], inputs)  # type: ignore[operator]

    def advance(sample: torch.Tensor) -> None:
        nonlocal state
        state, _ = module(state, sample, inputs)

    return _timed(advance, samples)


def _timed(step: Callable[..., object], samples: np.ndarray | torch.Tensor) -> Task:
    def steps() -> None:
        for sample in samples[SETTLED : SETTLED + STEPS]:
            step(sample)

    return partial(seconds_of, steps, STEPS)
