"""``kkl-gym evaluate``."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from observers import Artifact
from training.commands.coverage import coverage_table, default_levels, judged
from training.commands.faults import fault_table
from training.commands.options import (
    NoiseLevels,
    Observers,
    OwnPolicy,
    OwnSystem,
    Plant,
    Seconds,
    merged,
    read_observers,
    read_policy,
    system_of,
)
from training.evaluation.errors import (
    Domain,
    NoStartsError,
    UnseenTrajectories,
    errors,
    unseen_trajectories,
)
from training.evaluation.levels import Level, as_cell, beyond, level_for, show_level
from training.evaluation.metrics import by_state
from training.evaluation.plants import off_by, parameter_errors, show_parameters, show_ranges
from training.files import require_writable, write
from training.progress import ProgressBars, progress_bars

CASES: tuple[tuple[str, Domain, bool], ...] = (("X", "X", False), ("2X \\ X", "2X", False), ("X", "X", True))
SKIPPED = 5.0  # seconds of driven runs at the pace of the shipped systems, half of the run at most

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Motions:
    """Which motions of which plant are estimated. The observer keeps its model, whichever plant moves."""

    trajectories: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 100, with --faults 500)")] = None
    """Number of trajectories from each domain."""
    duration: Seconds = None
    """Length of each trajectory in seconds; 50 for the systems that ship."""
    seed: int = 0
    """Seed of the trajectories and the noise; no seed gives any that training draws."""
    process_noise: float = 0.0
    """Level of the process noise, in multiples of the system's scale per second; the environments' default is 0.05."""
    plant: Plant = ()
    """Parameters of the plant that moves, such as mu=3.3."""
    plant_error: Annotated[float | None, tyro.conf.arg(metavar="SHARE", help_behavior_hint="(default: none)")] = None
    """In place of --plant: by what share every parameter of the plant is larger than the observer's; 0.1 is 10 %."""

    def plant_of(self, system: System) -> System | None:
        """The plant, where it is not the system."""
        changes = merged("--plant", self.plant)
        if self.plant_error is None:
            return system.replace(changes) if changes else None
        if changes:
            raise ValueError("give --plant or --plant-error, not both")
        return off_by(system, self.plant_error)


@dataclass(frozen=True)
class Subject:
    """An observer, its model, the plant where it is another one, and the duration if it is not the system's."""

    name: str
    artifact: Artifact
    system: System
    plant: System | None
    seconds: float | None

    @property
    def duration(self) -> float:
        """Seconds of a trajectory."""
        return self.system.duration if self.seconds is None else self.seconds

    @property
    def on(self) -> str:
        """The plant, for titles."""
        return f", plant {show_parameters(self.plant)}" if self.plant else ""


