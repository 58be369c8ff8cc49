"""``kkl-gym evaluate``."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from observers import Artifact
from observers.storage import require_writable, write
from training.commands.coverage import coverage_table, default_levels, judged
from training.commands.options import (
    NoiseLevels,
    Observers,
    OwnPolicy,
    OwnSystem,
    RepeatedParameters,
    Seconds,
    read_observers,
    read_policy,
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
from training.progress import ProgressBars, progress_bars

CASES: tuple[tuple[str, Domain, bool], ...] = (("X", "X", False), ("2X \\ X", "2X", False), ("X", "X", True))
SKIPPED = 5.0  # seconds of driven runs at the pace of the shipped systems, half of the run at most

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Evaluate:
    """Print observers' errors on unseen trajectories: in X and in 2X without X, with and without noise.

    SMAPE in percent, median and interquartile range over the trajectories, over all steps (the paper's measure) and
    after the transient. That is the first fifth of a run, or 5 s where it is driven by random steps and sines (of
    systems of another pace, 500 samples). A second table has the NRMSE of each state after the transient, the median
    over the trajectories: its root mean square error in percent of its standard deviation over all of them. SMAPE is of
    one norm of all states, which says little where their units differ.

    2X is cut at the system's declared bounds. Trajectories that leave these are counted, and left out. Observers are
    told the levels of noise if they can use them; a level beyond a map's range is left out. The column "driven" is
    there for observers that take inputs, "process noise" where there is any; the CSV file always has both.
    Under a policy, those are driven in which it errs about the state and explores; in the others its inputs tell the
    state to an observer that has learned the policy.

    Of an observer that estimates parameters, a third table has their errors: root mean squares over plants that are
    drawn from the ranges of its training, over time, and from starts in X.

    The trajectories are those of the system that the observer was made for, or of a plant with other parameters, by
    --plant or --plant-error. Observer and Kalman filter know nothing of that, and keep their own. Starts, policy,
    inputs and levels of noise are as without.
    """

    observers: Observers
    """Shipped maps, or .safetensors files."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    measurement_noise: NoiseLevels = None
    """Standard deviations of the noise on each sample of y, a table row for each. 0.1,0.3 is one for each output."""
    process_noise: float = 0.0
    """Level of the process noise, in multiples of the system's scale per second; the environments' default is 0.05."""
    plant: Annotated[RepeatedParameters, tyro.conf.arg(help_behavior_hint="(default: the observer's own)")] = ()
    """A parameter of the plant that moves, such as mu=3.3; may be given several times."""
    plant_error: Annotated[float | None, tyro.conf.arg(metavar="SHARE", help_behavior_hint="(default: none)")] = None
    """In place of --plant: by what share every parameter of the plant is larger than the observer's; 0.1 is 10 %."""
    trajectories: int = 100
    """Number of trajectories from each domain."""
    duration: Seconds = None
    """Length of each trajectory in seconds; 50 for the systems that ship."""
    seed: int = 0
    """Seed of the trajectories and the noise; no seed gives any that training draws."""
    ekf: bool = False
    """Beside each observer, an extended Kalman filter that knows the equations, the inputs and the levels of noise.
    On another plant it knows those of the observer's model."""
    no_tracking: tyro.conf.FlagCreatePairsOff[bool] = False
    """Evaluate T_inv alone of observers that track. "NAME, T_inv alone" then stands for each."""
    calibration: bool = False
    """In place of errors, say whether error bars are true: how many errors lie in regions of 50, 90 and 99 %, of all
    states and of each, and the mean of their normalised squares (NEES); by default at six levels of noise."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: no file)")] = None
    """File to which the errors of each trajectory are written as well."""

    def run(self, console: Console) -> "pd.DataFrame":
        """Evaluate."""
        import pandas as pd  # which takes half a second that help need not wait for

        if self.measurement_noise is not None and not self.measurement_noise:
            raise ValueError("give at least one level of measurement noise; 0 is none")
        if self.csv is not None and (self.csv.is_dir() or not self.csv.name):
            raise ValueError(f"csv = {self.csv} is a folder: name a file")
        if self.csv is not None:
            require_writable(self.csv.parent)
        frames: list[pd.DataFrame] = []
        observers = [(*found, self._plant(found[-1])) for found in read_observers(self.observers, self.system)]
        with progress_bars(console) as progress:
            for name, artifact, system, plant in observers:
                if self.no_tracking and artifact.motion is not None:
                    name, artifact = f"{name}, T_inv alone", replace(artifact, motion=None)
                judge = self._calibration if self.calibration else self._evaluate
                frames += judge(name, artifact, system, plant, progress)
        if not frames:
            raise ValueError(f"nothing is left to evaluate of {', '.join(self.observers)}: the lines above say why")
        found = pd.concat(frames, ignore_index=True)
        if self.csv:
            write(self.csv, found.to_csv(index=False, float_format="%.6g"))
            console.print(f"wrote {self.csv}")
        return found

    def _plant(self, system: System) -> System | None:
        """What moves, where it is not the system; ValueError if the options make no sense."""
        changes = dict(self.plant)
        if self.plant and self.plant_error is not None:
            raise ValueError("give --plant or --plant-error, not both")
        if len(changes) < len(self.plant):
            raise ValueError(f"--plant names a parameter twice: {', '.join(name for name, _ in self.plant)}")
        if self.plant_error is not None:
            return off_by(system, self.plant_error)
        return system.replace(changes) if changes else None

    def _evaluate(
        self, name: str, artifact: Artifact, system: System, plant: System | None, progress: ProgressBars
    ) -> list["pd.DataFrame"]:
        """Print an observer's tables, and what is left out of them; rows of the CSV file."""
        import pandas as pd

        duration = system.duration if self.duration is None else self.duration
        on = f", plant {show_parameters(plant)}, model {show_parameters(system)}" if plant else ""
        runs = f"{self.trajectories} runs of {duration:g} s"
        smape = self._table(f"{name}: SMAPE in %, median (IQR) of {runs}{on}", artifact)
        if artifact.parameter_ranges:
            smape.caption = f"trained for {show_ranges(artifact)}"
        nrmse = self._table(f"{name}: NRMSE in % after transient, median{on}", artifact)
        for table, measures in ((smape, ("all steps", "after transient", "escaped")), (nrmse, system.state_names)):
            for measure in measures:
                table.add_column(measure, justify="right")
        frames = []
        shown = Path(name).stem if self.ekf else name
        everyone: dict[str, Artifact | None] = {shown: artifact}
        if self.ekf:
            everyone["EKF, same model" if plant else "exact EKF"] = None
        levels, left_out = self._levels(artifact, system)
        cases = self._cases(f"evaluating {name}", artifact, system, plant, levels, progress, left_out)
        for starts, driven, trajectories, level in cases:
            skip = min(SKIPPED * system.pace, duration / 2) if driven else None
            for who, one in everyone.items():
                found = errors(one, system, trajectories, measurement_noise=level, seed=self.seed, skip=skip)
                case = [*([who] if self.ekf else []), starts, *(["yes" if driven else "no"] if artifact.nu else [])]
                case += [*([f"{self.process_noise:g}"] if self.process_noise else []), show_level(level)]
                smape.add_row(*case, spread(found.full), spread(found.late), str(found.escaped))
                nrmse.add_row(*case, *map(percent, np.median(found.nrmse, axis=0)))
                columns = {
                    "observer": who,
                    **({"plant": show_parameters(plant)} if plant else {}),
                    "starts": starts,
                    "driven": driven,
                    "process_noise": self.process_noise,
                    "measurement_noise": as_cell(level),
                    "trajectory": np.arange(len(found.full)),
                    "smape": found.full,
                    "smape_late": found.late,
                    **by_state(found.nrmse),
                }
                frames.append(pd.DataFrame(columns))
        if frames:
            progress.console.print(smape, nrmse)
            if artifact.estimated_parameters:
                with progress.phase("estimating parameters"):
                    table = self._parameters(name, artifact, system, plant, levels)
                progress.console.print(table)
        for reason in left_out:
            progress.say(f"{name}, left out: {reason}")
        return frames

    def _calibration(
        self, name: str, artifact: Artifact, system: System, plant: System | None, progress: ProgressBars
    ) -> list["pd.DataFrame"]:
        """Print whether an observer's error bars are true; rows of the CSV file."""
        import pandas as pd

        artifact.require_covariance()
        duration = system.duration if self.duration is None else self.duration
        on = f", plant {show_parameters(plant)}" if plant else ""
        levels, left_out = self._levels(artifact, system)
        if self.measurement_noise is None:
            levels = default_levels(artifact)
        rows: list[dict[str, Any]] = []
        cases = self._cases(f"judging the error bars of {name}", artifact, system, plant, levels, progress, left_out)
        for starts, driven, trajectories, level in cases:
            found = judged(artifact, system, trajectories, level=level, seed=self.seed, ekf=self.ekf)
            rows += [{"map": name, "starts": starts, "driven": driven, **row} for row in found]
        for reason in left_out:
            progress.say(f"{name}, left out: {reason}")
        if not rows:
            return []
        title = f"{name}: errors in regions, %, {self.trajectories} runs of {duration:g} s{on}"
        progress.console.print(coverage_table(title, pd.DataFrame(rows)))
        return [pd.DataFrame(rows)]

    def _parameters(
        self,
        name: str,
        artifact: Artifact,
        system: System,
        plant: System | None,
        levels: Sequence[Level],
    ) -> Table:
        """A table of errors of estimated parameters, from starts in X."""
        on = f"plant {show_parameters(plant)}" if plant else "plants drawn from their ranges"
        table = Table(title=f"{name}: parameters, rms error in % of their values after transient, {on}")
        for column in (*(["driven"] if artifact.nu else []), "noise\non y", *artifact.estimated_parameters):
            table.add_column(column, justify="right")
        for driven in (False, True)[: 2 if artifact.nu else 1]:
            for level in levels:
                found = parameter_errors(
                    artifact,
                    system,
                    trajectories=self.trajectories,
                    duration=system.duration if self.duration is None else self.duration,
                    measurement_noise=level,
                    seed=self.seed,
                    process_noise=self.process_noise,
                    driven=driven,
                    policy=read_policy(artifact, system, self.policy),
                    plant=plant,
                )
                table.add_row(
                    *(["yes" if driven else "no"] if artifact.nu else []), show_level(level), *map(percent, found)
                )
        return table

    def _cases(
        self,
        description: str,
        artifact: Artifact,
        system: System,
        plant: System | None,
        levels: Sequence[Level],
        progress: ProgressBars,
        left_out: list[str],
    ) -> Iterator[tuple[str, bool, UnseenTrajectories, Level]]:
        """Yield where trajectories start, whether they are driven, the trajectories and each level of noise.

        Starts without trajectories are described in ``left_out``.
        """
        policy = read_policy(artifact, system, self.policy)
        cases = CASES[: 3 if artifact.nu else 2] if levels else ()
        bar = progress.add_task(description, total=len(cases) * len(levels))
        for starts, domain, driven in cases:
            try:
                trajectories = unseen_trajectories(
                    system,
                    artifact.filter.dt,
                    n=self.trajectories,
                    duration=system.duration if self.duration is None else self.duration,
                    seed=self.seed,
                    domain=domain,
                    driven=driven,
                    process_noise=self.process_noise,
                    policy=policy,
                    plant=plant,
                )
                lacking = f"each of {self.trajectories} runs left bounds = {system.bounds}"
            except NoStartsError as error:
                trajectories, lacking = None, str(error)
            if trajectories is None or not trajectories.inside.any():
                left_out.append(f"starts in {starts}{', driven' if driven else ''}: {lacking}")
                progress.advance(bar, len(levels))
                continue
            for level in levels:
                yield starts, driven, trajectories, level
                progress.advance(bar)

    def _levels(self, artifact: Artifact, system: System) -> tuple[list[Level], list[str]]:
        """Levels of measurement noise that a map can be told, and what is to be said of the others."""
        if self.measurement_noise is None:
            return list(dict.fromkeys([0.0, level_for(artifact, system)])), []
        levels = [level_for(artifact, system, level) for level in self.measurement_noise]
        reasons = [beyond(artifact, level) for level in levels]
        inside = [level for level, reason in zip(levels, reasons, strict=True) if not reason]
        return inside, [reason for reason in reasons if reason]

    def _table(self, title: str, artifact: Artifact) -> Table:
        """A table with the columns that say of what a row is."""
        table = Table(title=title)
        if self.ekf:
            table.add_column("observer")
        table.add_column("starts")
        if artifact.nu:
            table.add_column("driven")
        if self.process_noise:
            table.add_column("process\nnoise", justify="right")
        table.add_column("noise\non y", justify="right")
        return table


def spread(values: np.ndarray) -> str:
    """Median and interquartile range as text."""
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{median:.2f} ({low:.2f} – {high:.2f})"


def percent(value: float) -> str:
    """An NRMSE as text; NaN is that of a state that does not move."""
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.2f}"
