"""From a system and a configuration to an artifact."""

import dataclasses
import hashlib
import json
import math
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scipy.linalg import block_diag
from torch.utils.tensorboard import SummaryWriter

import kkl_gym
from kkl_gym.system import System
from observers import Artifact, ForwardMap, InverseMap, LinearFilter
from training.config import Config
from training.controllers import controller
from training.data import Trajectories, output, record, record_closed_loop, recording_ages
from training.files import write
from training.forward import ForwardProblem, truncation_time
from training.inverse import ClosedLoopSampler, ForwardMapSampler, InverseProblem, Sampler, TrajectorySampler
from training.networks import Network, on_torch
from training.optimise import Stage, optimise
from training.signals import DRIVEN, KINDS
from training.solved import collocation, solve_forward

# First entry of the seed of training trajectories; evaluation's is another (training.evaluate.EVALUATION_SEED).
TRAINING_SEED = 1
# Of each stage in the cap on CPU time; those of input-aware maps have equal ones. A step of the forward map costs three
# of the inverse map's.
SPINN_SHARES = {"forward": 0.75, "inverse": 0.25}
SOLVED_SHARES = {"inverse": 0.75}  # solving takes about the rest
EXCITED = 0.4  # share of the free motions that start beyond X, where inputs have led
INVERTED = 200_000  # states on which a solved forward map is inverted
CLOSED_LOOP_SECONDS = 20.0  # of each trajectory


@dataclass(frozen=True)
class Result:
    """What a run leaves behind."""

    artifact: Artifact
    losses: dict[str, list[tuple[int, float]]]


def train(
    system: System,
    config: Config,
    folder: Path,
    resume: bool = False,
    device: torch.device | None = None,
    console: Console | None = None,
) -> Result:
    """Learn an observer for a system.

    Parameters
    ----------
    system : any system.
    config : how.
    folder : where checkpoints and TensorBoard scalars go; created if missing.
    resume : go on from the checkpoints in ``folder`` if there are any; without it they are an error.
    device : of the networks; None takes a GPU if there is one.
    console : for the progress bars; None prints none.

    Raises
    ------
    ValueError : if there are checkpoints, but not ``resume`` or not of this configuration, or if the system's
        trajectories leave its bounds.
    FloatingPointError : if the loss stops being a number.
    """
    started = time.monotonic()
    device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")
    folder.mkdir(parents=True, exist_ok=True)
    noise = {"process_noise": float(system.process_noise), "scale": [float(one) for one in system.scale]}
    identity = {**describe(system), **noise, **dataclasses.asdict(config)}
    fingerprint = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
    _claim(folder, identity, resume)
    torch.manual_seed(config.seed)
    rng = np.random.default_rng([TRAINING_SEED, config.seed])

    nu = system.nu if config.method == "input-aware" and config.inputs else 0
    linear = make_filter(config.eigenvalues, system.ny, config.dt, nu, config.pairs)
    shares = _shares(config, nu)
    steps = max(1, round(config.duration / config.dt))
    losses: dict[str, list[tuple[int, float]]] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        SummaryWriter(folder) as writer,
        Progress(*columns, TimeRemainingColumn(), console=console, disable=console is None) as progress,
    ):

        def run(name: str, problem: Any, count: int) -> None:
            cap = math.inf if config.cap is None else config.cap * shares[name]
            stage = Stage(name, count, config.learning_rate, folder, fingerprint, config.seed, cap, config.optimiser)
            losses[name] = optimise(stage, problem, problem.loss, progress, writer, resume)

        first = 0 if config.method == "input-aware" else truncation_step(system, linear, steps, config.truncation)
        ages = recording_ages(first, steps, config.samples)

        def simulated(into: LinearFilter, what: str, **how: Any) -> Trajectories:
            task = progress.add_task(f"simulating {what}", total=config.trajectories)

            def report(done: int) -> None:
                progress.update(task, completed=done)

            disturbed = config.disturbed if config.method == "input-aware" else 0.0
            return record(system, into, config.trajectories, steps, ages, rng, report, disturbed=disturbed, **how)

        def sampled(motions: Trajectories, through: LinearFilter) -> TrajectorySampler:
            process_max = system.process_noise if config.disturbed else 0.0
            levels = (config.quiet, config.emphasis, process_max)
            return TrajectorySampler(motions, through, config.noise_max, config.batch, device, *levels)

        def fit(sampler: Sampler, stage: str) -> Network:
            inputs = sampler(torch.Generator(device).manual_seed(0))[0].shape[1]
            network = Network(inputs, system.nx, config.width, config.depth, config.activation).to(device)
            run(stage, InverseProblem(network, sampler, device), config.inverse_steps)
            return network

        feedback = controller(system) if config.closed_loop else None  # an error now rather than in ten minutes
        free: InverseMap | None = None
        if "free" in shares:
            unforced = make_filter(config.eigenvalues, system.ny, config.dt, 0, config.pairs)
            motions = simulated(unforced, f"{system.name}, free", excited=EXCITED, push=config.push)
            own = sampled(motions, unforced)
            free = own.inverse_map(fit(own, "free"), unforced)
            del motions, own
        data = simulated(linear, system.name, kinds=DRIVEN if free else KINDS)
        forward: ForwardMap | None = None
        sampler: Sampler
        if config.method == "input-aware":
            sampler = sampled(data, linear)
        else:
            x, z = data.x.reshape(-1, system.nx), data.z.reshape(-1, linear.size)
            if config.features:
                task = progress.add_task(f"solving for T with {config.features} features", total=1)
                forward = solve_forward(system, linear, config.features, config.reach, rng)
                progress.update(task, completed=1)
                some = np.random.default_rng(0).permutation(len(x))[:100_000]
                T, error = on_torch(forward, device), z[some] - forward(x[some])
                points = collocation(system, INVERTED, config.reach, rng)
            else:
                network = Network(system.nx, linear.size, config.width, config.depth, config.activation)
                problem = ForwardProblem(network, system, linear, x, z, config.physics_weight, config.batch, device)
                run("forward", problem, config.forward_steps)
                forward, T, error, points = problem.forward_map(), problem.T, problem.error(), None
            sampler = ForwardMapSampler(T, error, system.box(), config.batch, device, points)
        inverse = fit(sampler, "inverse")

        def artifact() -> Artifact:
            return Artifact(
                filter=linear,
                inverse=sampler.inverse_map(inverse, linear),
                system=system.name,
                parameters=system.parameters,
                forward=forward,
                C=output_matrix(system),
                free=free,
                training={
                    **dataclasses.asdict(config),
                    "seconds": round(time.monotonic() - started),
                    "device": device.type,
                    "threads": torch.get_num_threads(),
                    "resumed": resume,
                },
                versions={
                    "kkl-gym": kkl_gym.__version__,
                    "python": platform.python_version(),
                    "torch": torch.__version__,
                    "numpy": np.__version__,
                },
            )

        if feedback and isinstance(sampler, TrajectorySampler):
            steps = min(steps, round(CLOSED_LOOP_SECONDS / config.dt))
            task = progress.add_task("closing the loop", total=config.closed_loop)
            driven = record_closed_loop(
                system,
                artifact(),
                feedback,
                config.closed_loop,
                steps,
                recording_ages(0, steps, config.samples),
                rng,
                lambda done: progress.update(task, completed=done),
            )
            sampler = ClosedLoopSampler(sampler, driven, config.dt, device)
            run("closed-loop", InverseProblem(inverse, sampler, device), config.inverse_steps)
    return Result(artifact(), losses)


