"""The lessons of a training: the map, and the flow, which predicts the next state. ``train`` runs all lessons."""

import dataclasses
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

import kkl_gym
from kkl_gym.system import System
from observers import MLP, Artifact, Flow, ForwardMap, InverseMap, LinearFilter, Motion
from observers.checks import noise_levels
from training.calibration import calibrate
from training.config import Config
from training.maps.coordinates import spread
from training.maps.forward import ForwardProblem, transients, truncation_step
from training.maps.inverse import ForwardMapSampler, InverseProblem, Sampler, TrajectorySampler
from training.maps.networks import Network, averaged, tensor
from training.presets import preset
from training.progress import ProgressBars
from training.run import Run
from training.seeds import Stream, generator
from training.sources import OF_MEDIAN, Pairs, Source, TooFewRunsError
from training.sources.simulated import SimulatedSource
from training.spectrum import Spectrum, check_continuous

# Size and training of the flow's network.
WIDTH, DEPTH, BATCH, LEARNING_RATE = 24, 2, 1024, 3e-3
LEAST = 0.01  # the loss divides squared errors by the residual's mean square plus this, lest tiny residuals dominate
WORSE = 2.0  # a tracker whose held-out error is more than this multiple of T_inv's is dropped
LEAST_ERROR = 0.01  # least error that a tracker assumes for a flow, as a fraction of a state's rms change in a step


@dataclass(frozen=True)
class Result:
    """The result of a training.

    Parameters
    ----------
    artifact : Artifact
        The observer.
    losses : dict of str to list of (int, float)
        For each stage that trained a network, pairs (batches so far, mean error over the last 100 of them or fewer).
    seconds : dict of str to float
        CPU seconds of each stage.
    """

    artifact: Artifact
    losses: dict[str, list[tuple[int, float]]]
    seconds: dict[str, float]


def train(
    source: System | Source,
    config: Config | None = None,
    folder: Path | None = None,
    *,
    resume: bool = False,
    device: torch.device | None = None,
    console: Console | ProgressBars | None = None,
) -> Result:
    """Learn an observer: a filter, T_inv, a tracker's motion model, covariances and the limits of a fault monitor.

    The lessons, in order, are the map (:func:`training.learn_map`), the motion model, and the calibration
    (:func:`training.calibrate`). The motion model consists of the system's equations, or of a learned flow if the
    equations are unknown or an artifact cannot hold them (:func:`training.learn_flow`). Each network has checkpoints.

    Parameters
    ----------
    source : System or Source
        Where motions come from.
    config : Config, optional
        The settings; by default the system's preset "fast", or the configuration of the source.
    folder : Path, optional
        Folder for checkpoints and a log, created if missing; by default nothing is kept.
    resume : bool, default False
        Whether to resume from the checkpoints in ``folder``; if False, ``folder`` must not hold any.
    device : torch.device, optional
        Where networks are trained; by default on a GPU if there is one.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default only in log.txt in ``folder``.

    Returns
    -------
    Result
        The observer, the losses by stage, and the CPU seconds by stage.

    Raises
    ------
    ValueError
        If ``folder`` is in use by another process, holds checkpoints of another training, or holds checkpoints while
        ``resume`` is False; if almost all motions leave the system's bounds; if ``config`` differs from the source's.
    FloatingPointError
        If the loss becomes NaN.
    """
    if isinstance(source, System):
        source = SimulatedSource(source, config or preset(source))
    elif config not in (None, source.config):
        raise ValueError("a source has a configuration of its own: pass config only with a System")
    config = source.config
    noise_levels("measurement_noise_max", config.measurement_noise_max, source.ny)
    identity = {**source.identity(), **dataclasses.asdict(config)}
    began = time.process_time()
    with Run.begin(config, folder, identity=identity, console=console, device=device, resume=resume) as run:
        maps = learn_map(source, run)
        motion = _motion(source, run) if config.tracking and config.pipeline != "spinn" else None
        training = dataclasses.asdict(config) | run.samples
        training |= {"device": run.device.type, "threads": torch.get_num_threads(), "resumed": resume}
        versions = {"kkl-gym": kkl_gym.__version__, "python": platform.python_version()}
        versions |= {"torch": torch.__version__, "numpy": np.__version__}
        facts = source.facts() | ({} if maps.filter.nu else {"u_max": None})
        artifact = Artifact(**vars(maps), **facts, training=training, versions=versions)
        with run.timed("calibrating"):
            try:
                artifact = calibrate(artifact, source, motion=motion, console=run.progress)
            except TooFewRunsError as reason:
                run.progress.say(f"the observer has no covariances and does not track: {reason}")
        artifact, errors = _judged(artifact, source, run)
        training |= errors | {"cpu_seconds_spent": round(time.process_time() - began, 1)}
        return Result(dataclasses.replace(artifact, training=training), run.losses, dict(run.seconds))


