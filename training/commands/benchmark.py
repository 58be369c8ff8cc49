"""``kkl-gym benchmark``."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
import torch
import tyro
from rich.console import Console
from rich.progress import Progress

from kkl_gym.systems import SYSTEMS, get_system
from observers.storage import write
from training.benchmark.jobs import Job, run_job
from training.benchmark.protocol import Protocol, step_time
from training.benchmark.tables import draw, write_table
from training.jobs import run_all
from training.methods import ABLATION, METHODS, Budget, get_method
from training.progress import progress_bars
from training.seeds import Stream, generator

BUDGETS = {
    "cpu": Budget("cpu", trajectories=2000, duration=50.0, samples=200, cpu_seconds=300.0),
    "quick": Budget("quick", trajectories=200, duration=20.0, samples=50, cpu_seconds=5.0, width=64, depth=2),
    "short": Budget("short", trajectories=1000, duration=50.0, samples=200, cpu_seconds=40.0),
    # 8 million points, as in the paper
    "paper": Budget(
        "paper",
        trajectories=1600,
        duration=50.0,
        samples=5000,
        cpu_seconds=3600.0,
        width=512,
        depth=4,
        activation="silu",
    ),
}

PROTOCOL = Protocol()
QUICK_PROTOCOL = Protocol(trajectories=5, duration=10.0)
VALIDATION = Protocol(trajectories=20, duration=20.0)
NAMED = 4  # of the methods that are missing, by their names
SEARCH = 0.2  # of the budget's CPU seconds, for each configuration that is compared


@dataclass(frozen=True)
class Benchmark:
    """Compare observers: train every method on every system, measure all on the same unseen trajectories.

    Writes OUT/results.csv (one row for each trajectory), OUT/methods.csv (what each method cost), OUT/table.md and
    OUT/heatmap.png. Each method on each system is one job with a folder under OUT/jobs that keeps its
    trained observer; a run that was interrupted goes on where it stopped, and jobs may be spread over several runs by
    --systems and --methods. What is missing from the full set is said in table and figure.
    """

    budget: Literal["short", "cpu", "paper"] = "cpu"
    """cpu: 400,000 points and 300 CPU seconds for each training. short: a half of that, 40 s. paper: 8 million
    points, networks of 4 x 512, an hour each; wants a GPU."""
    quick: bool = False
    """In place of the budget: short trainings, no search, few and short test trajectories; a matter of minutes."""
    systems: tuple[str, ...] = tuple(SYSTEMS)
    """Names, or classes of yours as script.py:Class or module:Class."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Names, or classes of yours as script.py:Class or module:Class."""
    measurement_noise: Annotated[tuple[float, ...], tyro.conf.arg(aliases=["--noise"])] = (0.0, 0.5)
    """Standard deviations of the noise on each sample of y."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/benchmark/BUDGET)")] = None
    """Folder of results."""
    jobs: int = 2
    """Worker processes, of one thread each."""
    seed: int = 0
    """Seed of the test trajectories; training's is always 0."""
    report: bool = False
    """Only write table and figure again from OUT/results.csv and OUT/methods.csv."""

    def run(self, console: Console) -> Path:
        """Run what is missing, then report.

        Parameters
        ----------
        console : rich.console.Console
            For people.

        Returns
        -------
        Path
            The folder of results.

        Raises
        ------
        ValueError
            If an option makes no sense, the folder holds another benchmark, or jobs failed.
        """
        name = "quick" if self.quick else self.budget
        out = self.out or Path("runs") / "benchmark" / name
        if self.report:
            _report(out, console)
            return out
        self._check()
        jobs = self._jobs(name, out)
        todo = [job for job in jobs if not job.done]
        failures = []
        with progress_bars(console) as progress:
            task = progress.add_task("observers", total=len(jobs), completed=len(jobs) - len(todo))
            for job, failure, running in run_all(run_job, todo, min(self.jobs, max(1, len(todo)))):
                if failure:
                    failures.append(f"{job.name}: {failure}")
                    progress.console.print(f"[red]failed[/red] {failures[-1]} ({job.folder / 'failure.txt'})")
                else:
                    progress.console.print(f"finished {job.name}")
                text = f"observers (now {', '.join(running)})" if running else "observers"
                progress.update(task, advance=1, description=text)
            failures += self._time(jobs, progress)
        if any(job.done for job in jobs):
            _collect(out)
            _report(out, console)
        if failures:
            raise ValueError(f"{len(failures)} of {len(jobs)} jobs failed; the first: {failures[0]}")
        return out

    def _check(self) -> None:
        if self.jobs < 1 or not self.systems or not self.methods or not self.measurement_noise:
            raise ValueError("give at least one system, method, noise level and worker process")
        if any(not 0 <= level < math.inf for level in self.measurement_noise):
            raise ValueError(f"measurement_noise = {self.measurement_noise} must be finite and not negative")
        generator(Stream.EVALUATION, self.seed)  # refuses some seeds, now rather than when all is trained
        systems = [get_system(name).name for name in self.systems]
        methods = [get_method(name).name for name in self.methods]
        for names in (systems, methods, list(self.measurement_noise)):
            if len(set(names)) < len(names):
                raise ValueError(f"{names} has one of them twice")

    def _jobs(self, name: str, out: Path) -> list[Job]:
        levels = self.measurement_noise
        protocol = replace(QUICK_PROTOCOL if self.quick else PROTOCOL, measurement_noise=levels, seed=self.seed)
        budget = BUDGETS[name]
        search = None if self.quick else SEARCH * budget.cpu_seconds
        device = "cuda" if name == "paper" and torch.cuda.is_available() else "cpu"
        return [
            Job(
                system=system,
                method=method,
                folder=out / "jobs" / get_system(system).name / get_method(method).name,
                budget=budget,
                protocol=protocol,
                search=search,
                validation=replace(VALIDATION, measurement_noise=levels),
                device=device,
            )
            for system in self.systems
            for method in self.methods
        ]

    def _time(self, jobs: list[Job], progress: Progress) -> list[str]:
        """Time the observers' steps, now that no training runs; returns what failed."""
        failures = []
        torch.set_num_threads(1)
        todo = [job for job in jobs if job.done and not (job.folder / "speed.json").exists()]
        for job in progress.track(todo, description="timing steps"):
            method, system = get_method(job.method), get_system(job.system)
            trained = method.load(job.folder / "trained.safetensors")
            try:
                times = {
                    f"us_batch_{batch}": step_time(method, trained, system=system, dt=job.budget.dt, batch=batch)
                    for batch in (1, 1000)
                }
            except Exception as error:  # as in a job: whatever a method does wrong, the others go on
                failures.append(f"{job.name}, timing: {error}")
                continue
            write(job.folder / "speed.json", json.dumps(times) + "\n")
        return failures


