"""Estimates parameters and their standard errors from records of outputs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from kkl_gym.system import System
from observers.checks import is_finite, shown
from training.identification.identifiability import combinations, sign_symmetries, unidentifiable_directions, written
from training.identification.motions import SAMPLES_PER_STATE, Shooting
from training.identification.shooting import CLUSTERS, Fit, UnexplainedError, shoot
from training.identification.windows import LEAST_USED, MORE_COST, Prediction, fit_windows, noise_level, predict
from training.progress import ProgressBars
from training.records import Record, check_signals, pieces

HELD_OUT = 10  # of the sufficiently long pieces of records between gaps, the 6th, 16th, 26th, ... are held out
KEPT_RATIOS = 100.0  # prior variance of log(common factor of all parameters), over that of log(each one's own factor)
BACK = (1.0, 0.5, 0.25)  # shares of the way to nearest(...), tried until one leaves the fit about as good
UNSCALED = 0.05  # a state's scale is unidentifiable if its relative change exceeds this share of the parameters' change
SIMULATED = 1e-7  # relative error of the simulation, a lower bound of relative standard errors
HIDDEN = 0.05  # a parameter is unidentifiable if its component of an unidentifiable direction is at least this

Limits = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Product:
    """An identifiable product of powers of parameters."""

    powers: dict[str, Fraction | float]
    value: float
    standard_error: float

    @property
    def text(self) -> str:
        """The product as text, such as ``a b^3``."""
        return written(self.powers)


@dataclass(frozen=True)
class Identified:
    """Parameters identified from records of outputs; the ``standard_errors`` of unidentifiable ones are None."""

    system: System
    standard_errors: dict[str, float | None]
    products: list[Product]
    at_limits: tuple[str, ...]
    unscaled_states: tuple[str, ...]
    symmetries: list[tuple[str, ...]]
    noise: np.ndarray
    expected_noise: np.ndarray
    fit: Fit
    predictions: list[Prediction]

    def to_json(self) -> dict[str, dict[str, float | None]]:
        """Return the value and standard error of each parameter; both are None if it is not identifiable."""
        return {
            name: {"value": None if error is None else self.system.parameters[name], "standard_error": error}
            for name, error in self.standard_errors.items()
        }

    def summary(self) -> list[str]:
        """Return lines of text: parameters and products with standard errors, and the unidentifiable parameters."""
        values = self.system.parameters
        lines = [f"{name} = {values[name]:.6g} +- {e:.2g}" for name, e in self.standard_errors.items() if e is not None]
        lines += [f"{name} is at its limit: give it a wider range" for name in self.at_limits]
        if self.fit.coloured:
            lines.append("the residuals are not white: the standard errors come from the scatter between windows")
        elif self.fit.used.sum() < CLUSTERS:
            lines.append(f"fewer than {CLUSTERS} windows: the standard errors hold only for white noise")
        hidden = [name for name, error in self.standard_errors.items() if error is None]
        if hidden:
            known = [one for one in self.products if len(one.powers) > 1 or set(one.powers) & set(hidden)]
            only = ", ".join(f"{one.text} = {one.value:.6g} +- {one.standard_error:.2g}" for one in known)
            lines.append(f"not identifiable from the outputs: {', '.join(hidden)}" + (f"; only {only}" if only else ""))
            used = ", ".join(f"{name} = {values[name]:.6g}" for name in hidden)
            lines.append(f"the observer uses {used}: other values fit too, but these are near the first guesses")
            if self.unscaled_states:
                lines.append(f"the scale of {', '.join(self.unscaled_states)} is not identifiable: these values set it")
        lines += [
            f"a common change of sign of {', '.join(names)} leaves the outputs the same: the signs are not identifiable"
            for names in self.symmetries
        ]
        for j, (noise, expected) in enumerate(zip(self.noise, self.expected_noise, strict=True)):
            if noise > 1.5 * expected + 1e-3 * np.nanstd(self.fit.windows.y[..., j]):
                excess = f"residuals of {noise:.3g} exceed the noise of {expected:.3g}"
                lines.append(f"output {j + 1}: {excess}: the model does not explain the output completely")
        return lines


def estimate_parameters(
    system: System, unknown: Limits, records: Sequence[Record], *, progress: ProgressBars, seed: int = 0
) -> Identified:
    """Estimate unknown parameters of a system from records of its outputs.

    Multiple shooting fits the parameters, and the windows' initial states, on windows of growing length
    (:func:`fit_windows`). Along unidentifiable directions the parameters then return towards the first guesses.
    """
    _check_unknown(system, unknown)
    check_signals(records, system)
    least = SAMPLES_PER_STATE * system.nx
    whole = [record for record in pieces(records) if len(record.t) > least]
    if not whole:
        raise ValueError(f"no record has more than {least} samples without a gap: a fit of an initial state needs more")
    held_out = whole[HELD_OUT // 2 :: HELD_OUT]
    fitted = [record for record in whole if not any(record is other for other in held_out)]
    rng, dt = np.random.default_rng(seed), float(records[0].t[1] - records[0].t[0])
    given = np.array([system.parameters[name] for name in unknown])
    unit = np.where(given == 0, [0.1 * (high - low) for low, high in unknown.values()], np.abs(given))
    with progress.phase("fitting parameters on windows", 100) as done:
        shooting = Shooting(system, dt, unknown, unit)
        fit = fit_windows(shooting, fitted, rng, say=progress.say, report=lambda part: done(100 * part))
        fit = _brought_back(fit, given)
        predictions = predict(fit, held_out, rng)
    return _judged(fit, system, unknown, predictions=predictions, expected_noise=noise_level(fitted))


def _check_unknown(system: System, unknown: Limits) -> None:
    """Raise ValueError unless parameters are named, the system has them, and finite limits enclose their values."""
    if not unknown:
        raise ValueError("name an unknown parameter, as in --unknown mu=1.5 or unknown={'mu': (0.15, 15)}")
    for name, (low, high) in unknown.items():
        if name not in system.parameters:
            known = ", ".join(system.parameters) or "no parameters"
            raise ValueError(f"{system.name} has no parameter {shown(name)}; it has {known}")
        value = system.parameters[name]
        if not (is_finite(low) and is_finite(high) and low < high and low <= value <= high):
            raise ValueError(f"{name} = {value:g} must lie between finite limits, got {shown(low)} and {shown(high)}")


def nearest(values: np.ndarray, given: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Return the parameters nearest to ``given`` among all that explain the outputs as well as ``values`` do.

    Parameters without influence on the outputs become ``given``; those of another sign than ``given`` keep ``values``.
    For the rest, the distance weighs changed ratios heavily, and a common factor, as of a faster plant, lightly.

    Shapes: ``values`` (p,), ``given`` (p,), unidentifiable directions ``hidden`` (p, k); returns (p,).
    """
    silent = (hidden**2).sum(1) > 1.0 - HIDDEN**2
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


