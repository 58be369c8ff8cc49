"""``python -m examples.research benchmark``."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from examples.research.resumable import Workers, check_failures, run_job, run_missing
from kkl_gym.systems import SYSTEMS, get_system
from observers.checks import noise_levels
from training.commands.options import NoiseLevels
from training.evaluation.levels import multiple, show_level
from training.files import clear_unfinished
from training.progress import LOG, progress_bars
from training.seeds import Stream, generator

if TYPE_CHECKING:
    from examples.research.benchmark.jobs import Training


@dataclass(frozen=True)
class Benchmark:
    """Compare observers: train every method on every system, and evaluate all on the same unseen trajectories.

    Writes OUT/results.csv (a row for each trajectory), OUT/methods.csv (the cost of each method), OUT/table.md and
    OUT/heatmap.png. Each method on each system is a job whose folder under OUT/jobs holds the trained observer. After
    an interruption, the same command continues.
    """

    budget: Literal["short", "cpu"] = "cpu"
    """cpu: 400,000 samples and 300 CPU seconds for each training. short: 200,000 samples and 40 CPU seconds."""
    quick: bool = False
    """Ignore the budget: train only each method's first configuration, on 300 batches, and test on few and short
    trajectories. This takes minutes, and gives the same results each time."""
    systems: tuple[str, ...] = tuple(SYSTEMS)
    """Shipped systems, or your own as script.py:Class or module:Class."""
    methods: Annotated[tuple[str, ...] | None, tyro.conf.arg(help_behavior_hint="(default: the first nine)")] = None
    """default, spinn, node, node-noise, gru, lru, transformer, ekf, ukf; the maps that ship: shipped,
    shipped-spinn, shipped-large; or your own classes as script.py:Class or module:Class."""
    measurement_noise: NoiseLevels = None
    """Standard deviations of the noise on y. Each is one number for all outputs, or one for each as in 0.1,0.3."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: runs/benchmark/BUDGET)")] = None
    """Folder of results."""
    workers: tyro.conf.OmitArgPrefixes[Workers] = field(default_factory=Workers)
    seed: int = 0
    """Seed of the test trajectories. Trainings always have seed 0."""
    beside: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: nothing)")] = None
    """Folder with results.csv and methods.csv of the same benchmark, such as docs/results/benchmark. The tables then
    include the observers that only this folder has, without training them again."""
    report: bool = False
    """Only write the table and the figure again, from OUT/results.csv and OUT/methods.csv."""

    def run(self, console: Console) -> Path:
        """Run the missing jobs, then report."""
        from examples.research.benchmark.results import check_results, collect, report  # imports pandas, which is slow

        name = "quick" if self.quick else self.budget
        out = self.out or Path("runs") / "benchmark" / name
        if self.beside is not None:
            check_results(self.beside)
        clear_unfinished(out)
        with progress_bars(console, out / LOG) as progress:
            jobs, trained, failures = list["Training"](), list["Training"](), list[str]()
            if not self.report:
                jobs = self.jobs(name, out)
                failures = run_missing(run_job, jobs, workers=self.workers, what="observers", progress=progress)
                trained = [job for job in jobs if job.done]
                for job in progress.track(trained, description="timing steps"):
                    try:
                        job.time_steps()
                    except Exception as error:  # one method failed; the others continue
                        failures.append(f"{job.name}, timing: {error}")
                if trained:
                    collect(out, self.beside)
            if self.report or trained:
                with progress.phase("drawing the table and the figure"):
                    report(out)
                progress.say(f"wrote results.csv, methods.csv, table.md and heatmap.png in {out}")
        check_failures(failures, jobs, "observers")
        return out

    def jobs(self, name: str, out: Path) -> "list[Training]":
        """Make the jobs of a budget; ValueError if an option is invalid."""
        from examples.research.benchmark import budgets  # imported here, so that --help does not wait for torch
        from examples.research.benchmark.jobs import Training
        from examples.research.methods import METHODS, get_method

        methods, levels = tuple(METHODS) if self.methods is None else self.methods, self.measurement_noise
        if not self.systems or not methods or levels == ():
            raise ValueError("give at least one system, method and noise level")
        generator(Stream.EVALUATION, self.seed)  # raises for an invalid seed before any training
        named = [[get_system(name).name for name in self.systems], [get_method(name).name for name in methods]]
        for names in (*named, [show_level(level) for level in levels or ()]):
            if len(set(names)) < len(names):
                raise ValueError(f"name each system, method and noise level once, got {names}")
        protocol = replace(budgets.QUICK_PROTOCOL if self.quick else budgets.PROTOCOL, seed=self.seed)
        budget = budgets.BUDGETS[name]
        search = None if self.quick else budgets.SEARCH * budget.cpu_seconds
        jobs = []
        for given in self.systems:
            system = get_system(given)
            noise = tuple(noise_levels("measurement_noise", level, system.ny) for level in levels or ())
            noise = noise or tuple(dict.fromkeys([0.0, multiple(system, 1.0)]))
            for method in methods:
                contender = get_method(method)
                job = Training(
                    system=given,
                    method=method,
                    folder=out / "jobs" / system.name / contender.name,
                    budget=budgets.paced_budget(budget, system),
                    protocol=replace(budgets.paced_protocol(protocol, system), measurement_noise=noise),
                    search=search,
                    validation=replace(budgets.paced_protocol(budgets.VALIDATION, system), measurement_noise=noise),
                )
                jobs.append(job)
        return jobs