def _shares(config: Config, nu: int) -> dict[str, float]:
    """The stages of a run that train networks, with their parts in the cap on CPU time."""
    if config.method == "spinn":
        return SOLVED_SHARES if config.features else SPINN_SHARES
    stages = ["inverse", *(["free"] if config.free and nu else []), *(["closed-loop"] if config.closed_loop else [])]
    return {stage: 1 / len(stages) for stage in stages}


def describe(system: System) -> dict[str, Any]:
    """What identifies a system, its equations included: they are sampled at points of the training box."""
    x = np.random.default_rng(0).uniform(*system.box(), (20, system.nx))
    rows = [*system.f(x.T), *(entry for row in system.g(x.T) for entry in row), *output(system, x).T]
    equations = np.round([np.broadcast_to(row, 20) for row in rows], 6)  # the same on every machine
    return {
        "system": system.name,
        "parameters": system.parameters,
        "X": system.X,
        "bounds": system.bounds,
        "u_max": system.u_max,
        "equations": hashlib.sha256(json.dumps(equations.tolist()).encode()).hexdigest()[:16],
    }


def _claim(folder: Path, described: dict[str, Any], resume: bool) -> None:
    """Write the run's configuration, unless the folder holds a run that this one would spoil."""
    file = folder / "config.json"
    described = json.loads(json.dumps(described))
    if any(folder.glob("*.checkpoint.safetensors")) and file.exists():
        if not resume:
            raise ValueError(
                f"{folder} holds the checkpoints of a run: go on with it (resume=True, --resume), remove it, "
                "or take another folder (--out)"
            )
        before = json.loads(file.read_text())
        changed = [name for name in sorted({*before, *described}) if before.get(name) != described.get(name)]
        if changed:
            differences = ", ".join(
                f"{name} = {before.get(name)} there, {described.get(name)} here" for name in changed
            )
            raise ValueError(f"{folder} holds a run of another configuration: {differences}")
    write(file, json.dumps(described, indent=2) + "\n")


def truncation_step(system: System, linear: LinearFilter, steps: int, epsilon: float) -> int:
    """k*, the first sample by which every trajectory from the training box has forgotten its z0 to epsilon."""
    x0 = np.random.default_rng(0).uniform(*system.box(), (10_000, system.nx))
    z0 = float(np.linalg.norm(linear.start(output(system, x0)), axis=-1).max())
    t = truncation_time(linear, z0, epsilon)
    if t >= steps * linear.dt:
        raise ValueError(
            f"trajectories of {steps * linear.dt:g} s end before the filter has forgotten its start, t* = {t:.3g} s; "
            "make them longer"
        )
    return math.ceil(t / linear.dt)


def output_matrix(system: System) -> np.ndarray | None:
    """C if the output is h(x) = C x, else None."""
    C = output(system, np.eye(system.nx)).T
    x = np.random.default_rng(0).uniform(*system.box(), (100, system.nx))
    return C if np.allclose(output(system, x), x @ C.T, rtol=1e-9, atol=1e-12) else None


def make_filter(
    eigenvalues: tuple[float, ...], ny: int, dt: float, nu: int, pairs: tuple[tuple[float, float], ...] = ()
) -> LinearFilter:
    """The filter with these modes for each of ny outputs, A block diagonal and B all ones for each output.

    eigenvalues : real ones; pairs : (a, w) for each pair a +- iw, which becomes the block [[a, w], [-w, a]].
    """
    one = block_diag(*eigenvalues, *([[a, w], [-w, a]] for a, w in pairs))
    return LinearFilter(np.kron(np.eye(ny), one), np.kron(np.eye(ny), np.ones((len(one), 1))), dt, nu)
