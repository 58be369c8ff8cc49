"""From a system and a configuration to an artifact: the stages of ``kkl-gym train``, in order, in :func:`train`."""

import dataclasses
import hashlib
import json
import math
import platform
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from rich.console import Console

import kkl_gym
from kkl_gym.system import System
from observers import Artifact, Expression, ForwardMap, InverseMap, LinearFilter
from observers.checks import noise_levels
from training.config import Config
from training.jobs import claimed_run, describe
from training.maps.forward import ForwardProblem, transients, truncation_step
from training.maps.inverse import InverseProblem
from training.maps.networks import Network, on_torch
from training.maps.optimise import Log, Stage, log_to, optimise
from training.maps.samplers import ClosedLoopSampler, ForwardMapSampler, Sampler, TrajectorySampler
from training.maps.scaling import StateScale
from training.progress import LOG, ProgressBars, progress_bars
from training.seeds import Stream, generator
from training.smoothness import check_continuous
from training.spectrum import Spectrum
from training.systems import named_policy
from training.trajectories.closed_loop import record_closed_loop
from training.trajectories.controllers import Controller
from training.trajectories.derivatives import output_matrix
from training.trajectories.expression import output_expression
from training.trajectories.parameters import blind, nominal_share, relative_ranges, uncertain_plant
from training.trajectories.policy import policy_fingerprint
from training.trajectories.record import Motions, Trajectories, record, recording_ages
from training.trajectories.signals import DRIVEN, KINDS

# Of each stage in the CPU time; those of input-aware maps have equal shares.
SPINN_SHARES = {"forward": 0.5, "inverse": 0.5}
LEAD_IN_SHARE = 0.4  # of the free motions start beyond X, where inputs have led
CLOSED_LOOP_SECONDS = 20.0  # of each trajectory, at the pace of the shipped systems


Recorded = TypeVar("Recorded", bound=Trajectories)


@dataclass(frozen=True)
class Result:
    """What a run leaves behind.

    Parameters
    ----------
    artifact : Artifact
        The observer; nothing has written it to a file.
    losses : dict of str to list of (int, float)
        For each stage that trained a network, its error after so many batches.
    seconds : dict of str to float
        What each of these stages took, and "simulating".
    """

    artifact: Artifact
    losses: dict[str, list[tuple[int, float]]]
    seconds: dict[str, float]


