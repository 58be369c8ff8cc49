"""How far to trust an observer: risks, sensitivities and the paper's bounds, from fresh samples."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training.config import current_names
from training.evaluation.certificates.gains import h2, h_infinity, theorem_gain
from training.evaluation.certificates.generalisation import generalisation_term, pseudo_dimension_bound
from training.evaluation.certificates.lipschitz import lipschitz_lower, lipschitz_upper, norm_product
from training.filter_noise import stationary_covariance
from training.maps.smooth import Smooth, decoder, encoder, residual
from training.seeds import Stream, generator
from training.trajectories.noise import draw_process_noise

SETTLED = 1e-4  # part of the filter's start that is left where recording begins
RECORDED = 30.0  # seconds of each motion
EVERY = 10  # samples between recorded ones
TRUNCATED = 3.0  # standard deviations at which Gaussian noise is cut, for theorems about bounded noise
QUANTILES = (0.5, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Forward:
    """What is known where a forward map T was learned.

    data_risk : mean |z - T(x)|^2 along the motion.
    pde_risk : mean |P(x)|^2 of the PDE's residual P = dT/dx f - A T - B h over X.
    physics_risk : the sum of the first and the physics weight times the second, R_S1 (paper, eq. emp-risk-theta).
    reconstruction_risk : mean |x - T_inv(T(x))|^2 along the motion, R_S2 (paper, eq. emp-risk-eta).
    reconstruction_risk_over_box : the same uniformly over X.
    residual : quantiles of |P| over X, by their level.
    residual_worst : where in X it is largest, (nx,).
    forward_dimension, forward_term : bound of the pseudo-dimension of |z - T(x)|^2 (with the residual beside it, as in
        R_S1, it would be larger still), and C_theta with that.
    bound : the right-hand side of the paper's noise-free theorem without the terms C, 2 (2 R_S2 + 2 l^2 R_S1).
    noisy_bound : that of the noisy one, with the T_inv that is told the noise.
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

    observer, system : names.
    measurement_noise, noise_bound : standard deviation of the Gaussian noise, and where it is cut for the theorems.
    process_noise : bound of |w|, w uniform in a box and held over each sample.
    psi : bound of how far w may move the state; default: the diagonal of the box that the motions keep to.
    samples : number of states along the motion.
    error, noisy_error : mean |x - x_hat|^2 over motion and time, without noise and with v and w; on other motions than
        those that the risks are from.
    lipschitz_lower, lipschitz_at : largest spectral norm of T_inv's Jacobian along the motion, and z there.
    lipschitz_upper : no two z anywhere give more.
    norm_product : of the layers of T_inv, the bound that costs no work.
    output_lipschitz : largest norm of dh/dx at random points of X; where h is not linear there may be larger ones.
    gain_theorem, gain_h_infinity, gain_h2 : of the filter from noise to z, see :mod:`training.certificates.gains`.
    noise_term : what the theorem adds for noise, 2 l^2 gain^2 (l_h psi + sqrt(ny) v)^2.
    predicted_noise_error, measured_noise_error : rms of what noise alone does to the estimate, from the stationary
        covariance through the Jacobian, and by simulation.
    inverse_dimension, inverse_term : bound of the pseudo-dimension of T_inv's losses, and C_eta, the largest loss that
        was seen standing for the bound of all.
    forward : what needs a learned T; None where there is none.
    """

    observer: str
    system: str
    measurement_noise: float
    noise_bound: float
    process_noise: float
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


@dataclass(frozen=True)
class SettledTrajectories:
    """Where a system goes in the long run, with the filter beside it.

    x : states, (n, nx).
    z : of the filter under noise-free outputs, (n, size).
    noisy_x, noisy_z : the same under process noise and noisy outputs.
    noise : in z, due to the measurement noise alone, (n, size).
    motions : number of motions, each of whose samples follow one another.
    """

    x: np.ndarray
    z: np.ndarray
    noisy_x: np.ndarray
    noisy_z: np.ndarray
    noise: np.ndarray
    motions: int

    def halves(self) -> tuple["SettledTrajectories", "SettledTrajectories"]:
        """Two sets of motions."""
        first = self.motions // 2
        cut = first * (len(self.x) // self.motions)

        def part(rows: slice, motions: int) -> "SettledTrajectories":
            return SettledTrajectories(
                self.x[rows], self.z[rows], self.noisy_x[rows], self.noisy_z[rows], self.noise[rows], motions
            )

        return part(slice(cut), first), part(slice(cut, None), self.motions - first)


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
    motion: SettledTrajectories | None = None,
) -> Certificate:
    """Say how far an observer is to be trusted, on samples that its training never saw.

    Parameters
    ----------
    artifact : the observer.
    system : what it was made for, without input.
    measurement_noise : standard deviation of v; the theorems are about the same noise, cut at three of these.
    process_noise : bound of w as a multiple of the system's scale; None is the system's own default.
    psi : bound of how far w may move the state from where it would have been; None is the diagonal of the box that the
        simulated motions keep to, with w and without, which is what is left to say where they drift in phase or are
        chaotic.
    trajectories : from starts uniform in X.
    delta : probability with which each of the generalisation terms may fail.
    seed : of everything random.
    name : of the observer, for the report.
    motion : what :func:`record_settled` returned for the same observer, system, noise and seed, if it is there already.

    Raises
    ------
    ValueError : if a number makes no sense, the noise is beyond what the map was trained for, or too many motions
        leave the system's bounds; :class:`observers.ArtifactError` (a ValueError) if the observer was made for another
        system.
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
    levels = (measurement_noise, process_noise)
    if motion is None:
        motion = record_settled(artifact, system, levels, trajectories=trajectories, seed=seed)
    measured, sample = motion.halves()
    told, quiet = decoder(artifact, *levels), decoder(artifact, 0.0)
    lower, at = lipschitz_lower(told, motion.z)
    upper = lipschitz_upper(told)
    linear = artifact.filter
    gain = theorem_gain(linear)
    l_h = output_lipschitz(system, seed)
    noise_bound = TRUNCATED * measurement_noise
    if psi is None:
        everywhere = np.concatenate([motion.x, motion.noisy_x])
        psi = float(np.linalg.norm(np.ptp(everywhere, axis=0))) if process_noise else 0.0
    noise_term = 2 * (upper * gain * (l_h * psi + math.sqrt(system.ny) * noise_bound)) ** 2
    losses = _squared(measured.x - quiet(measured.z))
    inverse_dimension = pseudo_dimension_bound((artifact.free_inverse or artifact.inverse).mlp)
    seen = _training_samples(artifact)
    return Certificate(
        observer=name or f"{artifact.system} ({current_names(artifact.training).get('pipeline', 'unknown')})",
        system=system.name,
        measurement_noise=measurement_noise,
        noise_bound=noise_bound,
        process_noise=process_noise * float(np.linalg.norm(system.scale)),
        psi=psi,
        samples=len(motion.x),
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
        predicted_noise_error=float(np.sqrt(noise_variance(artifact, motion.z, *levels).mean())),
        measured_noise_error=float(np.sqrt(_squared(told(motion.z + motion.noise) - told(motion.z)).mean())),
        inverse_dimension=inverse_dimension,
        inverse_term=generalisation_term(float(losses.max()), inverse_dimension, seen, delta),
        forward=_forward(artifact, system, sample, (quiet, told), upper, noise_term, delta, seed),
    )


