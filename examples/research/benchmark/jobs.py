"""One method on one system: the choice of its configuration, its training and its evaluation."""

import hashlib
import inspect
import json
import shutil
import traceback
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

import kkl_gym
from examples.research.benchmark.protocol import Protocol, measure, step_time, tuned_for, validate
from examples.research.methods import SHIPPED, Budget, Configuration, Task, get_method
from examples.research.resumable import Job
from kkl_gym.systems import get_system
from observers.storage import explained
from training import run
from training.files import write
from training.trajectories.equations import describe

FAILED = 200.0  # largest SMAPE in %, given to a configuration whose training diverges
REVISION = 9  # increased with every change of the shipped methods, so that older results are not reused


def seconds_spent(folder: Path) -> float:
    """Return the CPU seconds of all stages with checkpoints in a folder, including the time before interruptions."""
    spent = 0.0
    for path in sorted(folder.glob(f"[!.]*{run.CHECKPOINT}")):  # names of unfinished files begin with a dot
        checkpoint = run.load_checkpoint(path)
        with run.restoring(path):
            spent += float(checkpoint["seconds"])
    return spent


@dataclass(frozen=True)
class Training(Job):
    """One method on one system."""

    system: str
    method: str
    folder: Path
    budget: Budget
    protocol: Protocol
    search: float | None
    validation: Protocol
    seed: int = 0

    result: ClassVar[str] = "errors.csv"
    other: ClassVar[str] = "results of another benchmark"

    @property
    def name(self) -> str:
        """System and method."""
        return f"{get_system(self.system).name}/{get_method(self.method).name}"

    @property
    def identity(self) -> dict[str, Any]:
        """All settings, the system's equations and the code of methods that do not ship."""
        system, method = get_system(self.system), get_method(self.method)
        described = {
            **asdict(self),
            "system": describe(system),
            "method": method.name,
            "configurations": method.configurations(system),
            "tuned_for": tuned_for(method, system),
            "version": kkl_gym.__version__,
            "revision": REVISION,
        }
        del described["folder"]
        if method not in SHIPPED.values():
            described["code"] = hashlib.sha256(inspect.getsource(type(method)).encode()).hexdigest()[:16]
        return described

    def work(self) -> None:
        """Choose a configuration, train and evaluate; completed steps are not repeated."""
        try:
            self._work()
        except Exception:
            write(self.folder / "failure.txt", traceback.format_exc())
            raise

    def _work(self) -> None:
        method, system = get_method(self.method), get_system(self.system)
        configuration, scores = self._chosen()
        trained, seconds = self._trained(configuration, self.budget, "trained")
        info = {
            "label": method.label,
            "configuration": dict(configuration),
            "validation": scores,
            "train_seconds": seconds,
            "trajectories": self.protocol.trajectories,
        }
        write(self.folder / "info.json", json.dumps(info, indent=2) + "\n")
        errors = measure(method, trained, system, dt=self.budget.dt, protocol=self.protocol)
        errors.insert(0, "system", system.name)
        errors.insert(1, "method", method.name)
        write(self.folder / self.result, errors.to_csv(index=False, float_format="%.4g"))

    def _chosen(self) -> tuple[Configuration, list[float]]:
        """Return the configuration of least validation SMAPE, and all SMAPEs; without a search, the first and []."""
        method, system = get_method(self.method), get_system(self.system)
        configurations = method.configurations(system)
        if not 1 <= len(configurations) <= 3:
            raise ValueError(
                f"{method.name} has {len(configurations)} configurations; one to three keep the search fair"
            )
        if self.search is None or len(configurations) == 1:
            return configurations[0], []
        scores, budget = [], replace(self.budget, cpu_seconds=self.search)
        for i, configuration in enumerate(configurations):
            path = self.folder / f"configuration-{i}.json"
            if not path.exists():
                try:
                    trained, _ = self._trained(configuration, budget, f"configuration-{i}")
                    score = validate(method, trained, system, dt=self.budget.dt, protocol=self.validation)
                except FloatingPointError:
                    score = FAILED
                write(path, json.dumps({"configuration": dict(configuration), "score": score}) + "\n")
            with explained(path, ValueError):
                scores.append(float(json.loads(path.read_text())["score"]))
        best = scores.index(min(scores))
        return configurations[best], scores

    def _trained(self, configuration: Configuration, budget: Budget, name: str) -> tuple[Any, float]:
        """Train, or read the file of an earlier training. Also returns the CPU seconds of the optimisation."""
        method, system = get_method(self.method), get_system(self.system)
        path, timing = self.folder / f"{name}.safetensors", self.folder / f"{name}.seconds"
        if not (path.exists() and timing.exists()):
            folder = self.folder / name
            folder.mkdir(parents=True, exist_ok=True)
            task = Task(system, budget, folder, self.seed)
            try:
                trained = method.train(task, configuration)
            except FloatingPointError:
                shutil.rmtree(folder)  # continuing from its checkpoint would fail again
                raise
            write(timing, f"{seconds_spent(folder):.1f}\n")
            method.save(trained, path)
            shutil.rmtree(folder)
        with explained(timing, ValueError):
            seconds = float(timing.read_text())
        return method.load(path), seconds

    def time_steps(self) -> None:
        """Time the steps of the observer, unless speed.json exists; call it while no training runs."""
        path = self.folder / "speed.json"
        if path.exists():
            return
        torch.set_num_threads(1)
        method, system, dt = get_method(self.method), get_system(self.system), self.budget.dt
        trained = method.load(self.folder / "trained.safetensors")
        times = {
            f"us_batch_{batch}": step_time(method, trained, system=system, dt=dt, batch=batch) for batch in (1, 1000)
        }
        write(path, json.dumps(times) + "\n")
