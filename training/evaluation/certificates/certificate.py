"""How far to trust an observer: risks, sensitivities and the paper's bounds, from fresh samples."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.config import current_names
from training.evaluation.certificates.gains import h2, h_infinity, noise_variance, theorem_gain
from training.evaluation.certificates.generalisation import generalisation_term, pseudo_dimension_bound
from training.evaluation.certificates.lipschitz import lipschitz_lower, lipschitz_upper, norm_product, output_lipschitz
from training.evaluation.certificates.settled import TRUNCATED, SettledTrajectories, record_settled
from training.maps.smooth import Smooth, decoder, encoder, residual
from training.seeds import Stream, generator

QUANTILES = (0.5, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Forward:
    """What is known where a forward map T was learned.

    Parameters
    ----------
    data_risk : float
        Mean |z - T(x)|^2 along the trajectories.
    pde_risk : float
        Mean |P(x)|^2 of the PDE's residual P = dT/dx f - A T - B h over X.
    physics_risk : float
        ``data_risk`` plus the physics weight times ``pde_risk``, R_S1 (paper, eq. emp-risk-theta).
    reconstruction_risk : float
        Mean |x - T_inv(T(x))|^2 along the trajectories, R_S2 (paper, eq. emp-risk-eta).
    reconstruction_risk_over_box : float
        The same uniformly over X.
    residual : mapping of float to float
        Quantiles of |P| over X, by their level.
    residual_worst : tuple of float, length nx
        Where in X it is largest.
    forward_dimension : float
        Bound of the pseudo-dimension of |z - T(x)|^2; with the residual beside it, as in R_S1, it would be larger
        still.
    forward_term : float
        The term C_theta with that.
    bound : float
        Right-hand side of the paper's noise-free theorem without the terms C, 2 (2 R_S2 + 2 l^2 R_S1).
    noisy_bound : float
        Right-hand side of the theorem on noise, with the T_inv that is told the noise.
    """

    data_risk: float
    pde_risk: float
    physics_risk: float
    reconstruction_risk: float
    reconstruction_risk_over_box: float
    residual: Mapping[float, float]
    residual_worst: tuple[float, ...]
    forward_dimension: float
    forward_term: float
    bound: float
    noisy_bound: float


@dataclass(frozen=True)
class Certificate:
    """What :func:`certify` found. Errors are of the whole state in its own units; bounds are of their squares.

    Parameters
    ----------
    observer : str
        Its name.
    system : str
        The name of what it observes.
    measurement_noise : float
        Standard deviation of the Gaussian noise on y.
    noise_bound : float
        Where that noise is cut for the theorems.
    process_noise_bound : float
        Bound of |w| in units of the state per second; w is uniform in a box and held over each sample.
    psi : float
        Bound of how far w may move the state; by default the diagonal of the box that the trajectories keep to.
    samples : int
        Number of states along the trajectories.
    error : float
        Mean |x - x_hat|^2 over trajectories and time without noise, on other trajectories than those that the risks are
        from.
    noisy_error : float
        The same with v and w.
    lipschitz_lower : float
        Largest spectral norm of T_inv's Jacobian along the trajectories.
    lipschitz_at : tuple of float, length of the filter's state
        The z where it is.
    lipschitz_upper : float
        No two z anywhere give more.
    norm_product : float
        Of the layers of T_inv, the bound that costs no work.
    output_lipschitz : float
        Largest norm of dh/dx at random points of X; where h is not linear there may be larger ones.
    gain_theorem, gain_h_infinity, gain_h2 : float
        Of the filter from noise to z, see :mod:`training.evaluation.certificates.gains`.
    noise_term : float
        What the theorem adds for noise, 2 l^2 gain^2 (l_h psi + sqrt(ny) v)^2.
    predicted_noise_error : float
        Rms of what measurement noise alone does to the estimate, from the stationary covariance through the Jacobian.
    measured_noise_error : float
        The same by simulation.
    inverse_dimension : float
        Bound of the pseudo-dimension of T_inv's losses.
    inverse_term : float
        The term C_eta, the largest loss that was seen standing for the bound of all.
    forward : Forward or None
        What needs a learned T; None where there is none.
    """

    observer: str
    system: str
    measurement_noise: float
    noise_bound: float
    process_noise_bound: float
    psi: float
    samples: int
    error: float
    noisy_error: float
    lipschitz_lower: float
    lipschitz_at: tuple[float, ...]
    lipschitz_upper: float
    norm_product: float
    output_lipschitz: float
    gain_theorem: float
    gain_h_infinity: float
    gain_h2: float
    noise_term: float
    predicted_noise_error: float
    measured_noise_error: float
    inverse_dimension: float
    inverse_term: float
    forward: Forward | None

    def as_json(self) -> dict[str, Any]:
        """For json.dumps; what is infinite becomes None."""
        return {key: _plain(value) for key, value in asdict(self).items()}


def certify(
    artifact: Artifact,
    system: System,
    *,
    measurement_noise: float = 0.5,
    process_noise: float | None = None,
    psi: float | None = None,
    trajectories: int = 200,
    delta: float = 0.05,
    seed: int = 0,
    name: str = "",
    recorded: SettledTrajectories | None = None,
) -> Certificate:
    """Say how far an observer is to be trusted, on samples that its training never saw.

    Parameters
    ----------
    artifact : Artifact
        The observer.
    system : System
        What it was made for, without input.
    measurement_noise : float, default 0.5
        Standard deviation of v; the theorems are about the same noise, cut at three of these.
    process_noise : float, optional
        Bound of w in multiples of the system's scale per second; by default the system's own.
    psi : float, optional
        Bound of how far w may move the state from where it would have been. By default the diagonal of the box that the
        simulated trajectories keep to, with w and without; no less can be said where they drift in phase or are
        chaotic.
    trajectories : int, default 200
        From starts uniform in X.
    delta : float, default 0.05
        Probability with which each of the generalisation terms may fail.
    seed : int, default 0
        Of everything random.
    name : str, optional
        Of the observer, for the report.
    recorded : SettledTrajectories, optional
        What :func:`record_settled` returned for the same observer, system, noise and seed, if it is there already.

    Returns
    -------
    Certificate
        What was found.

    Raises
    ------
    ValueError
        If a number makes no sense, the noise is beyond what the map was trained for, h does not take sympy symbols, or
        too many trajectories leave the system's bounds.
    observers.ArtifactError
        If the observer was made for another system; also a ValueError.
    """
    artifact.check(system.name, system.parameters, dt=artifact.filter.dt, ny=system.ny, nu=system.nu)
    process_noise = system.process_noise if process_noise is None else process_noise
    for what, value in (("process_noise", process_noise), ("psi", 0.0 if psi is None else psi)):
        if not 0 <= value < math.inf:
            raise ValueError(f"{what} must be finite and not negative, got {value!r}")
    if not isinstance(trajectories, int) or not isinstance(seed, int) or trajectories < 2 or seed < 0:
        raise ValueError(f"trajectories and seed must be integers, at least 2 and 0; got {trajectories!r}, {seed!r}")
    if not 0 < delta < 1:
        raise ValueError(f"delta must lie between 0 and 1, got {delta!r}")
    KKLObserver(artifact, measurement_noise)  # refuses a noise level that the map does not know
    noise = {"measurement_noise": measurement_noise, "process_noise": process_noise}
    if recorded is None:
        recorded = record_settled(artifact, system, **noise, trajectories=trajectories, seed=seed)
    measured, sample = recorded.halves()
    told, noise_free = decoder(artifact, **noise), decoder(artifact, 0.0)
    lower, at = lipschitz_lower(told, recorded.z)
    upper = lipschitz_upper(told)
    linear = artifact.filter
    gain = theorem_gain(linear)
    l_h = output_lipschitz(system, generator(Stream.CERTIFICATE, seed, 1).uniform(*system.box(), (2_000, system.nx)))
    noise_bound = TRUNCATED * measurement_noise
    if psi is None:
        everywhere = np.concatenate([recorded.x, recorded.noisy_x])
        psi = float(np.linalg.norm(np.ptp(everywhere, axis=0))) if process_noise else 0.0
    noise_term = 2 * (upper * gain * (l_h * psi + math.sqrt(system.ny) * noise_bound)) ** 2
    losses = _squared(measured.x - noise_free(measured.z))
    inverse_dimension = pseudo_dimension_bound((artifact.free_inverse or artifact.inverse).mlp)
    return Certificate(
        observer=name or f"{artifact.system} ({current_names(artifact.training).get('pipeline', 'unknown')})",
        system=system.name,
        measurement_noise=measurement_noise,
        noise_bound=noise_bound,
        process_noise_bound=process_noise * float(np.linalg.norm(system.scale)),
        psi=psi,
        samples=len(recorded.x),
        error=float(losses.mean()),
        noisy_error=float(_squared(measured.noisy_x - told(measured.noisy_z)).mean()),
        lipschitz_lower=lower,
        lipschitz_at=tuple(at.tolist()),
        lipschitz_upper=upper,
        norm_product=norm_product(told),
        output_lipschitz=l_h,
        gain_theorem=gain,
        gain_h_infinity=h_infinity(linear),
        gain_h2=h2(linear),
        noise_term=noise_term,
        predicted_noise_error=float(np.sqrt(noise_variance(artifact, recorded.z, **noise).mean())),
        measured_noise_error=float(np.sqrt(_squared(told(recorded.z + recorded.noise) - told(recorded.z)).mean())),
        inverse_dimension=inverse_dimension,
        inverse_term=generalisation_term(
            float(losses.max()), pseudo_dimension=inverse_dimension, samples=_training_samples(artifact), delta=delta
        ),
        forward=_forward(
            artifact,
            system,
            sample,
            told=told,
            noise_free=noise_free,
            lipschitz=upper,
            noise_term=noise_term,
            delta=delta,
            seed=seed,
        ),
    )


def _forward(
    artifact: Artifact,
    system: System,
    recorded: SettledTrajectories,
    *,
    told: Smooth,
    noise_free: Smooth,
    lipschitz: float,
    noise_term: float,
    delta: float,
    seed: int,
) -> Forward | None:
    """What a learned T allows to say of T_inv told the noise, with its Lipschitz constant, and of T_inv told none."""
    if artifact.forward is None:
        return None
    T = encoder(artifact.forward)
    x = generator(Stream.CERTIFICATE, seed, 2).uniform(*system.box(), (20_000, system.nx))
    size = np.linalg.norm(residual(artifact, system, x), axis=1)
    weight = float(artifact.training.get("physics_weight", 0.0))
    data_losses = _squared(recorded.z - T(recorded.x))
    data_risk, pde_risk = float(data_losses.mean()), float(np.square(size).mean())
    physics_risk = data_risk + weight * pde_risk

    def bound(T_inv: Smooth, constant: float) -> float:
        reconstruction = float(_squared(recorded.x - T_inv(T(recorded.x))).mean())
        return 2 * (2 * reconstruction + 2 * constant**2 * physics_risk)

    same = all(
        (a == b).all()
        for a, b in zip((*told.mlp.weights, *told.mlp.biases), (*noise_free.mlp.weights, *noise_free.mlp.biases))
    )
    dimension = pseudo_dimension_bound(artifact.forward.mlp)
    largest = float(data_losses.max()) + weight * float(size.max()) ** 2
    return Forward(
        data_risk=data_risk,
        pde_risk=pde_risk,
        physics_risk=physics_risk,
        reconstruction_risk=float(_squared(recorded.x - noise_free(T(recorded.x))).mean()),
        reconstruction_risk_over_box=float(_squared(x - noise_free(T(x))).mean()),
        residual={level: float(np.quantile(size, level)) for level in QUANTILES},
        residual_worst=tuple(x[size.argmax()].tolist()),
        forward_dimension=dimension,
        forward_term=generalisation_term(
            largest, pseudo_dimension=dimension, samples=_training_samples(artifact), delta=delta
        ),
        bound=bound(noise_free, lipschitz if same else lipschitz_upper(noise_free)),
        noisy_bound=bound(told, lipschitz) + noise_term,
    )


def _training_samples(artifact: Artifact) -> int:
    """Pairs that training recorded, as far as the artifact says."""
    trained = artifact.training
    return int(trained.get("trajectories", 0)) * int(trained.get("samples", 0))


def _squared(difference: np.ndarray) -> np.ndarray:
    return np.asarray(np.square(difference).sum(-1))


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, tuple | list) else value