def record_settled(
    artifact: Artifact,
    system: System,
    levels: tuple[float, float],
    *,
    trajectories: int,
    seed: int,
) -> SettledTrajectories:
    """Trajectories from starts uniform in X, from where the filter has forgotten its start.

    ``levels`` are of measurement noise and process noise; the other parameters are those of :func:`certify`.

    Raises ValueError if more than half of them leave the system's bounds.
    """
    measurement_noise, process_noise = levels
    rng = generator(Stream.CERTIFICATE, seed)
    linear = artifact.filter
    dt = linear.dt
    settled = -math.log(SETTLED) / float(np.abs(np.linalg.eigvals(linear.A).real).min())
    first = math.ceil(settled / dt)
    steps = first + round(RECORDED / dt)
    ages = np.arange(first, steps + 1, EVERY)
    x0 = rng.uniform(*system.box(), (trajectories, system.nx))
    x = noisy_x = simulate(system, x0, steps, dt)
    if process_noise:
        w = draw_process_noise(system, process_noise, trajectories, steps, rng)
        noisy_x = simulate(system, x0, steps, dt, w=w)
    inside = np.isfinite(x[-1]).all(-1) & np.isfinite(noisy_x[-1]).all(-1)
    if 2 * inside.sum() < trajectories:
        raise ValueError(
            f"only {inside.sum()} of {trajectories} motions of {steps * dt:g} s stayed within bounds = {system.bounds}"
        )
    x, noisy_x = x[:, inside], noisy_x[:, inside]
    white = rng.standard_normal((*x.shape[:2], system.ny))
    v = measurement_noise * np.clip(white, -TRUNCATED, TRUNCATED)
    no_input = np.zeros((steps, x.shape[1], linear.nu))

    def recorded(values: np.ndarray) -> np.ndarray:  # motion by motion
        return np.asarray(np.moveaxis(values, 0, 1).reshape(-1, values.shape[-1]))

    def filtered(y: np.ndarray) -> np.ndarray:
        return recorded(linear.run(y, no_input, ages))

    return SettledTrajectories(
        x=recorded(x[ages]),
        z=filtered(system.output(x)),
        noisy_x=recorded(noisy_x[ages]),
        noisy_z=filtered(system.output(noisy_x) + v),
        noise=filtered(v),
        motions=x.shape[1],
    )


