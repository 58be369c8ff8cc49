"""``kkl-gym evaluate``."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Column, Table

from kkl_gym.system import System
from observers import Artifact
from training.commands.options import (
    NO_FILE,
    NoiseLevels,
    Observers,
    OwnPolicy,
    OwnSystem,
    Plant,
    Seconds,
    hint,
    merged,
    model_of,
    read_observers,
    read_policy,
)
from training.evaluation.coverage import REGIONS, coverage
from training.evaluation.errors import (
    Domain,
    Errors,
    NoStartsError,
    UnseenTrajectories,
    errors,
    noise_limit,
    parameter_errors,
    unseen_trajectories,
)
from training.evaluation.levels import Level, as_cell, beyond, level_for, show_level
from training.evaluation.metrics import by_state
from training.files import require_writable, write
from training.progress import ProgressBars, progress_bars
from training.trajectories.motions import Controller
from training.trajectories.parameters import blind, with_parameters

if TYPE_CHECKING:
    import pandas as pd

CASES: tuple[tuple[str, Domain, bool], ...] = (("X", "X", False), ("2X \\ X", "2X", False), ("X", "X", True))
SKIPPED = 5.0  # transient of driven runs, in units of System.pace; at most half of a run
FIRST, SETTLED = 2.0, 5.0  # error bars are evaluated before FIRST and after SETTLED, in units of System.pace
SHARES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)  # noise levels for error bars, as shares of the largest in a map's training
FAULTS_HEADER = ("false alarms", "fault", "within", "noticed in time", "median delay in s", "95 %")


@dataclass(frozen=True)
class Motions:
    """Options of the trajectories and of their plant, which may differ from the observer's model."""

    trajectories: Annotated[int | None, hint("100, or 500 with --faults")] = None
    """Number of trajectories from each region of starts."""
    duration: Seconds = None
    """Length of each trajectory in seconds; 50 for the systems that ship."""
    seed: int = 0
    """Seed of the trajectories and the noise. They differ from those of every training."""
    process_noise: float = 0.0
    """Level of the process noise, in multiples of the system's scale per second. Shipped environments have 0.05."""
    plant: Plant = ()
    """Parameters of the simulated plant, such as mu=3.3. The observer keeps its model."""
    plant_error: Annotated[float | None, hint("none", metavar="SHARE")] = None
    """Instead of --plant: share by which each parameter of the plant exceeds the observer's; 0.1 is 10 %."""

    def plant_of(self, system: System) -> System | None:
        """Return the plant, or None if the plant is the system itself."""
        changes = merged("--plant", self.plant)
        if self.plant_error is None:
            return system.replace(changes) if changes else None
        if changes:
            raise ValueError("give --plant or --plant-error, not both")
        if not np.isfinite(self.plant_error):
            raise ValueError(f"plant_error must be a finite number, such as 0.1, got {self.plant_error}")
        if not system.parameters:
            raise ValueError(f"{system.name} has no parameters that could be off: leave --plant-error out")
        return system.replace({name: (1.0 + self.plant_error) * value for name, value in system.parameters.items()})


@dataclass(frozen=True)
class Subject:
    """An observer, its system, its model (the system with any estimated bias), and the motions' plant and policy.

    ``plant`` is None if the plant is the system itself.
    """

    name: str
    artifact: Artifact
    system: System
    model: System
    plant: System | None
    duration: float
    policy: Controller | None

    @property
    def on(self) -> str:
        """Text on the plant for titles."""
        return f", plant {show_parameters(self.plant)}" if self.plant else ""

    def runs(self, **motions: Any) -> dict[str, Any]:
        """Return ``motions`` and the other arguments of :func:`training.unseen_trajectories`."""
        plant = self.plant and model_of(self.artifact, self.plant)
        return {"duration": self.duration, "policy": self.policy, "plant": plant, **motions}


