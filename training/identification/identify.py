"""From records of outputs to parameters, and what the outputs say of each: :func:`estimate_parameters`."""

import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch

from kkl_gym.system import System
from observers import Artifact, KKLObserver, LinearFilter
from observers.checks import is_finite, shown
from training.identification.consistency import HORIZON, ConsistencyProblem, Filtered, filtered, noise_level, run_filter
from training.identification.identifiability import combinations, hidden_directions, sign_symmetries, written
from training.identification.motions import Shooting
from training.identification.shooting import CLUSTERS, Fit, UnexplainedError, shoot
from training.identification.windows import LEAST_USED, MORE_COST, Guess, Prediction, fit_windows, predict
from training.jobs import describe
from training.maps.optimise import Log, Stage, optimise
from training.progress import ProgressBars
from training.records import Record, check_memory, check_signals, pieces
from training.spectrum import Spectrum, evenly_spaced

WIDTH, DEPTH, BATCH, STEPS, LEARNING_RATE = 128, 3, 512, 1500, 3e-3
RECORDED = 20  # batches between two values of the parameters that a report shows
HELD_OUT = 10  # every so many records one is left out of the fit, for tests of what it predicts
FORGOTTEN = 0.01  # part of the filter's start that may be left in a first guess of the state
LONGEST_MEMORY = 0.25  # of a record's length
FASTEST, FASTEST_OF_SAMPLES, SPREAD = 1.5, 0.5, 22.5  # modes: fastest over the rate, over 1/dt, and over the slowest
KEPT_RATIOS = 100.0  # by how much rather all parameters change by one factor than one of them alone, where y is silent
BACK = (1.0, 0.5, 0.25)  # parts of the way to the nearest parameters, where states would leave their bounds beyond
HANGS = 0.05  # relative change of a state that goes with parameters which y does not tell, over theirs
SIMULATED = 1e-7  # relative error that simulation leaves in any case
TOLD = 0.05  # part that a parameter may have in what the outputs do not tell, and count as told

Limits = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Product:
    """A product of powers of parameters that the outputs tell."""

    powers: dict[str, Fraction | float]
    value: float
    standard_error: float

    @property
    def text(self) -> str:
        """The product, such as ``a b^3``."""
        return written(self.powers)


@dataclass(frozen=True)
class Identified:
    """Parameters that records of outputs tell, and those that they do not."""

    system: System
    standard_errors: dict[str, float | None]
    products: list[Product]
    at_limits: tuple[str, ...]
    hanging_states: tuple[str, ...]
    symmetries: list[tuple[str, ...]]
    noise: np.ndarray
    expected_noise: np.ndarray
    fit: Fit
    predictions: list[Prediction]
    history: list[tuple[int, dict[str, float]]]

    def to_json(self) -> dict[str, dict[str, float | None]]:
        """Value and standard error of each parameter; both None where the outputs do not tell it."""
        return {
            name: {"value": None if error is None else self.system.parameters[name], "standard_error": error}
            for name, error in self.standard_errors.items()
        }

    def told(self) -> list[str]:
        """Lines for people: what was found, and what the outputs cannot tell."""
        lines = [
            f"{name} = {self.system.parameters[name]:.6g} +- {error:.2g}"
            for name, error in self.standard_errors.items()
            if error is not None
        ]
        lines += [f"{name} is at its limit: give it a wider range" for name in self.at_limits]
        if self.fit.coloured:
            lines.append(
                "the residuals are not white: the standard errors are those that windows show by their scatter"
            )
        elif self.fit.used.sum() < CLUSTERS:
            lines.append(f"fewer than {CLUSTERS} windows: the standard errors are right for white noise alone")
        silent = [name for name, error in self.standard_errors.items() if error is None]
        if silent:
            known = [
                product for product in self.products if len(product.powers) > 1 or set(product.powers) & set(silent)
            ]
            only = ", ".join(f"{one.text} = {one.value:.6g} +- {one.standard_error:.2g}" for one in known)
            lines.append(
                f"the outputs do not tell {', '.join(silent)} one by one"
                + (f": they tell {only} only" if only else ", nor any product of their powers")
            )
            used = ", ".join(f"{name} = {self.system.parameters[name]:.6g}" for name in silent)
            lines.append(
                f"the observer is made with {used}: nearest to what was given, of all that explain the outputs"
            )
            if self.hanging_states:
                lines.append(f"the size of {', '.join(self.hanging_states)} in its estimates hangs on that choice")
        lines += [
            f"the outputs stay the same if {', '.join(names)} change sign: which of both is true they cannot tell"
            for names in self.symmetries
        ]
        for j, (found, expected) in enumerate(zip(self.noise, self.expected_noise, strict=True)):
            if found > 1.5 * expected + 1e-3 * np.nanstd(self.fit.windows.y[..., j]):
                lines.append(
                    f"output {j + 1}: residuals of {found:.3g} where samples show noise of {expected:.3g}: the model "
                    "does not explain all of it"
                )
        return lines


