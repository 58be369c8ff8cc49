"""The part of a certificate that needs a learned T: its risks, its residual and the paper's bounds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from examples.research.certificates.gains import envelope
from examples.research.certificates.generalisation import (
    forward_samples,
    generalisation_term,
    pseudo_dimension_bound,
)
from examples.research.certificates.segments import segment_lipschitz
from examples.research.certificates.settled import SettledTrajectories
from examples.research.certificates.smooth import Smooth, encoder
from kkl_gym.system import System
from observers import Artifact
from training.maps.forward import residual

QUANTILES = (0.5, 0.9, 0.99, 1.0)
AGES = (0.0, 1.0, 2.0, 5.0, 10.0)  # s at the pace of the shipped systems, at which the envelope is reported
SEGMENTS = 400  # recorded states at which T_inv is bounded between T(x) and z
DRAWN = 20_000  # states in X


@dataclass(frozen=True)
class Forward:
    """The part of a certificate that needs a learned forward map T.

    Risks "along the motion" are means over recorded states that no training saw: over the measure of the theorems on
    the observer, not over the samples S_1 and S_2 of the training.

    Shapes: ``residual_worst`` of length nx.
    """

    forward_risk: float
    pde_risk: float
    physics_risk: float
    reconstruction_risk: float
    reconstruction_risk_over_box: float
    propagated_risk: float
    residual: Mapping[float, float]
    residual_worst: tuple[float, ...]
    lipschitz_between: float
    steep_risk: float
    forward_samples: int
    forward_dimension: float
    forward_term: float
    start_error: float
    envelope: Mapping[float, float]
    forgets_start: float
    bound: float
    forward_share: float
    noisy_bound: float
    sharp_bound: float
    sharp_noisy_bound: float


@dataclass(frozen=True)
class Inverse:
    """A T_inv as its observer uses it at some noise, with an upper bound of its Lipschitz constant everywhere."""

    T_inv: Smooth
    lipschitz: float


def certify_forward(
    artifact: Artifact,
    system: System,
    recorded: SettledTrajectories,
    *,
    informed: Inverse,
    noise_free: Inverse,
    noise_error: float,
    psi: float,
    error: float,
    delta: float,
    rng: np.random.Generator,
) -> Forward | None:
    """Certify what rests on T; None if the artifact has no T."""
    if artifact.forward is None:
        return None
    T, T_inv, linear = encoder(artifact.forward), noise_free.T_inv, artifact.filter
    x = system.draw_starts(rng, DRAWN)
    size = np.linalg.norm(residual(artifact, system, x), axis=1)
    weight = float(artifact.training.get("physics_weight", 0.0))
    images, z = T(recorded.x), recorded.z
    data_losses = squared(z - images)
    forward_risk, pde_risk = float(data_losses.mean()), float(np.square(size).mean())
    physics_risk = forward_risk + weight * pde_risk
    dimension, samples = pseudo_dimension_bound(artifact.forward.mlp), forward_samples(artifact.training)
    largest = float(data_losses.max()) + weight * float(size.max()) ** 2

    same = informed.T_inv is noise_free.T_inv

    def sharp(used: Inverse) -> tuple[float, float, float, float]:
        some = np.linspace(0, len(z) - 1, min(SEGMENTS, len(z))).astype(int)
        between = np.minimum(segment_lipschitz(used.T_inv, images[some], z[some]), used.lipschitz)
        reconstruction = float(squared(recorded.x - used.T_inv(images)).mean())
        steep = float((between**2 * data_losses[some]).mean())
        return reconstruction, float(between.max()), steep, (math.sqrt(reconstruction) + math.sqrt(steep)) ** 2

    reconstruction_risk, lipschitz_between, steep_risk, sharp_bound = sharp(noise_free)
    informed_reconstruction, _, _, informed_sharp = (
        (reconstruction_risk, 0.0, 0.0, sharp_bound) if same else sharp(informed)
    )
    forward_part = 2 * noise_free.lipschitz**2 * physics_risk
    total = 2 * reconstruction_risk + forward_part
    informed_bound = 2 * (2 * informed_reconstruction + 2 * informed.lipschitz**2 * physics_risk)
    start_error = float(np.sqrt(squared(linear.start(system.output(x)) - T(x)).max()))
    ages = system.pace * np.array(AGES)
    left = envelope(linear, ages, start=start_error)
    added = noise_free.lipschitz * float(left[0])  # at first; it then decays with the slowest mode
    return Forward(
        forward_risk=forward_risk,
        pde_risk=pde_risk,
        physics_risk=physics_risk,
        reconstruction_risk=reconstruction_risk,
        reconstruction_risk_over_box=float(squared(x - T_inv(T(x))).mean()),
        propagated_risk=float(squared(T_inv(images) - T_inv(z)).mean()),
        residual={level: float(np.quantile(size, level)) for level in QUANTILES},
        residual_worst=tuple(x[size.argmax()].tolist()),
        lipschitz_between=lipschitz_between,
        steep_risk=steep_risk,
        forward_samples=samples,
        forward_dimension=dimension,
        forward_term=generalisation_term(largest, pseudo_dimension=dimension, samples=samples, delta=delta),
        start_error=start_error,
        envelope=dict(zip(ages.tolist(), left.tolist(), strict=True)),
        forgets_start=max(0.0, math.log(added / math.sqrt(error)) / linear.slowest) if added * error > 0 else math.inf,
        bound=2 * total,
        forward_share=forward_part / total if total > 0 else math.nan,
        noisy_bound=informed_bound + 2 * noise_error**2,
        sharp_bound=sharp_bound,
        sharp_noisy_bound=(psi + math.sqrt(informed_sharp) + noise_error) ** 2,
    )


def squared(difference: np.ndarray) -> np.ndarray:
    """Squared norms, (n, k) to (n,)."""
    return np.asarray(np.square(difference).sum(-1))
