"""Independent jobs: one method on one system, from the choice of a configuration to its errors. Each is resumable."""

import json
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from kkl_gym.systems import get_system
from training.benchmark.protocol import Protocol, measure, validate
from training.methods import Budget, Configuration, Method, Task, get_method
from training.pipeline import describe

Running = Callable[[list[str]], None]


@dataclass(frozen=True)
class Job:
    """One method on one system.

    folder : what it makes: trained.safetensors, errors.csv, info.json, and what the search tried.
    search : seconds of CPU time for each configuration; none if the first is to be taken as it is.
    validation : trajectories on which configurations are compared; their seeds are those of validation.
    seed : of the training.
    device : where networks are trained.
    """

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
        self._check()
        return (self.folder / "errors.csv").exists()

    def claim(self) -> None:
        """Make the folder; raises ValueError if it belongs to another benchmark."""
        self._check()
        write(self.folder / "job.json", json.dumps(self._identity(), indent=2) + "\n")

    def _identity(self) -> dict[str, Any]:
        described = {
            **asdict(self),
            "system": describe(get_system(self.system)),
            "method": get_method(self.method).name,
        }
        del described["folder"], described["device"]
        found: dict[str, Any] = json.loads(json.dumps(described))
        return found

    def _check(self) -> None:
        path = self.folder / "job.json"
        if not path.exists():
            return
        before, here = json.loads(path.read_text()), self._identity()
        changed = [name for name in sorted({*before, *here}) if before.get(name) != here.get(name)]
        if changed:
            differences = "; ".join(f"{name} = {before.get(name)} there, {here.get(name)} here" for name in changed)
            raise ValueError(
                f"{self.folder} holds results of another benchmark: {differences}. Take another --out, or remove it"
            )


def run_job(job: Job, threads: int = 1) -> None:
    """Choose, train, measure; steps that were done before are not done again."""
    torch.set_num_threads(threads)
    if job.done:
        return
    job.claim()
    method, system = get_method(job.method), get_system(job.system)
    configuration, scores = _choose(job, method)
    trained, seconds = _train(job, method, configuration, job.budget, "trained")
    info = {
        "label": method.label,
        "configuration": dict(configuration),
        "validation": scores,
        "train_seconds": seconds,
    }
    write(job.folder / "info.json", json.dumps(info, indent=2) + "\n")
    errors = measure(method, trained, system, job.budget.dt, job.protocol)
    errors.insert(0, "system", system.name)
    errors.insert(1, "method", method.name)
    write(job.folder / "errors.csv", errors.to_csv(index=False, float_format="%.4g"))


def _choose(job: Job, method: Method[Any]) -> tuple[Configuration, list[float]]:
    """The configuration with the least validation error after a short training each, and all their errors."""
    system = get_system(job.system)
    configurations = method.configurations(system)
    if len(configurations) > 3:
        raise ValueError(f"{method.name} has {len(configurations)} configurations; at most three keep the search fair")
    if job.search is None or len(configurations) == 1:
        return configurations[0], []
    scores = []
    for i, configuration in enumerate(configurations):
        path = job.folder / f"configuration-{i}.json"
        if not path.exists():
            budget = replace(job.budget, seconds=job.search)
            try:
                trained, _ = _train(job, method, configuration, budget, f"configuration-{i}")
                score = validate(method, trained, system, job.budget.dt, job.validation)
            except FloatingPointError:  # a training that blows up is no candidate
                score = 200.0
            write(path, json.dumps({"configuration": dict(configuration), "score": score}) + "\n")
        scores.append(float(json.loads(path.read_text())["score"]))
    return configurations[scores.index(min(scores))], scores


def _train(
    job: Job, method: Method[Any], configuration: Configuration, budget: Budget, name: str
) -> tuple[Any, float | None]:
    """Train, or load what was trained before (its time is then in info.json, if the job came that far)."""
    path = job.folder / f"{name}.safetensors"
    timing = job.folder / f"{name}.seconds"
    if not (path.exists() and timing.exists()):
        folder = job.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        task = Task(get_system(job.system), budget, folder, job.seed, torch.device(job.device))
        began = time.process_time()
        trained = method.train(task, configuration)
        write(timing, f"{time.process_time() - began:.1f}\n")
        method.save(trained, path)
        shutil.rmtree(folder)  # checkpoints
    return method.load(path), float(timing.read_text())


def run_all(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Exception | None, list[str]]]:
    """Run jobs in worker processes; yields each with its failure, if any, and the names of those that run next."""
    if workers == 1:
        for job in jobs:
            yield job, _failure(lambda job=job: run_job(job)), []  # type: ignore[misc]
        return
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures: dict[Future[None], Job] = {pool.submit(run_job, job): job for job in jobs}
        try:
            while futures:
                finished, _ = wait(futures, return_when=FIRST_COMPLETED)
                for future in finished:
                    job = futures.pop(future)
                    yield job, _failure(future.result), [job.name for job in list(futures.values())[:workers]]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _failure(call: Callable[[], None]) -> Exception | None:
    try:
        call()
    except Exception as error:  # whatever a method does wrong, the others go on
        return error
    return None


def write(path: Path, text: str) -> None:
    """Write a file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.new")
    temporary.write_text(text)
    os.replace(temporary, path)
