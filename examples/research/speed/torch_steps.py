"""``python -m examples.research torch``."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from rich.console import Console

import kkl_gym
from examples.research.speed.observers import in_turns
from kkl_gym.memory import Memory
from kkl_gym.simulate import simulate
from observers import KKLObserver, load
from training import TorchMemory, TorchObserver
from training.files import table

MOTIONS, SETTLED, STEPS = 1024, 60, 5  # motions, steps before those that are timed, and these
NY, NU, TAU, TAU_U = 8, 2, (1.0, 2.0, 4.0, 8.0), (1.0, 4.0)  # of the memory

Task = Callable[[], float]


@dataclass(frozen=True)
class TorchSpeed:
    """Time a step of the default observers and of the memory as modules of Torch, beside NumPy and Numba.

    Prints microseconds a row, of one thread on a CPU: medians of turns, in each of which all are timed.
    """

    rows: tuple[int, ...] = (1024, 65_536)
    """Rows of the batches."""
    turns: int = 3
    """Number of turns."""
    compile: bool = False
    """Whether to time modules under torch.compile as well, which takes minutes to compile."""
    device: str = "cpu"
    """Where the modules of Torch run; on another device times are those of the clock."""

    def run(self, console: Console) -> list[list[str]]:
        """Measure and print."""
        if self.turns < 1 or not self.rows or min(self.rows) < 1:
            raise ValueError(f"turns must be positive, rows positive, got {self.turns} and {self.rows}")
        torch.set_num_threads(1)
        lines, columns = [], ["NumPy", "Numba", "Torch", *["Torch, compiled"] * self.compile]
        for name in (*kkl_gym.SYSTEMS, "memory"):
            for rows in self.rows:
                ways = self._memories(rows) if name == "memory" else self._observers(name, rows)
                with torch.no_grad():
                    seconds = in_turns({way: task for way, (task, _) in ways.items()}, self.turns)
                each = {way: f"{1e6 * np.median(seconds[way]) / n:.2f}" for way, (_, n) in ways.items()}
                lines.append([name, f"{rows:,}", *(each.get(column, "–") for column in columns)])
                console.print(*lines[-1])
        console.print("\n".join(table(["", "rows", *columns], lines)), soft_wrap=True, markup=False, highlight=False)
        return lines

    def _observers(self, name: str, rows: int) -> dict[str, tuple[Task, int]]:
        """Tasks that return the seconds of a step, and their rows."""
        artifact, system = load(name).artifact, kkl_gym.get_system(name)
        rng = np.random.default_rng(0)
        low, high = np.transpose(system.X)
        starts = rng.uniform(low, high, (MOTIONS, system.nx))
        y = system.output(simulate(system, starts, SETTLED + STEPS, artifact.filter.dt))
        y = np.resize(np.swapaxes(y, 0, 1), (rows, *y.shape[::2])).swapaxes(0, 1)
        y = y + 0.5 * rng.standard_normal(y.shape)
        u, module = np.zeros((rows, artifact.nu)), TorchObserver(artifact).to(self.device)

        def of(compiled: bool) -> Task:
            observer = KKLObserver(artifact, compiled=compiled)
            observer.reset(y[0])
            for k in range(1, SETTLED):
                observer.step(y[k], u)
            return self._timed(lambda k: observer.step(y[SETTLED + k], u))

        return {"NumPy": (of(False), rows), "Numba": (of(True), rows)} | self._modules(module, y, u)

    def _memories(self, rows: int) -> dict[str, tuple[Task, int]]:
        y, u = np.random.default_rng(0).normal(size=(SETTLED + STEPS, rows, NY)), np.zeros((rows, NU))
        memory = Memory(NY, NU, time_constants=TAU, input_time_constants=TAU_U)
        memory.reset(y[0])
        module = TorchMemory(NY, NU, time_constants=TAU, input_time_constants=TAU_U).to(self.device)
        own = self._timed(lambda k: memory.advance(y[k], u))
        return {"NumPy": (own, rows)} | self._modules(module, y, u)

    def _modules(self, module: torch.nn.Module, y: np.ndarray, u: np.ndarray) -> dict[str, tuple[Task, int]]:
        rows = y.shape[1]
        samples, inputs = (torch.tensor(each, dtype=torch.float32, device=self.device) for each in (y, u))

        def of(step: Callable[..., tuple[torch.Tensor, torch.Tensor]]) -> tuple[Task, int]:
            state, _ = module(module.start(rows), samples[0], inputs)  # type: ignore[operator]

            def advance(k: int) -> None:
                nonlocal state
                state, _ = step(state, samples[k], inputs)

            return self._timed(advance), rows

        ways = {"Torch": of(module)}
        return ways | ({"Torch, compiled": of(torch.compile(module, dynamic=False))} if self.compile else {})

    def _timed(self, step: Callable[[int], object]) -> Task:
        cpu = self.device == "cpu"
        clock = time.process_time if cpu else time.perf_counter

        def wait() -> None:
            if not cpu:
                torch.accelerator.synchronize()

        def task() -> float:
            wait()
            began = clock()
            for k in range(STEPS):
                step(k)
            wait()
            return (clock() - began) / STEPS

        return task