def _judged(artifact: Artifact, source: Source, run: Run) -> tuple[Artifact, dict[str, Any]]:
    """Return the artifact and the errors of its observer; a tracker that makes them much larger is dropped."""
    errors = source.judged(artifact)
    if artifact.motion is None or not errors.get("held_out_errors"):
        return artifact, errors
    of_alone = source.judged(alone := dataclasses.replace(artifact, motion=None, C=None))
    total, of_T_inv = (sum(each["held_out_errors"].values()) for each in (errors, of_alone))
    if total <= WORSE * of_T_inv:
        return artifact, errors
    text = f"the observer does not track, as held-out errors would be {total / of_T_inv:.2g} times those of T_inv alone"
    run.progress.say(f"{text}: list the measured signals as hidden ones, too")
    return alone, of_alone


def _motion(source: Source, run: Run) -> Motion | None:
    """Return the tracker's motion model, with the source's equations or else a flow; None if tracking is impossible."""
    try:
        parts = source.tracking()
    except ValueError as reason:
        run.progress.say(f"the observer does not track: {reason}")
        return None
    try:
        equations = source.equations()
    except ValueError as error:
        run.progress.say(f"the tracker predicts by a learned flow: {error}")
        return learn_flow(source, run)
    return Motion(**parts, equations=equations)


@dataclass(frozen=True)
class Maps:
    """A filter and the maps that were learned for it; ``free_inverse`` and ``forward`` are None if not learned."""

    filter: LinearFilter
    inverse: InverseMap
    free_inverse: InverseMap | None = None
    forward: ForwardMap | None = None


def learn_map(source: Source, run: Run) -> Maps:
    """Learn T_inv along motions of a source, transients and all noise levels included.

    By default, a simulated system with inputs has two T_inv: one of filtered y, used until an input acts, then one of
    filtered y and u. "spinn" follows the paper: it learns T from motions and T's equation, then T_inv from z = T(x).

    Parameters
    ----------
    source : Source
        Where motions come from.
    run : Run
        The run of the training, which holds the configuration.

    Returns
    -------
    Maps
        The filter and its maps.

    Raises
    ------
    ValueError
        If almost all motions leave the system's bounds, or motions are too short for the filter.
    FloatingPointError
        If the loss becomes NaN.
    """
    config, free = run.config, None
    spectrum = Spectrum(config.eigenvalues, config.pairs)
    linear = spectrum.filter(source.ny, config.dt, source.nu)
    if config.pipeline == "spinn":
        return _papers_maps(source, linear, run)
    has_free = isinstance(source, SimulatedSource) and source.has_free_map
    share = 1 / (1 + has_free)
    if has_free:
        unforced = spectrum.filter(source.ny, config.dt)
        sampler = _sampler(source, unforced, run, _pairs(source, unforced, run, free=True))
        free = sampler.inverse_map(_fitted("free", sampler, run, share))
    sampler, count = _sampler(source, linear, run, _pairs(source, linear, run)), config.members
    names = ["inverse"] if count == 1 else [f"inverse-{i + 1}" for i in range(count)]
    networks = [_fitted(name, sampler, run, share / count, member) for member, name in enumerate(names)]
    return Maps(linear, sampler.inverse_map(averaged(networks)), free)


def _papers_maps(source: Source, linear: LinearFilter, run: Run) -> Maps:
    """Train T on motions and on its equation, then T_inv on z = T(x)."""
    if not isinstance(source, SimulatedSource):
        raise ValueError("the pipeline 'spinn' needs the equations of a system; train with 'input-aware'")
    check_continuous(source.system)
    config, system, ages, progress = run.config, source.system, source.ages, run.progress
    settled = ages >= truncation_step(  # mask of the ages at which the filter's start no longer matters
        system, linear, steps=source.steps, epsilon=config.truncation, box_factor=config.box_factor
    )
    pairs, rng = _pairs(source, linear, run), generator(Stream.TRAINING, config.seed, 3)
    x = pairs.x.reshape(-1, system.nx)
    points = x if config.collocation == "motions" else system.draw_starts(rng, len(x))
    along = pairs.x[settled].reshape(-1, system.nx), pairs.z[settled].reshape(-1, linear.size)
    run.samples |= {"forward_samples": len(along[0]) + len(points), "inverse_samples": len(points)}
    problem = ForwardProblem(system, linear, config, pairs=along, points=points, device=run.device)
    run.minimise("forward", problem, problem.loss, config.forward_steps, share=1 / 2)
    if config.solved_output_layer:
        with run.timed("forward"), progress.phase("solving for T's output layer", linear.size) as report:
            problem.solve_output_layer(rng, report)
    T = problem.forward_map()
    with progress.phase("evaluating T along the motions"):
        z = transients(np.stack([T(each) for each in pairs.x]), pairs.z[0], linear=linear, ages=ages)
    error = (pairs.z - z)[settled].reshape(-1, linear.size)
    covariance = error.T @ error / len(error)
    sampler: Sampler
    if config.transients:
        sampler = _sampler(source, linear, run, dataclasses.replace(pairs, z=z), covariance)
    else:
        sampler = ForwardMapSampler(T, covariance, config, points=points, device=run.device)
    return Maps(linear, sampler.inverse_map(_fitted("inverse", sampler, run, 1 / 2)), forward=T)