def estimate_parameters(
    system: System,
    unknown: Limits,
    records: Sequence[Record],
    folder: Path,
    *,
    progress: ProgressBars,
    observer: Artifact | None = None,
    seed: int = 0,
    steps: int = STEPS,
    log: Log | None = None,
    resume: bool = False,
) -> Identified:
    """Find the parameters of a plant from records of its outputs.

    1. A network that makes states of a filter's state, and rough parameters, are trained on nothing but outputs and
       the equations (:mod:`training.identification.consistency`). An observer that is there already takes its place.
    2. Shooting refines parameters and states over windows of growing length, from the rough ones or from those given
       (:mod:`training.identification.windows`), and says how well each is known.
    3. What the outputs do not tell goes back to what was given, as far as they allow.
    """
    _check_unknown(system, unknown)
    check_signals(records, system)
    dt = float(records[0].t[1] - records[0].t[0])
    linear = _filter(system, records, dt, observer)
    first = math.ceil(min(memory(linear), LONGEST_MEMORY * np.median([record.duration for record in records])) / dt)
    least = first + 2 * HORIZON
    check_memory(records, least * dt, progress.say)
    whole = [record for record in pieces(records) if len(record.t) > least]
    if not whole:
        raise ValueError(
            f"no record has {least} samples, {least * dt:.3g} s, without a gap: the filter has to forget its start"
        )
    held_out = whole[HELD_OUT // 2 :: HELD_OUT] if len(whole) >= HELD_OUT // 2 else []
    fitted = [record for record in whole if not any(record is other for other in held_out)]
    given = np.array([system.parameters[name] for name in unknown])
    history: list[tuple[int, dict[str, float]]] = []
    guess: Guess
    if observer is None:
        system, guess, history = _self_consistent(
            system,
            unknown,
            filtered(fitted, linear, first),
            linear,
            folder,
            progress=progress,
            seed=seed,
            steps=steps,
            log=log,
            resume=resume,
        )
    else:
        guess = _estimates(observer, noise_level(fitted))
    with progress.phase("fitting parameters on windows"):
        rough = np.array([system.parameters[name] for name in unknown])
        unit = np.where(rough == 0, [0.1 * (high - low) for low, high in unknown.values()], np.abs(rough))
        shooting = Shooting(system, dt, unknown, unit)
        fit = fit_windows(
            shooting, [rough] if observer else [rough, given], fitted, guess, first=first, report=progress.say
        )
        fit = _brought_back(shooting, fit, given)
        found, length = np.array(list(fit.parameters.values())), len(fit.windows.y) - 1
        predictions = predict(shooting, found, held_out, guess, first=first, length=length)
    return _judged(fit, system, unknown, predictions=predictions, history=history, expected_noise=noise_level(fitted))


def _check_unknown(system: System, unknown: Limits) -> None:
    """Raise ValueError unless some of the system's parameters are unknown, and start between finite limits."""
    if not unknown:
        raise ValueError("name a parameter that is unknown, as in --unknown mu=1.5")
    for name, (low, high) in unknown.items():
        if name not in system.parameters:
            raise ValueError(
                f"{system.name} has no parameter {shown(name)}; it has {', '.join(system.parameters) or 'none'}"
            )
        value = system.parameters[name]
        if not (is_finite(low) and is_finite(high) and low < high and low <= value <= high):
            raise ValueError(f"{name} must start between finite limits, got {value:g} in {shown(low)} to {shown(high)}")


def _filter(system: System, records: Sequence[Record], dt: float, observer: Artifact | None) -> LinearFilter:
    """That of the observer, or one that forgets its start within a part of the records; inputs as recorded."""
    if observer is not None:
        return observer.filter
    duration = float(np.median([record.duration for record in records]))
    slowest = math.log(1 / FORGOTTEN) / (LONGEST_MEMORY * duration)
    fastest = min(FASTEST * system.typical_rate, FASTEST_OF_SAMPLES / dt)
    slowest = min(max(slowest, fastest / SPREAD), fastest / 2)
    nu = 0 if records[0].u is None else system.nu
    return Spectrum(evenly_spaced(4 * system.nx + 3, -slowest, -fastest)).filter(system.ny, dt, nu)


def memory(linear: LinearFilter) -> float:
    """Seconds after which a filter has forgotten its start well enough for a first guess of the state."""
    return math.log(1 / FORGOTTEN) / linear.slowest


def _self_consistent(
    system: System,
    unknown: Limits,
    data: Filtered,
    linear: LinearFilter,
    folder: Path,
    *,
    progress: ProgressBars,
    seed: int,
    steps: int,
    log: Log | None,
    resume: bool,
) -> tuple[System, Guess, list[tuple[int, dict[str, float]]]]:
    """The system with rough parameters, a network's estimates by record and sample, and the parameters' course."""
    torch.manual_seed(seed)
    problem = ConsistencyProblem(system, unknown, data, linear=linear, width=WIDTH, depth=DEPTH, batch=BATCH)
    digest = hashlib.sha256(json.dumps(describe(system), sort_keys=True).encode())
    for y in data.y:
        digest.update(y.tobytes())
    stage = Stage(
        name="consistency",
        steps=steps,
        learning_rate=LEARNING_RATE,
        folder=folder,
        fingerprint=digest.hexdigest()[:16],
        seed=seed,
        optimiser="soap",
    )
    course: list[tuple[int, dict[str, float]]] = []
    batches = itertools.count()

    def loss(generator: torch.Generator) -> dict[str, torch.Tensor]:
        batch = next(batches)
        if batch % RECORDED == 0:
            course.append((batch, problem.parameters_found()))
        return problem.loss(generator)

    optimise(stage, problem, loss, progress, log=log, resume=resume)
    found = problem.parameters_found()
    progress.say("by self-consistency: " + ", ".join(f"{name} = {value:.4g}" for name, value in found.items()))

    def guess(record: Record, at: np.ndarray) -> np.ndarray:
        return problem.estimate(run_filter(record, linear, at))

    return system.replace(found), guess, [*course, (steps, found)]


def _estimates(observer: Artifact, noise: np.ndarray) -> Guess:
    """What an observer estimates in a record."""
    observer = replace(observer, flow=None)  # which is of its own plant
    level = observer.inverse.within(np.minimum(noise, np.max(observer.inverse.measurement_noise_max)))

    def guess(record: Record, at: np.ndarray) -> np.ndarray:
        u = np.zeros((len(record.t), observer.nu)) if record.u is None else record.u
        x_hat = KKLObserver(observer, level).estimate(record.y[:, None], u[:-1, None] if observer.nu else None)
        return np.asarray(x_hat[at, 0])

    return guess


def nearest(values: np.ndarray, given: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Of all parameters that explain the outputs as well, those nearest to what was given.

    A parameter of which they say nothing at all stays as it was given. Of the others near is what keeps their ratios to
    each other: a plant that is faster by a factor has them all larger.

    Shapes: ``values`` (p,), ``given`` (p,), ``hidden`` (p, k); returns (p,).
    """
    silent = (hidden**2).sum(1) > 1.0 - TOLD**2
    if silent.any():
        rest = np.linalg.svd(hidden[~silent])[0][:, : hidden.shape[1] - silent.sum()]
        nearer = given.copy()
        nearer[~silent] = nearest(values[~silent], given[~silent], rest)
        return nearer
    if not hidden.size:
        return values
    p = len(values)
    comparable = values * given > 0
    moved = np.log(np.where(comparable, values / np.where(comparable, given, 1.0), 1.0))
    metric = np.eye(p) - KEPT_RATIOS / (1.0 + KEPT_RATIOS * p)
    back = hidden @ np.linalg.solve(hidden.T @ metric @ hidden, hidden.T @ metric @ moved)
    return np.where(comparable, values * np.exp(-back), values)


def _brought_back(shooting: Shooting, fit: Fit, given: np.ndarray) -> Fit:
    """What explains the records as well, with parameters as near to what was given as the system's bounds allow."""
    values, hidden = np.array(list(fit.parameters.values())), hidden_directions(fit.relative_information)
    if not hidden.size:
        return fit
    near = np.clip(nearest(values, given, hidden), shooting.low, shooting.high)
    for share in BACK:
        try:
            found = shoot(shooting, values + share * (near - values), fit.windows)
        except UnexplainedError:
            continue
        if found.used.sum() >= LEAST_USED * fit.used.sum() and found.cost <= MORE_COST * fit.cost + SIMULATED**2:
            return found
    return fit


def _judged(
    fit: Fit,
    system: System,
    unknown: Limits,
    *,
    predictions: list[Prediction],
    history: list[tuple[int, dict[str, float]]],
    expected_noise: np.ndarray,
) -> Identified:
    """What the fit says of each parameter."""
    names, hidden = tuple(unknown), hidden_directions(fit.relative_information)
    values = np.array(list(fit.parameters.values()))
    told = np.abs(hidden).max(1, initial=0.0) < TOLD
    seen = np.linalg.svd(hidden)[0][:, hidden.shape[1] :] if hidden.size else np.eye(len(names))

    def relative_error(exponents: np.ndarray) -> float:
        """Of a product of powers."""
        found = fit.errors((exponents / fit.size)[:, None], seen * fit.size[:, None])
        return max(float(found[0]), SIMULATED)

    errors = {
        name: float(fit.unit[i] * fit.size[i] * relative_error(np.eye(len(names))[i])) if told[i] else None
        for i, name in enumerate(names)
    }
    products = []
    for powers in combinations(names, hidden):
        exponents = np.array([float(powers.get(name, 0)) for name in names])
        value = float(np.prod(np.where(exponents, np.sign(values) * np.abs(values) ** exponents, 1.0)))
        products.append(Product(powers, value, abs(value) * relative_error(exponents)))
    found = system.replace(fit.parameters)
    return Identified(
        system=found,
        standard_errors=errors,
        products=products,
        at_limits=tuple(name for name, value in fit.parameters.items() if value in unknown[name] and errors[name]),
        hanging_states=_hanging(fit, found, hidden * fit.size[:, None]),
        symmetries=sign_symmetries(
            found,
            [name for name in names if unknown[name][0] <= -found.parameters[name]],
            driven=bool(fit.windows.u.any()),
        ),
        noise=fit.noise,
        expected_noise=expected_noise,
        fit=fit,
        predictions=predictions,
        history=history,
    )


def _hanging(fit: Fit, system: System, hidden: np.ndarray) -> tuple[str, ...]:
    """States that change with directions (p, k) of parameters, in their units, that the outputs do not tell."""
    if not hidden.size:
        return ()
    half = np.array([(high - low) / 2 for low, high in system.X])
    size = np.sqrt(np.mean((fit.windows.x0 / half) ** 2, axis=0))
    change = np.sqrt(np.median((fit.starts_by_parameters @ hidden) ** 2, axis=0)).max(1)
    return tuple(name for name, part in zip(system.state_names, change / size, strict=True) if part > HANGS)