def noise_variance(
    artifact: Artifact, z: np.ndarray, measurement_noise: float, process_noise: float = 0.0
) -> np.ndarray:
    """Variance of the estimate due to stationary measurement noise, trace(J P J^T) at each z (n, size), (n,).

    P is the exact stationary covariance of z, J the Jacobian of T_inv: the noise to first order.
    """
    J = decoder(artifact, measurement_noise, process_noise).jacobian(z)
    P = measurement_noise**2 * stationary_covariance(artifact.filter)
    return np.asarray(np.einsum("nij,jk,nik->n", J, P, J))


def output_lipschitz(system: System, seed: int, n: int = 2000) -> float:
    """The largest spectral norm of dh/dx at random points of X, by central differences; exact where h is linear."""
    x = generator(Stream.CERTIFICATE, seed, 1).uniform(*system.box(), (n, system.nx))
    J = np.empty((n, system.ny, system.nx))
    for j, scale in enumerate(system.scale):
        step = 1e-5 * scale * np.eye(system.nx)[j]
        J[..., j] = (system.output(x + step) - system.output(x - step)) / (2e-5 * scale)
    return float(np.linalg.norm(J, ord=2, axis=(1, 2)).max())


def _forward(
    artifact: Artifact,
    system: System,
    motion: SettledTrajectories,
    inverses: tuple[Smooth, Smooth],
    lipschitz: float,
    noise_term: float,
    delta: float,
    seed: int,
) -> Forward | None:
    """``inverses`` : T_inv told that there is no noise, and told the noise, whose Lipschitz constant is given."""
    if artifact.forward is None:
        return None
    T, (quiet, told) = encoder(artifact.forward), inverses
    x = generator(Stream.CERTIFICATE, seed, 2).uniform(*system.box(), (20_000, system.nx))
    size = np.linalg.norm(residual(artifact, system, x), axis=1)
    weight = float(artifact.training.get("physics_weight", 0.0))
    data_losses = _squared(motion.z - T(motion.x))
    data_risk, pde_risk = float(data_losses.mean()), float(np.square(size).mean())
    physics_risk = data_risk + weight * pde_risk

    def bound(T_inv: Smooth, constant: float) -> float:
        reconstruction = float(_squared(motion.x - T_inv(T(motion.x))).mean())
        return 2 * (2 * reconstruction + 2 * constant**2 * physics_risk)

    same = all((a == b).all() for a, b in zip((*quiet.mlp.weights, *quiet.mlp.biases), (*told.mlp.weights, *told.mlp.biases)))
    dimension = pseudo_dimension_bound(artifact.forward.mlp)
    largest = float(data_losses.max()) + weight * float(size.max()) ** 2
    return Forward(
        data_risk=data_risk,
        pde_risk=pde_risk,
        physics_risk=physics_risk,
        reconstruction_risk=float(_squared(motion.x - quiet(T(motion.x))).mean()),
        reconstruction_risk_over_box=float(_squared(x - quiet(T(x))).mean()),
        residual={level: float(np.quantile(size, level)) for level in QUANTILES},
        residual_worst=tuple(x[size.argmax()].tolist()),
        forward_dimension=dimension,
        forward_term=generalisation_term(largest, dimension, _training_samples(artifact), delta),
        bound=bound(quiet, lipschitz if same else lipschitz_upper(quiet)),
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