@dataclass(frozen=True)
class Evaluate:
    """Evaluate observers on unseen trajectories: errors, coverage of error bars, or detection of faults.

    Trajectories start in X (the training box) and in 2X outside X, with and without noise. SMAPE, in percent, uses the
    norm of the whole state, over all steps (the paper's measure) and after the transient. SMAPE is relative
    to the state: near the state 0 it is large for every observer, as under noise in motions that come to rest there.
    NRMSE is the root mean square error of each state after the transient, in percent of the state's standard deviation
    over all steps of all trajectories. The transient is the first fifth of a run. In driven runs (by random
    steps and sines) it is the first 5 s (500 samples for your own systems).

    2X is cut at the system's declared bounds. Trajectories that leave the bounds are counted and left out; noise levels
    beyond a map's range are left out. A policy under which an observer was trained gives the inputs of all runs. In
    the runs that the tables call driven, the policy explores, and sees the state with errors. In the other runs it sees
    the exact state, so that its inputs tell the observer more about the state than the outputs do.

    --calibration: the shares of errors within the 50, 90 and 99 % regions of the covariances, for all states together
    and for each, and the mean normalised estimation error squared (NEES), at six noise levels.

    --faults: from the middle of each run the sensor is biased by a fifth of the output's range, dead (y = 0), or frozen
    at its last value. Half of the runs are driven, if the observer takes inputs; under a policy, all. The time in which
    the monitor should detect a fault is chosen for each shipped system, and is a fifth of the duration for others.
    """

    observers: Observers
    """Shipped maps, or .safetensors files."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    measurement_noise: NoiseLevels = None
    """Noise levels on y (standard deviations); each gives a table row. 0.1,0.3 has a value for each of two outputs."""
    ekf: bool = False
    """Also evaluate an extended Kalman filter that knows the inputs, the noise levels and the equations of the
    observer's model."""
    limit: bool = False
    """Also report, for starts in X, the least errors of any unbiased causal estimator under the noise (posterior
    Cramér-Rao bound of the plant's exact equations)."""
    no_tracking: bool = False
    """Evaluate T_inv alone, also for observers that track."""
    calibration: bool = False
    """Instead of errors, report the coverage of the error bars."""
    faults: bool = False
    """Instead of errors, report how soon the monitor detects sensor faults."""
    csv: Annotated[Path | None, NO_FILE] = None
    """File for the results of each trajectory; with --calibration, of each group of trajectories."""
    motions: tyro.conf.OmitArgPrefixes[Motions] = field(default_factory=Motions)

    def run(self, console: Console) -> "pd.DataFrame":
        """Evaluate the observers, and print the tables."""
        # Imported here, so that --help does not wait half a second.
        import pandas as pd

        self._check()
        frames: list[pd.DataFrame] = []
        subjects = [self._subject(*of) for of in read_observers(self.observers, self.system)]
        judge = self._faults if self.faults else self._coverage if self.calibration else self._errors
        with progress_bars(console) as progress:
            for subject in subjects:
                left_out: list[str] = []
                frames += judge(subject, progress, left_out)
                for reason in left_out:
                    progress.say(f"{subject.name}, left out: {reason}")
        if not frames:
            raise ValueError(f"there is nothing to evaluate for {', '.join(self.observers)}: see the lines above")
        results = pd.concat(frames, ignore_index=True)
        if self.faults:
            console.print(table("", [Column("observer", overflow="fold"), *FAULTS_HEADER], fault_rows(results)))
        if self.csv:
            write(self.csv, results.to_csv(index=False, float_format="%.6g"))
            console.print(f"wrote {self.csv}")
        return results

    def _check(self) -> None:
        """Raise ValueError for invalid options, before any work."""
        levels = self.measurement_noise
        if levels is not None and not levels:
            raise ValueError("give at least one level of measurement noise, such as 0")
        if self.csv is not None:
            if self.csv.is_dir() or not self.csv.name:
                raise ValueError(f"csv = {self.csv} is a folder: name a file")
            require_writable(self.csv.parent)
        refused = ("calibration", "ekf", "limit", "no_tracking", "plant", "plant_error", "process_noise")
        options = vars(self) | vars(self.motions)
        for kind, others in (("faults", refused), ("calibration", ("limit",))):
            if options[kind] and (given := [name for name in others if options[name]]):
                raise ValueError(f"--{given[0].replace('_', '-')}: of no use with --{kind}")
        if self.faults and levels is not None and len(levels) > 1:
            raise ValueError(f"--faults takes one level of measurement noise, got {len(levels)}")
        if self.faults and len({*self.observers}) < len(self.observers):
            raise ValueError(f"name each observer once, got {', '.join(self.observers)}")

    def _subject(self, name: str, artifact: Artifact, system: System) -> Subject:
        if self.no_tracking and artifact.motion is not None:
            name, artifact = f"{name}, T_inv alone", replace(artifact, motion=None)
        model, plant = model_of(artifact, system), self.motions.plant_of(system)
        duration = system.duration if self.motions.duration is None else self.motions.duration
        return Subject(name, artifact, system, model, plant, duration, read_policy(artifact, system, self.policy))

    def _errors(self, of: Subject, progress: ProgressBars, left_out: list[str]) -> list["pd.DataFrame"]:
        """Print tables of errors, and return the rows of the CSV file."""
        import pandas as pd

        process_noise, several, levels = self.motions.process_noise, self.ekf or self.limit, self._levels(of, left_out)
        estimators: dict[str, Callable[..., Errors]] = {
            Path(of.name).stem if several else of.name: partial(errors, of.artifact, of.model)
        }
        if self.ekf:
            estimators["EKF, same model" if of.plant else "exact EKF"] = partial(errors, None, of.model)
        if self.limit:
            estimators["limit"] = partial(noise_limit, of.model)
        frames, smape, nrmse = list[pd.DataFrame](), list[list[str]](), list[list[str]]()
        inputs, on = bool(of.artifact.nu), f"{of.on}, model {show_parameters(of.system)}" if of.plant else ""
        for starts, driven, trajectories, level in self._cases(f"evaluating {of.name}", of, levels, progress, left_out):
            skip = min(SKIPPED * of.system.pace, of.duration / 2) if driven else None
            for estimator, measure in estimators.items():
                # The bound needs the covariance of the starts, which is known in X.
                if estimator == "limit" and starts != "X":
                    continue
                one = measure(trajectories, measurement_noise=level, seed=self.motions.seed, skip=skip)
                case = [estimator] * several + [starts] + [("no", "yes")[driven]] * inputs
                case += [f"{process_noise:g}"] * bool(process_noise) + [show_level(level)]
                smape.append([*case, spread(one.full), spread(one.late), str(trajectories.escaped)])
                nrmse.append([*case, *map(percent, np.median(one.nrmse, axis=0))])
                columns: dict[str, Any] = {"observer": estimator} | (
                    {"plant": show_parameters(of.plant)} if of.plant else {}
                )
                columns |= {"starts": starts, "driven": driven, "process_noise": process_noise}
                columns |= {"measurement_noise": as_cell(level), "trajectory": np.arange(len(one.full))}
                columns |= {"smape": one.full, "smape_late": one.late, **by_state(one.nrmse)}
                frames.append(pd.DataFrame(columns))
        if not frames:
            return frames
        left, right = ["observer"] * several + ["starts"] + ["driven"] * inputs, ["noise\non y"]
        right = ["process\nnoise"] * bool(process_noise) + right
        ranges = [f"{name} from {low:g} to {high:g}" for name, (low, high) in of.artifact.parameter_ranges.items()]
        caption = f"trained for {', '.join(ranges)}" if ranges else None
        title = f"{of.name}: SMAPE in %, median (IQR) of {self._runs(of)}{on}"
        tables = [table(title, left, smape, [*right, "all steps", "after transient", "escaped"], caption)]
        title = f"{of.name}: NRMSE in % after transient, median{on}"
        tables.append(table(title, left, nrmse, [*right, *of.model.state_names]))
        if of.artifact.estimated_parameters:
            with progress.phase("estimating parameters"):
                tables.append(self._parameters(of, levels))
        progress.console.print(*tables)
        return frames

    def _parameters(self, of: Subject, levels: Sequence[Level]) -> Table:
        """Return a table with the errors of estimated parameters, for starts in X."""
        inputs, rows, names = bool(of.artifact.nu), list[list[str]](), of.artifact.estimated_parameters
        ranges = {name: of.artifact.parameter_ranges[name] for name in names}
        system = of.system if of.plant else with_parameters(of.system, ranges)
        how: dict[str, Any] = {"n": self._trajectories, "duration": of.duration, "plant": of.plant}
        how |= {"seed": self.motions.seed, "process_noise": self.motions.process_noise}
        how |= {"policy": of.policy and blind(of.policy, of.system.nx)}
        for driven in (False, True)[: 1 + inputs]:
            runs = unseen_trajectories(system, of.artifact.filter.dt, driven=driven, **how)
            for level in levels:
                found = parameter_errors(of.artifact, system, runs, measurement_noise=level, seed=self.motions.seed)
                rows.append([*[("no", "yes")[driven]] * inputs, show_level(level), *map(percent, found)])
        on = f"plant {show_parameters(of.plant)}" if of.plant else "plants drawn from their ranges"
        title = f"{of.name}: parameters, rms error after transient in % of their values, {on}"
        return table(title, [], rows, [*["driven"] * inputs, "noise\non y", *names])

    def _coverage(self, of: Subject, progress: ProgressBars, left_out: list[str]) -> list["pd.DataFrame"]:
        """Print the coverage of error bars, and return the rows of the CSV file."""
        import pandas as pd

        of.artifact.require_covariance()
        largest = np.multiply.outer(SHARES, of.artifact.inverse.measurement_noise_max)
        levels: list[Level] = [tuple(one) if isinstance(one, list) else one for one in largest.tolist()]
        if self.measurement_noise is not None:
            levels = self._levels(of, left_out)
        dt, rows, shown = of.artifact.filter.dt, list[dict[str, Any]](), list[list[str]]()
        first, settled = (round(seconds * of.system.pace / dt) for seconds in (FIRST, SETTLED))
        cases = self._cases(f"judging the error bars of {of.name}", of, levels, progress, left_out)
        for starts, driven, trajectories, level in cases:
            late = slice(min(settled, len(trajectories.x) - 1), None)
            spans = {f"first {first * dt:g} s": slice(0, first), f"after {settled * dt:g} s": late}
            how: dict[str, Any] = {"measurement_noise": level, "seed": self.motions.seed, "spans": (*spans.values(),)}
            for who, artifact in {"KKL": of.artifact, "EKF": None}.items():
                if artifact is None and not self.ekf:
                    continue
                for span, one in zip(spans, coverage(artifact, of.model, trajectories, **how), strict=True):
                    case = {"map": of.name, "starts": starts, "driven": driven, "observer": who, "span": span}
                    rows.append(case | {"measurement_noise": as_cell(level)} | one)
                    start = f"{starts}{', driven' if driven else ''}"
                    regions = [f"{one[name]:.1f}" for name in REGIONS]
                    shown.append([who, start, span, show_level(level), *regions, f"{one['nees']:.2f}"])
        if not rows:
            return []
        frame = pd.DataFrame(rows)
        limits = f"{frame.nees_low.min():.2f} to {frame.nees_high.max():.2f}"
        caption = f"with true covariances, the NEES at one time, averaged over runs, is {limits} with probability 95 %"
        title = f"{of.name}: share of errors in each region in %, {self._runs(of)}{of.on}"
        right = ["noise", *(f"{name} %" for name in REGIONS), "NEES"]
        progress.console.print(table(title, ["observer", "starts", "span"], shown, right, caption))
        return [frame]

    def _faults(self, of: Subject, progress: ProgressBars, left_out: list[str]) -> list["pd.DataFrame"]:
        """Simulate sensor faults, and return the rows of the CSV file."""
        from training.evaluation.faults import FAULTS, simulate_faults

        level = level_for(of.artifact, of.model, self.measurement_noise[0] if self.measurement_noise else None)
        if reason := beyond(of.artifact, level):
            left_out.append(reason)
            return []
        with progress.phase(f"simulating sensor faults for {of.name}", 1 + len(FAULTS)) as report:
            motions: dict[str, Any] = {"trajectories": self._trajectories, "duration": of.duration}
            motions |= {"seed": self.motions.seed, "policy": of.policy, "measurement_noise": level}
            runs = simulate_faults(of.artifact, of.model, report=report, **motions)
        runs.insert(0, "observer", of.name)
        return [runs]

    def _cases(
        self, description: str, of: Subject, levels: Sequence[Level], progress: ProgressBars, left_out: list[str]
    ) -> Iterator[tuple[str, bool, UnseenTrajectories, Level]]:
        """Yield, for each case and noise level: region of starts, whether inputs drive the runs, trajectories, level.

        A case gets a line in ``left_out`` instead if it has no starts, or if all its trajectories leave the bounds.
        """
        cases = CASES[: 3 if of.artifact.nu else 2] if levels else ()
        bar = progress.add_task(description, total=len(cases) * len(levels))
        motions = {"n": self._trajectories, "seed": self.motions.seed, "process_noise": self.motions.process_noise}
        for starts, domain, driven in cases:
            try:
                runs = of.runs(domain=domain, driven=driven, **motions)
                trajectories = unseen_trajectories(of.model, of.artifact.filter.dt, **runs)
                if not trajectories.inside.any():
                    raise NoStartsError(f"all {self._trajectories} runs left bounds = {of.model.bounds}")
            except NoStartsError as error:
                left_out.append(f"starts in {starts}{', driven' if driven else ''}: {error}")
                progress.advance(bar, len(levels))
                continue
            for level in levels:
                yield starts, driven, trajectories, level
                progress.advance(bar)

    def _levels(self, of: Subject, left_out: list[str]) -> list[Level]:
        """Return the levels of measurement noise within a map's range; other levels get lines in ``left_out``."""
        if self.measurement_noise is None:
            return list(dict.fromkeys([0.0, level_for(of.artifact, of.model)]))
        levels = [level_for(of.artifact, of.model, level) for level in self.measurement_noise]
        left_out += [reason for level in levels if (reason := beyond(of.artifact, level))]
        return [level for level in levels if not beyond(of.artifact, level)]

    @property
    def _trajectories(self) -> int:
        default = 500 if self.faults else 100
        return default if self.motions.trajectories is None else self.motions.trajectories

    def _runs(self, of: Subject) -> str:
        return f"{self._trajectories} runs of {of.duration:g} s"


