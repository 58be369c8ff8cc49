"""Independent jobs: one method on one system, from the choice of a configuration to its errors. Each is resumable."""

import hashlib
import inspect
import json
import shutil
import traceback
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

import kkl_gym
from examples.research.benchmark.protocol import Protocol, measure, step_time, tuned_for, validate
from examples.research.methods import ABLATION, METHODS, Budget, Configuration, Method, Task, get_method
from kkl_gym.systems import get_system
from observers.storage import explained, write
from training.jobs import check_identity, claimed_job, describe
from training.maps.optimise import seconds_spent

FAILED = 200.0  # the worst SMAPE there is, for a configuration whose training blows up

OTHER = "results of another benchmark"

REVISION = 7  # rises with every change of the shipped methods: results from before are not reused


@dataclass(frozen=True)
class Job:
    """One method on one system."""

    system: str
    method: str
    folder: Path
    budget: Budget
    protocol: Protocol
    search: float | None
    validation: Protocol
    seed: int = 0
    device: str = "cpu"

    @property
    def name(self) -> str:
        """For people."""
        return f"{get_system(self.system).name}/{get_method(self.method).name}"

    @property
    def done(self) -> bool:
        """Whether its errors are there; raises ValueError if they are those of another benchmark."""
        check_identity(self.folder / "job.json", self.identity, OTHER)
        return (self.folder / "errors.csv").exists()

    @property
    def identity(self) -> dict[str, Any]:
        """What makes its results what they are: where they lie and where they were computed do not."""
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
        del described["folder"], described["device"]
        if type(method) not in (METHODS | ABLATION).values():  # a user's, who may be at work on it
            described["code"] = hashlib.sha256(inspect.getsource(type(method)).encode()).hexdigest()[:16]
        return described


def run_job(job: Job) -> None:
    """Choose, train, measure; steps that were done before are not done again."""
    torch.set_num_threads(1)
    with claimed_job(job.folder, job.identity, OTHER):
        if not job.done:
            try:
                _run(job)
            except Exception:
                write(job.folder / "failure.txt", traceback.format_exc())
                raise


def time_steps(job: Job) -> None:
    """Time the steps of a job's observer, unless that is done; to be called while no training runs."""
    path = job.folder / "speed.json"
    if path.exists():
        return
    torch.set_num_threads(1)
    method, system, dt = get_method(job.method), get_system(job.system), job.budget.dt
    trained = method.load(job.folder / "trained.safetensors")
    times = {f"us_batch_{batch}": step_time(method, trained, system=system, dt=dt, batch=batch) for batch in (1, 1000)}
    write(path, json.dumps(times) + "\n")


def _run(job: Job) -> None:
    method, system = get_method(job.method), get_system(job.system)
    configuration, scores = _choose(job, method)
    trained, seconds = _train(job, method, configuration, job.budget, "trained")
    info = {
        "label": method.label,
        "configuration": dict(configuration),
        "validation": scores,
        "train_seconds": seconds,
        "trajectories": min(job.protocol.trajectories, method.trajectories or job.protocol.trajectories),
    }
    write(job.folder / "info.json", json.dumps(info, indent=2) + "\n")
    errors = measure(method, trained, system, dt=job.budget.dt, protocol=job.protocol)
    errors.insert(0, "system", system.name)
    errors.insert(1, "method", method.name)
    write(job.folder / "errors.csv", errors.to_csv(index=False, float_format="%.4g"))


def _choose(job: Job, method: Method[Any]) -> tuple[Configuration, list[float]]:
    """The configuration with the least validation error after a short training each, and all their errors."""
    system = get_system(job.system)
    configurations = method.configurations(system)
    if not 1 <= len(configurations) <= 3:
        raise ValueError(f"{method.name} has {len(configurations)} configurations; one to three keep the search fair")
    if job.search is None or len(configurations) == 1:
        return configurations[0], []
    scores = []
    for i, configuration in enumerate(configurations):
        path = job.folder / f"configuration-{i}.json"
        if not path.exists():
            budget = replace(job.budget, cpu_seconds=job.search)
            try:
                trained, _ = _train(job, method, configuration, budget, f"configuration-{i}")
                score = validate(method, trained, system, dt=job.budget.dt, protocol=job.validation)
            except FloatingPointError:  # a training that blows up is no candidate
                score = FAILED
            write(path, json.dumps({"configuration": dict(configuration), "score": score}) + "\n")
        with explained(path, ValueError):
            scores.append(float(json.loads(path.read_text())["score"]))
    best = scores.index(min(scores))
    if min(scores) == FAILED:
        return configurations[best], scores
    budget = replace(job.budget, cpu_seconds=job.search)
    trained, _ = _train(job, method, configurations[best], budget, f"configuration-{best}")  # loads what is there
    return method.settled(configurations[best], trained), scores


def _train(job: Job, method: Method[Any], configuration: Configuration, budget: Budget, name: str) -> tuple[Any, float]:
    """Train, or load what was trained before; returns it with the CPU seconds that its optimisation took."""
    path, timing = job.folder / f"{name}.safetensors", job.folder / f"{name}.seconds"
    if not (path.exists() and timing.exists()):
        folder = job.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        task = Task(method.believed(get_system(job.system)), budget, folder, job.seed, torch.device(job.device))
        try:
            trained = method.train(task, configuration)
        except FloatingPointError:
            shutil.rmtree(folder)  # its checkpoint would fail again
            raise
        write(timing, f"{seconds_spent(folder):.1f}\n")
        method.save(trained, path)
        shutil.rmtree(folder)
    with explained(timing, ValueError):
        seconds = float(timing.read_text())
    return method.load(path), seconds