def _brought_back(fit: Fit, given: np.ndarray) -> Fit:
    """Return a fit about as good as ``fit`` with parameters nearer to ``given``, or ``fit`` itself."""
    shooting, values, hidden = fit.shooting, fit.theta, unidentifiable_directions(fit.relative_information)
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
    expected_noise: np.ndarray,
) -> Identified:
    """Return the result of a fit: standard errors, products, symmetries and predictions."""
    names, hidden = tuple(unknown), unidentifiable_directions(fit.relative_information)
    values = fit.theta
    identifiable = np.abs(hidden).max(1, initial=0.0) < HIDDEN
    seen = np.linalg.svd(hidden)[0][:, hidden.shape[1] :] if hidden.size else np.eye(len(names))

    def relative_error(exponents: np.ndarray) -> float:
        """Return the relative standard error of the product of powers with these exponents."""
        found = fit.errors((exponents / fit.size)[:, None], seen * fit.size[:, None])
        return max(float(found[0]), SIMULATED)

    errors = {
        name: float(fit.unit[i] * fit.size[i] * relative_error(np.eye(len(names))[i])) if identifiable[i] else None
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
        unscaled_states=_unscaled(fit, found, hidden * fit.size[:, None]),
        symmetries=sign_symmetries(
            found,
            [name for name in names if unknown[name][0] <= -found.parameters[name]],
            driven=bool(fit.windows.u.any()),
        ),
        noise=fit.noise,
        expected_noise=expected_noise,
        fit=fit,
        predictions=predictions,
    )


def _unscaled(fit: Fit, system: System, hidden: np.ndarray) -> tuple[str, ...]:
    """Return the states whose scale changes along unidentifiable directions ``hidden`` (p, k) of the parameters."""
    if not hidden.size:
        return ()
    half = np.array([(high - low) / 2 for low, high in system.X])
    size = np.sqrt(np.mean((fit.windows.x0 / half) ** 2, axis=0))
    change = np.sqrt(np.median((fit.starts_by_parameters @ hidden) ** 2, axis=0)).max(1)
    return tuple(name for name, part in zip(system.state_names, change / size, strict=True) if part > UNSCALED)