@dataclass(frozen=True)
class Evaluate:
    """Measure observers on unseen trajectories: errors, coverage of error bars, or how soon faults are noticed.

    Errors are measured from starts in X and in 2X without X, with and without noise. SMAPE, in percent, is of the norm
    of all states, over all steps (the paper's measure) and after the transient. NRMSE is the root mean square error of
    each state after the transient, in percent of its standard deviation. The transient is the first fifth of a run, or
    5 s where random steps and sines drive it (of systems of another pace, 500 samples).

    2X is cut at the system's declared bounds. Trajectories that leave these are counted, and left out. A level of noise
    beyond a map's range is left out. Under a policy, driven runs are those in which it errs about the state and
    explores; in the others its inputs give the state away to an observer that has learned the policy.

    --calibration: how many errors lie in the regions of 50, 90 and 99 % of the covariances, of all states and of each,
    and their mean normalised square (NEES), at six levels of noise.

    --faults: from the middle of each run the sensor is biased by a fifth of the output's range, or dead (y = 0), or
    frozen at its last value. Half of the runs are driven, if the observer takes inputs. A fault should be noticed
    within a time that is chosen for each shipped system, and is a fifth of the duration for others.
    """

    observers: Observers
    """Shipped maps, or .safetensors files."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    measurement_noise: NoiseLevels = None
    """Standard deviations of the noise on each sample of y, a table row for each. 0.1,0.3 is one for each output."""
    ekf: bool = False
    """Beside each observer, an extended Kalman filter that knows the equations, the inputs and the levels of noise.
    On another plant it knows those of the observer's model."""
    no_tracking: bool = False
    """T_inv alone of observers that track."""
    calibration: bool = False
    """In place of errors: coverage of the error bars."""
    faults: bool = False
    """In place of errors: how soon the monitor notices faults of the sensor."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """File to which the results of each trajectory are written as well."""
    motions: tyro.conf.OmitArgPrefixes[Motions] = field(default_factory=Motions)

    def run(self, console: Console) -> "pd.DataFrame":
        """Evaluate."""
        import pandas as pd  # which takes half a second that help need not wait for

        self._check()
        frames: list[pd.DataFrame] = []
        subjects = [
            Subject(*of, self.motions.plant_of(of[-1]), self.motions.duration)
            for of in read_observers(self.observers, self.system)
        ]
        judge = self._faults if self.faults else self._coverage if self.calibration else self._errors
        with progress_bars(console) as progress:
            for subject in subjects:
                if self.no_tracking and subject.artifact.motion is not None:
                    alone = replace(subject.artifact, motion=None)
                    subject = replace(subject, name=f"{subject.name}, T_inv alone", artifact=alone)
                left_out: list[str] = []
                frames += judge(subject, progress, left_out)
                for reason in left_out:
                    progress.say(f"{subject.name}, left out: {reason}")
        if not frames:
            raise ValueError(f"nothing is left to evaluate of {', '.join(self.observers)}: the lines above say why")
        results = pd.concat(frames, ignore_index=True)
        if self.faults:
            console.print(fault_table(results))
        if self.csv:
            write(self.csv, results.to_csv(index=False, float_format="%.6g"))
            console.print(f"wrote {self.csv}")
        return results

    def _check(self) -> None:
        """Raise an error for options that make no sense, before any work."""
        levels = self.measurement_noise
        if levels is not None and not levels:
            raise ValueError("give at least one level of measurement noise; 0 is none")
        if self.csv is not None:
            if self.csv.is_dir() or not self.csv.name:
                raise ValueError(f"csv = {self.csv} is a folder: name a file")
            require_writable(self.csv.parent)
        if self.faults:
            others = ("calibration", "ekf", "no_tracking"), ("plant", "plant_error", "process_noise")
            given = [name for of, names in zip((self, self.motions), others, strict=True) for name in names
                     if getattr(of, name)]  # fmt: skip
            if given:
                raise ValueError(f"--{given[0].replace('_', '-')}: of no use with --faults")
            if levels is not None and len(levels) > 1:
                raise ValueError(f"--faults takes one level of measurement noise, got {len(levels)}")
            if len({*self.observers}) < len(self.observers):
                raise ValueError(f"name each observer once, got {', '.join(self.observers)}")

    def _errors(self, of: Subject, progress: ProgressBars, left_out: list[str]) -> list["pd.DataFrame"]:
        """Print tables of errors; rows of the CSV file."""
        import pandas as pd

        process_noise = self.motions.process_noise
        on = f"{of.on}, model {show_parameters(of.system)}" if of.plant else ""
        smape = self._table(f"{of.name}: SMAPE in %, median (IQR) of {self._runs(of)}{on}", of.artifact)
        if of.artifact.parameter_ranges:
            smape.caption = f"trained for {show_ranges(of.artifact)}"
        nrmse = self._table(f"{of.name}: NRMSE in % after transient, median{on}", of.artifact)
        for table, measures in ((smape, ("all steps", "after transient", "escaped")), (nrmse, of.system.state_names)):
            for measure in measures:
                table.add_column(measure, justify="right")
        frames = []
        everyone: dict[str, Artifact | None] = {Path(of.name).stem if self.ekf else of.name: of.artifact}
        if self.ekf:
            everyone["EKF, same model" if of.plant else "exact EKF"] = None
        levels = self._levels(of, left_out)
        for starts, driven, trajectories, level in self._cases(f"evaluating {of.name}", of, levels, progress, left_out):
            skip = min(SKIPPED * of.system.pace, of.duration / 2) if driven else None
            for estimator, one in everyone.items():
                found = errors(one, of.system, trajectories, measurement_noise=level, seed=self.motions.seed, skip=skip)
                case = [*([estimator] if self.ekf else []), starts]
                case += [*(["yes" if driven else "no"] if of.artifact.nu else [])]
                case += [*([f"{process_noise:g}"] if process_noise else []), show_level(level)]
                smape.add_row(*case, spread(found.full), spread(found.late), str(found.escaped))
                nrmse.add_row(*case, *map(percent, np.median(found.nrmse, axis=0)))
                columns = {
                    "observer": estimator,
                    **({"plant": show_parameters(of.plant)} if of.plant else {}),
                    "starts": starts,
                    "driven": driven,
                    "process_noise": process_noise,
                    "measurement_noise": as_cell(level),
                    "trajectory": np.arange(len(found.full)),
                    "smape": found.full,
                    "smape_late": found.late,
                    **by_state(found.nrmse),
                }
                frames.append(pd.DataFrame(columns))
        if frames:
            progress.console.print(smape, nrmse)
            if of.artifact.estimated_parameters:
                with progress.phase("estimating parameters"):
                    table = self._parameters(of, levels)
                progress.console.print(table)
        return frames

    def _coverage(self, of: Subject, progress: ProgressBars, left_out: list[str]) -> list["pd.DataFrame"]:
        """Print the coverage of error bars; rows of the CSV file."""
        import pandas as pd

        of.artifact.require_covariance()
        levels = default_levels(of.artifact) if self.measurement_noise is None else self._levels(of, left_out)
        rows: list[dict[str, Any]] = []
        cases = self._cases(f"judging the error bars of {of.name}", of, levels, progress, left_out)
        for starts, driven, trajectories, level in cases:
            spans = judged(of.artifact, of.system, trajectories, level=level, seed=self.motions.seed, ekf=self.ekf)
            rows += [{"map": of.name, "starts": starts, "driven": driven, **row} for row in spans]
        if not rows:
            return []
        title = f"{of.name}: errors in regions, %, {self._runs(of)}{of.on}"
        progress.console.print(coverage_table(title, pd.DataFrame(rows)))
        return [pd.DataFrame(rows)]

    def _faults(self, of: Subject, progress: ProgressBars, left_out: list[str]) -> list["pd.DataFrame"]:
        """Break an observer's sensor; rows of the CSV file."""
        from training.evaluation.faults import PARTS, simulate_faults

        level = level_for(of.artifact, of.system, self.measurement_noise[0] if self.measurement_noise else None)
        if reason := beyond(of.artifact, level):
            left_out.append(reason)
            return []
        with progress.phase(f"breaking the sensor of {of.name}", PARTS) as report:
            runs = simulate_faults(
                of.artifact,
                of.system,
                trajectories=self._trajectories,
                duration=of.duration,
                measurement_noise=level,
                seed=self.motions.seed,
                policy=read_policy(of.artifact, system_of(of.artifact, self.system), self.policy),
                report=report,
            )
        runs.insert(0, "observer", of.name)
        return [runs]

    def _parameters(self, of: Subject, levels: Sequence[Level]) -> Table:
        """A table of errors of estimated parameters, from starts in X."""
        on = f"plant {show_parameters(of.plant)}" if of.plant else "plants drawn from their ranges"
        table = Table(title=f"{of.name}: parameters, rms error in % of their values after transient, {on}")
        for column in (*(["driven"] if of.artifact.nu else []), "noise\non y", *of.artifact.estimated_parameters):
            table.add_column(column, justify="right")
        for driven in (False, True)[: 2 if of.artifact.nu else 1]:
            for level in levels:
                found = parameter_errors(
                    of.artifact,
                    of.system,
                    trajectories=self._trajectories,
                    measurement_noise=level,
                    **self._how(of, driven),
                )
                table.add_row(
                    *(["yes" if driven else "no"] if of.artifact.nu else []), show_level(level), *map(percent, found)
                )
        return table

    def _cases(
        self, description: str, of: Subject, levels: Sequence[Level], progress: ProgressBars, left_out: list[str]
    ) -> Iterator[tuple[str, bool, UnseenTrajectories, Level]]:
        """Yield where trajectories start, whether they are driven, the trajectories and each level of noise.

        Starts without trajectories are described in ``left_out``.
        """
        cases = CASES[: 3 if of.artifact.nu else 2] if levels else ()
        bar = progress.add_task(description, total=len(cases) * len(levels))
        for starts, domain, driven in cases:
            try:
                trajectories = unseen_trajectories(
                    of.system, of.artifact.filter.dt, n=self._trajectories, domain=domain, **self._how(of, driven)
                )
                lacking = f"each of {self._trajectories} runs left bounds = {of.system.bounds}"
            except NoStartsError as error:
                trajectories, lacking = None, str(error)
            if trajectories is None or not trajectories.inside.any():
                left_out.append(f"starts in {starts}{', driven' if driven else ''}: {lacking}")
                progress.advance(bar, len(levels))
                continue
            for level in levels:
                yield starts, driven, trajectories, level
                progress.advance(bar)

    def _how(self, of: Subject, driven: bool) -> dict[str, Any]:
        """How trajectories are simulated."""
        return {
            "duration": of.duration,
            "seed": self.motions.seed,
            "driven": driven,
            "process_noise": self.motions.process_noise,
            "policy": read_policy(of.artifact, system_of(of.artifact, self.system), self.policy),
            "plant": of.plant,
        }

    def _levels(self, of: Subject, left_out: list[str]) -> list[Level]:
        """Levels of measurement noise that a map can be given; the others are described in ``left_out``."""
        if self.measurement_noise is None:
            return list(dict.fromkeys([0.0, level_for(of.artifact, of.system)]))
        levels = [level_for(of.artifact, of.system, level) for level in self.measurement_noise]
        left_out += [reason for level in levels if (reason := beyond(of.artifact, level))]
        return [level for level in levels if not beyond(of.artifact, level)]

    def _table(self, title: str, artifact: Artifact) -> Table:
        """A table with the columns that name the case of a row."""
        table = Table(title=title)
        for column in ("observer",) * self.ekf + ("starts",) + ("driven",) * bool(artifact.nu):
            table.add_column(column)
        for column in ("process\nnoise",) * bool(self.motions.process_noise) + ("noise\non y",):
            table.add_column(column, justify="right")
        return table

    @property
    def _trajectories(self) -> int:
        default = 500 if self.faults else 100
        return default if self.motions.trajectories is None else self.motions.trajectories

    def _runs(self, of: Subject) -> str:
        return f"{self._trajectories} runs of {of.duration:g} s"


def spread(values: np.ndarray) -> str:
    """Median and interquartile range as text."""
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{median:.2f} ({low:.2f} – {high:.2f})"


def percent(value: float) -> str:
    """An NRMSE as text; NaN is that of a state that does not move."""
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.2f}"