def train(
    system: System,
    config: Config,
    folder: Path,
    *,
    resume: bool = False,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Result:
    """Learn an observer for a system.

    The stages, in order; each that trains a network has checkpoints of its own:

    1. The run's folder is claimed, and the eigenvalues become a filter.
    2. Free inverse (input-aware maps of a system with inputs, unless turned off or under a policy): trajectories
       without input are simulated with a filter of y beside them, and an inverse of z_y alone is fitted.
    3. The training trajectories are simulated with the filter beside them; those of input-aware maps have process noise
       and inputs, random ones or a policy's. In all stages uncertain parameters differ between trajectories, see
       :func:`training.trajectories.parameters.uncertain_plant`.
    4. Forward map (spinn): T is trained on them and on its equation, and z' = T(x') takes the place of the simulated z.
       An input-aware map has no T. Batches are drawn along the trajectories, with measurement noise
       added to z.
    5. The inverse is fitted on these batches, and the observer is put together.
    6. Closed loop (if the configuration has it): a controller acts on that observer's estimates, and the same inverse
       is fitted again, on these trajectories too.

    The limits of a monitor and the report of ``kkl-gym train`` come later, and elsewhere.

    Parameters
    ----------
    system : System
        Any system.
    config : Config
        How.
    folder : Path
        Where checkpoints and TensorBoard scalars go; created if missing.
    resume : bool
        Whether to go on from the checkpoints in ``folder`` if there are any; without it they are an error.
    device : torch.device, optional
        Where networks are trained; by default on a GPU if there is one.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown. By default it is shown nowhere, but for log.txt in ``folder``.

    Returns
    -------
    Result
        The observer, and how the errors fell.

    Raises
    ------
    ValueError
        If there are checkpoints, but not ``resume`` or not of this configuration, if another process is at work in the
        folder, or if the system's trajectories leave its bounds, the policy is none, or a parameter that is to be
        uncertain is none of the system's.
    FloatingPointError
        If the loss stops being a number.
    """
    device = device or torch.device("cuda" if torch.cuda.is_available() else "cpu")
    noise = {"process_noise": float(system.process_noise), "scale": [float(one) for one in system.scale]}
    identity = {**describe(system), **noise, **dataclasses.asdict(config)}
    # Errors now, not in ten minutes.
    if config.pipeline == "spinn":
        check_continuous(system)
    ranges = relative_ranges(system, config.uncertain)
    if ranges:
        identity["nominal_share"] = nominal_share(ranges)
    policy = None if config.policy is None else named_policy(system, config.policy)
    feedback = (policy or named_policy(system, "controller")) if config.closed_loop_trajectories else None
    if policy:
        identity["policy_actions"] = policy_fingerprint(policy, system)
    with claimed_run(folder, identity, resume), log_to(folder) as log, progress_bars(console, folder / LOG) as progress:
        run = _Run(system, config, folder, resume, device, progress, log, identity, ranges)
        free = run.learn_free_inverse() if "free" in run.shares else None
        trajectories = run.simulate(run.linear, system.name, Motions(kinds=DRIVEN if free else KINDS, policy=policy))
        forward: ForwardMap | None = None
        sampler: Sampler
        if config.pipeline == "input-aware":
            sampler = run.along(trajectories, run.linear)
        else:
            points = run.points(trajectories)
            forward = run.learn_forward(trajectories, points)
            run.samples["inverse_samples"] = len(points)
            sampler = run.by_forward_map(forward, trajectories, points)
        inverse = run.fit_inverse("inverse", sampler)
        artifact = run.artifact(sampler.inverse_map(inverse, run.linear), forward, free)
        if feedback is not None and isinstance(sampler, TrajectorySampler):
            both = run.close_the_loop(sampler, artifact, feedback)
            run.fit("closed-loop", inverse, both)
            artifact = run.artifact(both.inverse_map(inverse, run.linear), forward, free)
    return Result(artifact, run.losses, run.seconds)


@dataclass
class _Run:
    """The stages of :func:`train`, and what they share. Random numbers are drawn in the order of the stages."""

    system: System
    config: Config
    folder: Path
    resume: bool
    device: torch.device
    progress: ProgressBars
    log: Log | None
    identity: dict[str, Any]
    ranges: dict[str, tuple[float, float]]  # of uncertain parameters
    losses: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    samples: dict[str, int] = field(default_factory=dict)  # distinct ones, for certificates

    def __post_init__(self) -> None:
        system, config = self.system, self.config
        noise_levels("measurement_noise_max", config.measurement_noise_max, system.ny)  # an error before any work
        self.plant = uncertain_plant(system, self.ranges)
        self.estimated = tuple(self.ranges) if config.estimate_parameters else ()
        self.started = time.monotonic()
        self.fingerprint = hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()[:16]
        torch.manual_seed(config.seed)
        self.rng = generator(Stream.TRAINING, config.seed)
        self.spectrum = Spectrum(config.eigenvalues, config.pairs)
        nu = system.nu if config.pipeline == "input-aware" and config.inputs else 0
        self.linear = self.spectrum.filter(system.ny, config.dt, nu)
        self.shares = shares(config, nu)
        self.steps = max(1, round(config.duration / config.dt))
        self.process_noise_share = config.process_noise_share if config.pipeline == "input-aware" else 0.0
        self.ages = recording_ages(self.steps, config.samples)
        if config.pipeline == "spinn":  # ages at which the filter's start no longer matters; an error before any work
            first = truncation_step(
                system, self.linear, steps=self.steps, epsilon=config.truncation, box_factor=config.box_factor
            )
            self.settled = self.ages >= first

    def simulate(self, linear: LinearFilter, what: str, motions: Motions) -> Trajectories:
        """Training trajectories with a filter beside them."""
        config, report = self.config, self.progress.bar(f"simulating {what}", self.config.trajectories)
        policy = motions.policy
        motions = dataclasses.replace(
            motions,
            process_noise_share=self.process_noise_share,
            box_factor=config.box_factor,
            policy=policy and blind(policy, self.system.nx),
        )
        n, steps = config.trajectories, self.steps
        with self.timed("simulating"):
            found = record(
                self.plant, linear, n=n, steps=steps, ages=self.ages, rng=self.rng, motions=motions, report=report
            )
        return self.known(found)

    def known(self, trajectories: Recorded) -> Recorded:
        """Trajectories without the parameters that are not to be estimated, and whether these are the system's own."""
        x, nx, nominal = trajectories.x, self.system.nx, None
        if self.ranges:
            own = [self.system.parameters[name] for name in self.ranges]
            nominal = (x[0, :, nx:] == own).all(-1)  # at age 0 they are as they were drawn
        return dataclasses.replace(trajectories, x=x[..., : nx + len(self.estimated)], nominal=nominal)

    def along(
        self, trajectories: Trajectories, linear: LinearFilter, error: np.ndarray | None = None
    ) -> TrajectorySampler:
        """Batches along trajectories, transients and noise included; z may have an error of some covariance beside."""
        config = self.config
        with self.progress.phase("preparing batches"):
            return TrajectorySampler(
                trajectories,
                linear,
                measurement_noise_max=config.measurement_noise_max,
                batch=config.batch,
                device=self.device,
                measurement_noise=self.system.measurement_noise,
                noise_free_share=config.noise_free_share,
                high_noise_emphasis=config.high_noise_emphasis,
                process_noise_max=self.system.process_noise if self.process_noise_share else 0.0,
                error=error,
                parameters=len(self.estimated),
                scaling=config.scaling,
            )

    def learn_free_inverse(self) -> InverseMap:
        """T_inv of z_y alone, fitted along motions without input, some of them from beyond X."""
        unforced = self.spectrum.filter(self.system.ny, self.config.dt)
        motions = Motions(lead_in_share=LEAD_IN_SHARE, lead_in_input=self.config.lead_in_input)
        sampler = self.along(self.simulate(unforced, f"{self.system.name}, free", motions), unforced)
        return sampler.inverse_map(self.fit_inverse("free", sampler), unforced)

    def points(self, trajectories: Trajectories) -> np.ndarray:
        """States at which T's equation is asked to hold, and x' where there are no transients: (n, nx)."""
        x = trajectories.x.reshape(-1, self.system.nx)
        return x if self.config.collocation == "motions" else self.system.draw_starts(self.rng, len(x))

    def learn_forward(self, trajectories: Trajectories, points: np.ndarray) -> ForwardMap:
        """T, trained on pairs and on its equation."""
        system, config, linear = self.system, self.config, self.linear
        late = self.settled
        self.samples["forward_samples"] = int(late.sum()) * config.trajectories + len(points)
        network = Network(system.nx, linear.size, width=config.width, depth=config.depth, activation=config.activation)
        problem = ForwardProblem(
            network,
            system,
            linear=linear,
            pairs=(trajectories.x[late].reshape(-1, system.nx), trajectories.z[late].reshape(-1, linear.size)),
            points=points,
            scale=StateScale.of(points, config.scaling),
            physics_weight=config.physics_weight,
            batch=config.batch,
            device=self.device,
        )
        self.minimise("forward", problem, config.forward_steps)
        if config.solved_output_layer:
            with self.timed("forward"), self.progress.phase("solving for T's output layer", linear.size) as report:
                problem.solve_output_layer(self.rng, report)
        return problem.forward_map()

    def by_forward_map(
        self, forward: ForwardMap, trajectories: Trajectories, points: np.ndarray
    ) -> TrajectorySampler | ForwardMapSampler:
        """Batches z' = T(x'), blurred by the error of T that the simulated z shows."""
        linear = self.linear
        with self.progress.phase("T along the trajectories"):
            T_x = np.stack([forward(x) for x in trajectories.x])
            z = transients(T_x, trajectories.z[0], linear=linear, ages=self.ages)
        error = (trajectories.z - z)[self.settled].reshape(-1, linear.size)
        if self.config.transients:
            return self.along(dataclasses.replace(trajectories, z=z), linear, error.T @ error / len(error))
        T, config, device = on_torch(forward, self.device), self.config, self.device
        return ForwardMapSampler(T, error, points=points, batch=config.batch, device=device, scaling=config.scaling)

    def fit_inverse(self, stage: str, sampler: Sampler) -> Network:
        """A network that gives x on the sampler's batches."""
        config = self.config
        inputs = sampler(torch.Generator(self.device).manual_seed(0))[0].shape[1]
        outputs = self.system.nx + len(self.estimated)
        network = Network(inputs, outputs, width=config.width, depth=config.depth, activation=config.activation).to(
            self.device
        )
        self.fit(stage, network, sampler)
        return network

    def fit(self, stage: str, network: Network, sampler: Sampler) -> None:
        """Train a network on the sampler's batches."""
        problem = InverseProblem(network, sampler, self.device)
        self.minimise(stage, problem, self.config.inverse_steps)

    def close_the_loop(self, sampler: TrajectorySampler, artifact: Artifact, feedback: Controller) -> ClosedLoopSampler:
        """Batches half from trajectories of a controller that acts on the artifact's estimate."""
        config = self.config
        steps = min(self.steps, round(CLOSED_LOOP_SECONDS * self.system.pace / config.dt))
        driven = record_closed_loop(
            self.plant,
            artifact,
            feedback,
            n=config.closed_loop_trajectories,
            steps=steps,
            ages=recording_ages(steps, config.samples),
            rng=self.rng,
            noise_free_share=config.noise_free_share,
            high_noise_emphasis=config.high_noise_emphasis,
            process_noise_share=config.process_noise_share,
            report=self.progress.bar("closing the loop", config.closed_loop_trajectories),
        )
        return ClosedLoopSampler(sampler, self.known(driven), dt=config.dt, device=self.device)

    def minimise(self, name: str, problem: Any, steps: int) -> None:
        """Train a stage's network within its share of the CPU time."""
        config = self.config
        seconds = math.inf if config.cpu_seconds is None else config.cpu_seconds * self.shares[name]
        stage = Stage(
            name=name,
            steps=steps,
            learning_rate=config.learning_rate,
            folder=self.folder,
            fingerprint=self.fingerprint,
            seed=config.seed,
            cpu_seconds=seconds,
            optimiser=config.optimiser,
        )
        with self.timed(name):
            self.losses[name] = optimise(stage, problem, problem.loss, self.progress, log=self.log, resume=self.resume)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Adds what happens inside to the seconds of a stage."""
        began = time.monotonic()
        yield
        self.seconds[name] += time.monotonic() - began

    def artifact(self, inverse: InverseMap, forward: ForwardMap | None, free: InverseMap | None) -> Artifact:
        """The observer, with how it was made."""
        C = output_matrix(self.system)
        return Artifact(
            filter=self.linear,
            inverse=inverse,
            system=self.system.name,
            parameters=self.system.parameters,
            forward=forward,
            C=C,
            h=self.output_expression() if C is None else None,
            free_inverse=free,
            measurement_noise=self.system.measurement_noise,
            parameter_ranges=self.ranges,
            estimated_parameters=self.estimated,
            training={
                **dataclasses.asdict(self.config),
                **self.samples,
                "seconds": round(time.monotonic() - self.started),
                "device": self.device.type,
                "threads": torch.get_num_threads(),
                "resumed": self.resume,
            },
            versions={
                "kkl-gym": kkl_gym.__version__,
                "python": platform.python_version(),
                "torch": torch.__version__,
                "numpy": np.__version__,
            },
        )

    def output_expression(self) -> Expression | None:
        """The output h(x) as data, None where the system's equations cannot be told from outside."""
        try:
            return output_expression(self.system)
        except ValueError:  # whoever asks for a monitor will learn why
            return None


def shares(config: Config, nu: int) -> dict[str, float]:
    """Stages of a run that train networks, with their parts in the CPU time."""
    if config.pipeline == "spinn":
        return SPINN_SHARES
    closed_loop = ["closed-loop"] if config.closed_loop_trajectories else []
    stages = ["inverse", *(["free"] if config.free_inverse and nu and config.policy is None else []), *closed_loop]
    return {stage: 1 / len(stages) for stage in stages}