def _pairs(source: Source, linear: LinearFilter, run: Run, free: bool = False) -> Pairs:
    name = f"motions of {source.name}{' without inputs' if free else ''}"
    with run.timed("motions"), run.progress.phase(name, run.config.trajectories) as report:
        return source.pairs(linear, free=free, report=report)


def _sampler(
    source: Source, linear: LinearFilter, run: Run, pairs: Pairs, error: np.ndarray | None = None
) -> TrajectorySampler:
    """Make a sampler of batches along motions; ``error`` is the covariance of z's error if z comes from a learned T."""
    with run.progress.phase("preparing batches"):
        return TrajectorySampler(pairs, linear, run.config, device=run.device, error=error, **source.sampling(linear))


def _fitted(name: str, sampler: Sampler, run: Run, share: float, member: int = 0) -> MLP:
    """Train a network on the sampler's batches, so that it estimates x."""
    config, device = run.config, run.device
    inputs, x, *_ = sampler(torch.Generator(device).manual_seed(0))
    network = Network.of(config, inputs.shape[1], x.shape[1]).to(device)
    problem, seed = InverseProblem(network, sampler, device), config.seed * config.members + member
    run.minimise(name, problem, problem.loss, config.inverse_steps, share=share, seed=seed)
    return network.export()


def learn_flow(source: Source, run: Run) -> Motion:
    """Learn a flow, by which a tracker predicts the next state: an affine fit, and a network for its residuals.

    Parameters
    ----------
    source : Source
        Where motions come from.
    run : Run
        The run of the training, which holds the configuration.

    Returns
    -------
    Motion
        The motion model; its covariance factors are 1 until :func:`training.calibrate` replaces them.

    Raises
    ------
    ValueError
        If no two consecutive samples have all states, or observers that are learned from the source cannot track.
    FloatingPointError
        If the loss becomes NaN.
    """
    parts, device = source.tracking(), run.device
    with run.timed("motions"), run.progress.phase("motions for a flow") as report:
        learned, judged = source.increments(report=report)
    parts = {"x_offset": learned.x.mean(0), "x_scale": spread(learned.x)} | parts
    offset, scale = parts["x_offset"], parts["x_scale"]  # a source that gives x_scale gives process noise in that unit
    u_scale = np.abs(learned.u).max(0, initial=0.0)
    u_scale = np.where(u_scale > 0, u_scale, 1.0)
    inputs = np.column_stack([(learned.x - offset) / scale, learned.u / u_scale])
    change, affine = learned.change / scale, np.column_stack([np.ones(len(inputs)), inputs])
    linear = np.linalg.lstsq(affine, change, rcond=None)[0].T
    rest = change - affine @ linear.T
    gain = rest.std(0)
    rest /= np.where(gain > 0, gain, 1.0)
    network = Network(inputs.shape[1], rest.shape[1], width=WIDTH, depth=DEPTH, activation="tanh").to(device)
    weight = 1.0 / ((rest**2).mean(-1) + LEAST)
    samples, targets, weights = (tensor(each, device) for each in (inputs, rest, weight))

    def loss(generator: torch.Generator) -> dict[str, torch.Tensor]:
        rows = torch.randint(len(samples), (BATCH,), generator=generator, device=device)
        square = (network(samples[rows]) - targets[rows]).square().mean(-1)
        loss = (weights[rows] * square).mean()
        return {"loss": loss, "error": loss.detach().sqrt()}

    run.minimise("flow", network, loss, run.config.flow_steps, learning_rate=LEARNING_RATE, optimiser="soap")
    flow, s = Flow(network.export(), linear, gain, u_scale), (judged.x - offset) / scale
    missed = np.abs(flow(s, judged.u) - s - judged.change / scale)
    error = np.maximum(OF_MEDIAN * np.median(missed, axis=0), LEAST_ERROR * np.sqrt(np.mean(change**2, axis=0)))
    return Motion(**parts | {"flow": flow, "error": error})