def _full_set(found: Iterable[str]) -> list[str]:
    """The shipped methods, in order, of the comparison that some are of: the benchmark, the ablation, or both."""
    names = set(found)
    ablation = bool(names & (set(ABLATION) - set(METHODS)))
    benchmark = bool(names & (set(METHODS) - set(ABLATION)))
    if ablation:
        return list(METHODS | ABLATION if benchmark else ABLATION)
    return list(METHODS)


def _collect(out: Path) -> None:
    """One CSV of all errors and one of all costs, from every job found in the folder.

    Raises ValueError if they are not all of one benchmark.
    """
    errors, costs = [], []
    rules: dict[str, Any] = {}

    systems, methods = list(SYSTEMS), _full_set(path.name for path in (out / "jobs").glob("*/*"))  # then the user's

    def position(folder: Path) -> tuple[int, str, int, str]:
        system, method = folder.parent.name, folder.name
        first = systems.index(system) if system in systems else len(systems)
        second = methods.index(method) if method in methods else len(methods)
        return first, system, second, method

    for folder in sorted((path.parent for path in (out / "jobs").glob("*/*/errors.csv")), key=position):
        errors.append(pd.read_csv(folder / "errors.csv"))
        info, job = (json.loads((folder / file).read_text()) for file in ("info.json", "job.json"))
        for rule in ("budget", "protocol", "search", "validation", "seed", "version"):
            if rules.setdefault(rule, job[rule]) != job[rule]:
                raise ValueError(
                    f"{out} holds jobs of several benchmarks: {rule} = {job[rule]} in {folder}, "
                    f"{rules[rule]} elsewhere; remove the ones that do not belong there"
                )
        speed = folder / "speed.json"
        costs.append(
            {
                "system": folder.parent.name,
                "method": folder.name,
                "label": info["label"],
                "budget": job["budget"]["name"],
                "configuration": json.dumps(info["configuration"]),
                "validation": json.dumps(info["validation"]),
                "train_seconds": info["train_seconds"],
                **(json.loads(speed.read_text()) if speed.exists() else {"us_batch_1": None, "us_batch_1000": None}),
                "trajectories": info["trajectories"],
                "seed": job["protocol"]["seed"],
            }
        )
    write(out / "results.csv", pd.concat(errors).to_csv(index=False, float_format="%.4g"))
    write(out / "methods.csv", pd.DataFrame(costs).to_csv(index=False, float_format="%.4g"))


def _report(out: Path, console: Console) -> None:
    """Table and figure from the CSV files."""
    for name in ("results.csv", "methods.csv"):
        if not (out / name).exists():
            raise ValueError(f"{out / name} does not exist; run the benchmark first")
    results, methods = pd.read_csv(out / "results.csv"), pd.read_csv(out / "methods.csv")
    note = f"Budget {methods.budget[0]}, seed {methods.seed[0]}, {methods.trajectories.max()} trajectories a case."
    partial, missing = _missing(methods)
    write_table(out / "table.md", results, methods, note=note + partial + missing)
    draw(out / "heatmap.png", results, methods, note=note + partial)
    console.print(f"wrote results.csv, methods.csv, table.md and heatmap.png in {out}. {note}{partial}{missing}")


def _missing(methods: pd.DataFrame) -> tuple[str, str]:
    """How many observers there are of a full set, the user's included, and which are not; empty if all are there."""
    systems = dict.fromkeys([*SYSTEMS, *methods.system])
    names = dict.fromkeys([*_full_set(methods.method), *methods.method])
    there = set(zip(methods.system, methods.method, strict=True))
    missing = {name: [system for system in systems if (system, name) not in there] for name in names}
    few = [name if len(on) == len(systems) else f"{name} on {', '.join(on)}" for name, on in missing.items() if on]
    if not few:
        return "", ""
    more = f" and {len(few) - NAMED} more methods" if len(few) > NAMED else ""
    return (
        f" Partial: {len(there)} of {len(systems) * len(names)} observers.",
        f" Missing: {'; '.join(few[:NAMED])}{more}.",
    )


__all__ = ["Benchmark"]
