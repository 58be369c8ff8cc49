"""How far to trust an observer: risks, sensitivities and the paper's bounds, from fresh samples."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from examples.research.certificates.forward import Forward, Inverse, certify_forward, squared
from examples.research.certificates.gains import controllability, h2, h_infinity, noise_variance, theorem_gain
from examples.research.certificates.generalisation import (
    generalisation_term,
    inverse_samples,
    pseudo_dimension_bound,
)
from examples.research.certificates.lipschitz import lipschitz_lower, lipschitz_upper, norm_product, output_lipschitz
from examples.research.certificates.settled import TRUNCATED, SettledTrajectories, record_settled
from examples.research.certificates.smooth import decoder
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from observers.checks import noise_levels
from training.evaluation.levels import Level, level_for
from training.evaluation.metrics import nrmse
from training.seeds import Stream, generator
from training.trajectories.motions import Controller


@dataclass(frozen=True)
class Certificate:
    """The result of :func:`certify`. Errors are of the whole state in its own units; bounds are of their squares.

    Shapes: ``measurement_noise`` of length ny, ``noise_bound`` of length ny, ``nrmse``, ``noisy_nrmse`` of length nx,
    ``lipschitz_at`` of length of the filter's state.
    """

    observer: str
    system: str
    measurement_noise: Level
    noise_bound: Level
    process_noise_bound: float
    psi: float
    samples: int
    error: float
    noisy_error: float
    nrmse: tuple[float, ...]
    noisy_nrmse: tuple[float, ...]
    lipschitz_lower: float
    lipschitz_at: tuple[float, ...]
    lipschitz_upper: float
    norm_product: float
    output_lipschitz: float
    controllability: float
    gain_theorem: float
    gain_h_infinity: float
    gain_h2: float
    noise_term: float
    predicted_noise_error: float
    measured_noise_error: float
    inverse_samples: int
    inverse_dimension: float
    inverse_term: float
    forward: Forward | None

    def as_json(self) -> dict[str, Any]:
        """For json.dumps; infinite values become None."""
        return {key: _plain(value) for key, value in asdict(self).items()}


def certify(
    artifact: Artifact,
    system: System,
    *,
    measurement_noise: Level | None = None,
    process_noise: float | None = None,
    psi: float | None = None,
    trajectories: int = 200,
    delta: float = 0.05,
    seed: int = 0,
    name: str = "",
    policy: Controller | None = None,
    recorded: SettledTrajectories | None = None,
) -> Certificate:
    """Bound how far an observer is to be trusted, on samples that its training never saw.

    The bounds are those of T_inv(z): of an observer that tracks, its T_inv alone is certified.

    Shapes: ``measurement_noise`` of length ny.
    """
    artifact.check(system.name, system.parameters, dt=artifact.filter.dt, ny=system.ny, nu=system.nu)
    artifact = replace(artifact, motion=None)
    process_noise = system.process_noise if process_noise is None else process_noise
    for what, value in (("process_noise", process_noise), ("psi", 0.0 if psi is None else psi)):
        if not 0 <= value < math.inf:
            raise ValueError(f"{what} must be finite and not negative, got {value!r}")
    if not isinstance(trajectories, int) or not isinstance(seed, int) or trajectories < 2 or seed < 0:
        raise ValueError(f"trajectories and seed must be integers, at least 2 and 0; got {trajectories!r}, {seed!r}")
    if not 0 < delta < 1:
        raise ValueError(f"delta must lie between 0 and 1, got {delta!r}")
    level = level_for(artifact, system, measurement_noise)
    KKLObserver(artifact, level)  # refuses a noise level that the map does not know
    noise: dict[str, Any] = {"measurement_noise": level, "process_noise": process_noise}
    if recorded is None:
        recorded = record_settled(artifact, system, **noise, trajectories=trajectories, seed=seed, policy=policy)
    measured, sample = recorded.halves()
    informed = decoder(artifact, **noise)
    lower, at = lipschitz_lower(informed, recorded.z)
    upper = lipschitz_upper(informed)
    free = decoder(artifact, 0.0)
    if all(map(np.array_equal, (*informed.mlp.weights, *informed.mlp.biases), (*free.mlp.weights, *free.mlp.biases))):
        free = informed  # a map without noise among its inputs is bounded once
    linear = artifact.filter
    gain = theorem_gain(linear)
    l_h = output_lipschitz(system, system.draw_starts(generator(Stream.CERTIFICATE, seed, 1), 2_000))
    noise_bound = np.multiply(TRUNCATED, np.broadcast_to(level, system.ny))
    if psi is None:
        everywhere = np.concatenate([recorded.x, recorded.noisy_x])
        psi = float(np.linalg.norm(np.ptp(everywhere, axis=0))) if process_noise else 0.0
    noise_error = upper * gain * (l_h * psi + math.hypot(*noise_bound))
    moved = informed(recorded.z + recorded.noise)
    x_hat, noisy_x_hat = free(measured.z), informed(measured.noisy_z)
    losses = squared(measured.x - x_hat)
    samples = inverse_samples(artifact.training)
    inverse_dimension = pseudo_dimension_bound((artifact.free_inverse or artifact.inverse).mlp)
    return Certificate(
        observer=name or f"{artifact.system} ({artifact.training.get('pipeline', 'unknown')})",
        system=system.name,
        measurement_noise=level,
        noise_bound=noise_levels("noise_bound", noise_bound, system.ny),
        process_noise_bound=process_noise * float(np.linalg.norm(system.scale)),
        psi=psi,
        samples=len(recorded.x),
        error=float(losses.mean()),
        noisy_error=float(squared(measured.noisy_x - noisy_x_hat).mean()),
        nrmse=_nrmse(measured.x, x_hat),
        noisy_nrmse=_nrmse(measured.noisy_x, noisy_x_hat),
        lipschitz_lower=lower,
        lipschitz_at=tuple(at.tolist()),
        lipschitz_upper=upper,
        norm_product=norm_product(informed),
        output_lipschitz=l_h,
        controllability=controllability(linear),
        gain_theorem=gain,
        gain_h_infinity=h_infinity(linear),
        gain_h2=h2(linear),
        noise_term=2 * noise_error**2,
        predicted_noise_error=float(np.sqrt(noise_variance(artifact, recorded.z, **noise).mean())),
        measured_noise_error=float(np.sqrt(squared(moved - informed(recorded.z)).mean())),
        inverse_samples=samples,
        inverse_dimension=inverse_dimension,
        inverse_term=generalisation_term(
            float(losses.max()), pseudo_dimension=inverse_dimension, samples=samples, delta=delta
        ),
        forward=certify_forward(
            artifact,
            system,
            sample,
            informed=Inverse(informed, upper),
            noise_free=Inverse(free, upper if free is informed or artifact.forward is None else lipschitz_upper(free)),
            noise_error=noise_error,
            psi=psi,
            error=float(losses.mean()),
            delta=delta,
            rng=generator(Stream.CERTIFICATE, seed, 2),
        ),
    )


def _nrmse(x: np.ndarray, x_hat: np.ndarray) -> tuple[float, ...]:
    """Of each state over all samples (n, nx), in percent."""
    return tuple(nrmse(x[:, None], x_hat[:, None])[0].tolist())


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, tuple | list) else value
