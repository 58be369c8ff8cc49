"""What a training run is made of, and the presets."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np

from kkl_gym.system import System
from training.optimise import Optimiser

Method = Literal["input-aware", "spinn"]
Preset = Literal["fast", "paper"]
CLOSED_LOOP = 2000  # trajectories of ``kkl-gym train --closed-loop``


@dataclass(frozen=True)
class Config:
    """A training run; together with the system it determines the artifact."""

    method: Method
    """"input-aware": T_inv(z_y, z_u) fitted along driven, noisy trajectories, transients included, and T_inv(z_y)
    along free ones.
    "spinn": the paper's pipeline, a physics-informed T and then T_inv on z' = T(x')."""
    eigenvalues: tuple[float, ...]
    """The real ones of A, in 1/s; B is all ones for each output."""
    pairs: tuple[tuple[float, float], ...] = ()
    """Complex ones beside them, (a, w) for each pair a +- iw: a in 1/s and negative, w in rad/s and positive. A slow
    pair averages the noise on a component of y that oscillates at its frequency, which real modes do not."""
    dt: float = 0.01
    """Sampling interval in seconds."""
    trajectories: int = 4000
    """Number of simulated trajectories."""
    duration: float = 50.0
    """Their length in seconds."""
    samples: int = 200
    """Points recorded along each trajectory (spinn: after t*)."""
    width: int = 128
    """Neurons in each hidden layer."""
    depth: int = 3
    """Number of hidden layers."""
    activation: Literal["tanh", "silu"] = "tanh"
    """Of the hidden layers."""
    optimiser: Optimiser = "adam"
    """Of all networks: "adam", or "soap", which needs a fraction of the batches."""
    batch: int = 4096
    """Samples in a batch (for the forward map: of data, and as many collocation points)."""
    learning_rate: float = 8e-3
    """At its highest; it decays to zero along a cosine."""
    forward_steps: int = 0
    """Batches for the forward map; the input-aware method has none."""
    inverse_steps: int = 30000
    """Batches for the inverse map."""
    features: int = 0
    """Random features of a forward map that is solved for by least squares instead of trained (spinn); 0 trains it."""
    reach: float = 1.0
    """Where a solved forward map holds and is inverted: along motions from this multiple of the training box."""
    physics_weight: float = 0.1
    """nu, the weight of the PDE residual in the forward map's risk."""
    inputs: bool = True
    """Whether the filter of an input-aware map takes in the system's inputs; else it is fitted to free motion only."""
    free: bool = True
    """Whether an input-aware map has a second inverse, of z_y alone, for as long as no input has acted."""
    push: float = 0.0
    """A part of the free trajectories starts where inputs have led from X: constant ones up to this multiple of their
    bounds, for 20 s; or, if it is 0, random ones within their bounds, for 10 s."""
    disturbed: float = 0.0
    """Share of an input-aware map's trajectories with process noise, each at a level of its own up to the system's,
    which the map is told if the share is not 0."""
    noise_max: float = 1.0
    """Largest standard deviation of the measurement noise that an input-aware map is trained for."""
    quiet: float = 0.2
    """Share of an input-aware map's samples without measurement noise."""
    emphasis: float = 2.0
    """How much the others are about high levels of it: 1 draws the level evenly on a logarithmic scale over the two
    decades below noise_max, higher values draw high ones more often, which are harder to learn."""
    truncation: float = 1e-6
    """epsilon in t*: what may be left of z0 where the forward map's data begins (paper, sec. 5.2)."""
    closed_loop: int = 0
    """Trajectories of a controller that acts on the estimate, on which the inverse of an input-aware map is fitted a
    second time, beside the others; 0 for no second time."""
    cap: float | None = None
    """CPU seconds for all networks together, if they must end before their steps are done."""
    seed: int = 0
    """Of everything random."""

    def __post_init__(self) -> None:
        for name, allowed in (
            ("method", get_args(Method)),
            ("activation", ("tanh", "silu")),
            ("optimiser", get_args(Optimiser)),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        if not self.eigenvalues and not self.pairs:
            raise ValueError("A needs eigenvalues, or pairs of them")
        if any(not -np.inf < value < 0 for value in self.eigenvalues):
            raise ValueError(f"eigenvalues must be negative, got {self.eigenvalues}")
        if any(not (-np.inf < a < 0 < w < np.inf) for a, w in self.pairs):
            raise ValueError(f"pairs must be (negative real part, positive imaginary part), got {self.pairs}")
        for modes in (self.eigenvalues, self.pairs):
            if len(set(modes)) < len(modes):
                raise ValueError(f"the eigenvalues of A must be distinct, got {modes}")
        if self.pairs and self.features:
            raise ValueError(f"solving for the forward map (features) needs a diagonal A, without pairs = {self.pairs}")
        for name in ("dt", "duration", "learning_rate", "noise_max", "emphasis", "truncation"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")
        if self.cap is not None and not 0 < self.cap < np.inf:
            raise ValueError(f"cap must be positive and finite, or None, got {self.cap!r}")
        for name in ("trajectories", "width", "depth", "inverse_steps"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ValueError(f"{name} must be a positive integer, got {getattr(self, name)!r}")
        if self.samples < 2:
            raise ValueError(f"samples must be at least 2, got {self.samples}")
        if self.batch < 64 or self.batch % 32:
            raise ValueError(f"batch must be a multiple of 32 and at least 64, got {self.batch}")
        for name in ("seed", "physics_weight", "push"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} = {getattr(self, name)} must be finite and not negative")
        for name in ("disturbed", "quiet"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share between 0 and 1, got {getattr(self, name)!r}")
        for name in ("inputs", "free"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        if self.closed_loop and (self.closed_loop < 10 or self.method != "input-aware" or not self.inputs):
            raise ValueError(
                f"closed_loop must be 0 or at least 10, and needs method 'input-aware' with inputs; got "
                f"{self.closed_loop}, {self.method!r}, inputs = {self.inputs}"
            )
        if (self.method == "spinn") != (self.forward_steps > 0 or self.features > 0):
            raise ValueError(
                f"method {self.method!r} does not go with forward_steps = {self.forward_steps} and features = "
                f"{self.features}"
            )
        if self.features and self.forward_steps:
            raise ValueError(f"features = {self.features} solve for T: forward_steps must be 0 beside them")
        if self.features < 0 or not 1 <= self.reach < np.inf or (self.reach > 1 and not self.features):
            raise ValueError(
                f"features = {self.features} must not be negative, and reach = {self.reach} must be 1, or more with "
                "features"
            )


# Number, fastest and slowest of the real modes of the input-aware maps, evenly spaced in the logarithm.
SPECTRA: dict[str, tuple[int, float, float]] = {
    "reverse_duffing": (13, -8.0, -0.2),
    "van_der_pol": (15, -20.0, -0.4),
    "rossler": (13, -8.0, -0.4),
    "lorenz": (13, -25.0, -1.5),
}
# What differs from the preset. Van der Pol's phase is the hardest to tell from noise: slow complex modes at frequencies
# of y, as `kkl-gym tune` chooses them, help there, and more samples at high noise. No input within its bound leads the
# oscillator out of X.
SETTINGS: dict[str, dict[str, Any]] = {
    "van_der_pol": {
        "pairs": ((-0.1, 0.718), (-0.1, 2.128), (-0.1, 0.6836), (-0.3, 0.718)),
        "push": 4.0,
        "quiet": 0.05,
        "emphasis": 4.0,
        "inverse_steps": 24000,
        "learning_rate": 2.5e-3,
    }
}
NOISE_MAX = {"lorenz": 3.0}


def preset(system: System, method: Method, name: Preset) -> Config:
    """The configuration behind ``--method`` and ``--preset`` for a system.

    "paper" has the sizes of the paper's sec. 8: 500 trajectories of 50 s, SiLU networks of 4 x 512, 200 epochs over
    3 million and 5 million points, physics weight 0.1, and nz = ny (2 nx + 1) eigenvalues in [-3, -1.5].
    The paper leaves open the batch (here 4,096), the spacing of the eigenvalues (even) and the decay of
    the learning rate (a cosine). "fast" is what ships: at most ten minutes on two CPU cores.
    """
    if method not in get_args(Method) or name not in get_args(Preset):
        raise ValueError(f"no preset {name!r} for method {method!r}; there are {get_args(Preset)}, {get_args(Method)}")
    if method == "spinn":
        paper = Config(
            method="spinn",
            eigenvalues=papers_spectrum(system),
            trajectories=500,
            samples=5001,
            width=512,
            depth=4,
            activation="silu",
            learning_rate=1e-3,
            forward_steps=200 * 3_000_000 // 4096,
            inverse_steps=200 * 5_000_000 // 4096,
        )
        if name == "paper":
            return paper
        return replace(
            paper,
            samples=500,
            width=128,
            depth=3,
            activation="tanh",
            batch=2048,
            forward_steps=8000,
            inverse_steps=6000,
            learning_rate=5e-3,
        )
    fast = Config(
        method="input-aware",
        eigenvalues=spectrum(system),
        optimiser="soap",
        batch=1024,
        learning_rate=5e-3,
        inverse_steps=18000,
        noise_max=NOISE_MAX.get(system.name, 1.0),
        disturbed=0.35,
    )
    fast = override(fast, SETTINGS.get(system.name, {}))
    if name == "fast":
        return fast
    return replace(
        fast,
        width=512,
        depth=4,
        activation="silu",
        optimiser="adam",
        batch=4096,
        learning_rate=1e-3,
        inverse_steps=244_140,
    )


def papers_spectrum(system: System) -> tuple[float, ...]:
    """2 nx + 1 eigenvalues in [-3, -1.5] (paper, sec. 8)."""
    return tuple(np.linspace(-1.5, -3.0, 2 * system.nx + 1).tolist())


def spectrum(system: System) -> tuple[float, ...]:
    """Eigenvalues for an input-aware map: as measured for a shipped system, else from how fast f changes in X."""
    if system.name in SPECTRA:
        n, fastest, slowest = SPECTRA[system.name]
    else:
        rate = typical_rate(system)
        n, fastest, slowest = 4 * system.nx + 3, -1.5 * rate, -rate / 15
    return tuple((-np.geomspace(-slowest, -fastest, n)).round(6).tolist())


def typical_rate(system: System) -> float:
    """Median over X of how fast f changes, in 1/s; raises ValueError if the system does not say."""
    low, high = system.box()
    points = np.random.default_rng(0).uniform(low, high, (1000, system.nx)).T
    rate = float(np.median(np.broadcast_to(system.rate(points), 1000)))
    if not 0 < rate < np.inf:
        raise ValueError(f"{system.name}.rate(x) is {rate} in X: override it to say how fast f changes")
    return rate


def read_changes(path: Path) -> dict[str, Any]:
    """Settings from a JSON file, as ``kkl-gym tune`` writes it, for :func:`override`.

    Raises ValueError if it is no object of a configuration's settings.
    """
    try:
        found = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is no JSON: {error}") from None
    kinds = {entry.name: entry.type for entry in fields(Config) if entry.name not in ("method", "closed_loop")}
    if not isinstance(found, dict) or not set(found) <= set(kinds):
        unknown = sorted(set(found) - set(kinds)) if isinstance(found, dict) else type(found).__name__
        raise ValueError(f"{path} must be an object of settings among {', '.join(sorted(kinds))}; it has {unknown}")
    for name, value in found.items():
        if not _fits(value, kinds[name]):
            raise ValueError(f"{path}: {name} must be of type {kinds[name]}, got {value!r}")
    return {name: _hashable(value) for name, value in found.items()}


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value from a JSON file is of a setting's type."""
    options = get_args(kind)
    if get_origin(kind) is tuple:
        repeated = options[-1] is Ellipsis
        return (
            isinstance(value, list)
            and (repeated or len(value) == len(options))
            and all(_fits(one, options[0]) for one in value)
        )
    if get_origin(kind) is Literal:
        return value in options
    if options:  # a union
        return any(_fits(value, option) for option in options)
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, (int, float) if kind is float else kind)


def _hashable(value: Any) -> Any:
    return tuple(map(_hashable, value)) if isinstance(value, list) else value


def override(config: Config, changes: Mapping[str, Any]) -> Config:
    """The configuration with every change that is not None."""
    return replace(config, **{name: value for name, value in changes.items() if value is not None})