def table(
    title: str,
    left: Sequence[str | Column],
    rows: Sequence[Sequence[str]],
    right: Sequence[str] = (),
    caption: str | None = None,
) -> Table:
    """Return a table whose first columns are aligned left, and the other columns right."""
    columns = [Column(name, justify="right") for name in right]
    laid_out = Table(*left, *columns, title=title or None, caption=caption)
    for row in rows:
        laid_out.add_row(*row)
    return laid_out


def fault_rows(runs: "pd.DataFrame") -> list[list[str]]:
    """Return the rows of the table of ``--faults``, one for each observer and fault."""
    rows = []
    for observer, group in runs.groupby("observer", sort=False):
        false = f"{100 * (group[group.fault == 'none'].score > 1).mean():.1f} %"
        for fault, faulty in group[group.fault != "none"].groupby("fault", sort=False):
            noticed = f"{100 * (faulty.score > 1).mean():.1f} %"
            delays = (f"{delay:.2f}" for delay in np.quantile(faulty.delay, [0.5, 0.95], method="higher"))
            rows.append([str(observer), false, str(fault), f"{faulty.deadline.iloc[0]:g} s", noticed, *delays])
    return rows


def show_parameters(system: System) -> str:
    """Return parameters as text, such as ``mu=3.3 a=1``."""
    return " ".join(f"{name}={value:g}" for name, value in system.parameters.items())


def spread(values: np.ndarray) -> str:
    """Return the median and interquartile range as text."""
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{percent(median)} ({percent(low)} – {percent(high)})"


def percent(value: float) -> str:
    """Return an error in percent as text; the NRMSE of a constant state is NaN."""
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:{'.2f' if value >= 0.005 else '.1g'}}"
