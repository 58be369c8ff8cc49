"""The settings of a training run."""

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Discriminator, Field, Tag, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from observers.names import suggestion

Pipeline = Literal["input-aware", "spinn"]
Optimiser = Literal["adam", "soap"]
Scaling = Literal["relative", "range"]

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
# One number for all outputs, or one for each output. Error messages show the tags, "all" and "each".
EACH = Discriminator(lambda value: "each" if isinstance(value, list | tuple) else "all")
Levels = Annotated[
    Annotated[Positive, Tag("all")] | Annotated[tuple[Positive, ...], Field(min_length=1), Tag("each")], EACH
]
Biases = Annotated[
    Annotated[NotNegative, Tag("all")] | Annotated[tuple[NotNegative, ...], Field(min_length=1), Tag("each")], EACH
]


@dataclass(
    frozen=True, config=ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
)
class Config:
    """The settings of a training. The input-aware preset "fast" keeps all defaults that do not depend on the system.

    Raises
    ------
    pydantic.ValidationError
        A ValueError that names every invalid setting, its value, and what it should be.
    """

    pipeline: Pipeline
    """How the observer is learned. input-aware: T_inv(z_y, z_u), of filtered y and u, is fitted along noisy
    trajectories with inputs, and T_inv(z_y) along those without, transients included. spinn: as in the paper, a
    physics-informed network learns T, and T_inv is fitted on z = T(x) (see ``transients``), without inputs."""
    eigenvalues: tuple[Annotated[float, Field(lt=0)], ...]
    """Real eigenvalues of A for each output, in 1/s; B feeds the output into each of its modes with weight 1."""
    pairs: tuple[tuple[Annotated[float, Field(lt=0)], Positive], ...] = ()
    """Eigenvalue pairs a +- iw of A, as (a, w) in 1/s and rad/s. Slow pairs at frequencies of y average its noise."""
    dt: Positive = 0.01
    """Sampling interval in seconds."""
    trajectories: Count = 500
    """Simulated trajectories for each T_inv."""
    duration: Positive = 50.0
    """Length of each trajectory in seconds."""
    samples: Annotated[int, Field(ge=2)] = 200
    """Points recorded along each trajectory."""
    width: Count = 20
    """Neurons in each hidden layer."""
    depth: Count = 3
    """Number of hidden layers."""
    activation: Literal["tanh", "silu"] = "tanh"
    """Activation of the hidden layers."""
    optimiser: Optimiser = "soap"
    """Optimiser of the maps' networks: adam, or soap, which needs far fewer batches."""
    batch: Annotated[int, Field(ge=64, multiple_of=32)] = 1024
    """Samples in a batch. A batch for the forward map has as many collocation points in addition."""
    learning_rate: Positive = 5e-3
    """Highest learning rate; after a short warm-up it decays to zero along a cosine."""
    forward_steps: Annotated[int, Field(ge=0)] = 0
    """Batches for the forward map (spinn)."""
    inverse_steps: Count = 1500
    """Batches for each T_inv network."""
    collocation: Literal["motions", "box"] = "motions"
    """Points x at which the forward map's equation must hold (spinn): states of motions, or uniform in the box X."""
    box_factor: Annotated[float, Field(ge=1)] = 1.0
    """Most trajectories start in this multiple of the training box X, the others in X (spinn)."""
    solved_output_layer: bool = True
    """Whether least squares determine the forward map's output layer after its training (spinn)."""
    transients: bool = True
    """Whether T_inv is fitted to z at all times since reset and all noise levels (spinn), not only to z = T(x)."""
    scaling: Scaling = "relative"
    """How states are scaled. relative: by their standard deviation; errors of T_inv count relative to the state's size.
    range: by half their range; all errors count alike."""
    physics_weight: NotNegative = 0.1
    """Weight nu of the PDE residual in the forward map's risk (spinn)."""
    inputs: bool = True
    """Whether the filter of an input-aware map takes the system's inputs; if not, motions have no inputs."""
    policy: str | None = None
    """A policy for plants that random inputs drive out of their bounds (input-aware): "controller" for the system's own
    controller (by default a linear-quadratic regulator at the target), or a function from states (n, nx) to actions
    (n, nu) in [-1, 1], as script.py:function or module:function. It sees states with errors and explores, except in one
    trajectory in twelve. With a policy, no motions without inputs are simulated."""
    free_inverse: bool = True
    """Whether an input-aware map has a second inverse T_inv(z_y), used until an input acts; none with a policy."""
    lead_in_input: NotNegative = 0.0
    """Some trajectories without inputs start where earlier inputs have led, mostly outside X. These inputs are constant
    over 20 paces, up to this multiple of their bounds; with 0, random within bounds over 10 paces."""
    process_noise_share: Share = 0.35
    """Share of trajectories with process noise (input-aware); with 0, its level is not an input of T_inv."""
    measurement_noise_max: Levels = 1.0
    """Largest standard deviation of the measurement noise in training, one for all outputs or one for each."""
    noise_free_share: Share = 0.2
    """Share of the samples without measurement noise, for maps that have the noise level as an input."""
    high_noise_emphasis: Positive = 2.0
    """1 draws the level of measurement noise evenly on a logarithmic scale over the two decades below
    measurement_noise_max; higher values draw high levels, which are harder to learn, more often."""
    windows: Count = 8000
    """Number of recorded states for each time t since reset; the filter starts t before each state (records)."""
    members: Count = 1
    """Number of networks with different seeds, averaged into one wide network, as they extrapolate differently."""
    arbitrary_zero: tuple[str, ...] = ()
    """Measured signals with an arbitrary zero, like an encoder's; T_inv uses only their changes (recorded motions)."""
    held_out: Annotated[float, Field(ge=0, lt=1)] = 0.2
    """Share of the records that is held out for calibration and for measuring errors: whole records if there are five
    or more, otherwise the end of each record."""
    tracking: bool = True
    """Whether a Kalman filter tracks the state (not spinn); it predicts by equations or a flow, a learned network."""
    flow_steps: Count = 5000
    """Batches for a flow, which replaces unknown equations and those that an artifact cannot hold."""
    runs: Annotated[int, Field(ge=100)] = 400
    """Number of simulated motions on which covariances and the monitor's limits are calibrated."""
    false_alarms: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Probability of an alarm in a fault-free motion that is as long as a calibration motion (systems: 20 paces)."""
    truncation: Positive = 1e-6
    """epsilon: the forward map's data begins once the filter's start adds at most this to z (spinn, paper sec. 5.2)."""
    uncertain: dict[str, Annotated[float, Field(ge=0, lt=1)]] = dataclasses.field(default_factory=dict)
    """Parameters of the system that differ from motion to motion (input-aware), by name, with their largest relative
    deviations; "all" stands for each that is not named. Some motions keep the system's own values."""
    bias: Biases = 0.0
    """Largest constant bias of all outputs, or of each; T_inv estimates biases (input-aware, without ``uncertain``)."""
    estimate_parameters: bool = False
    """Whether T_inv estimates the uncertain parameters, too."""
    cpu_seconds: Positive | None = None
    """Limit of CPU seconds for the maps' networks together; a flow may take as many again."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of everything random."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.duration < self.dt:
            raise ValueError(f"duration = {self.duration} s is shorter than one sample, dt = {self.dt} s")
        if not self.eigenvalues and not self.pairs:
            raise ValueError("A needs eigenvalues: set eigenvalues or pairs")
        for modes in (self.eigenvalues, self.pairs):
            if len(set(modes)) < len(modes):
                raise ValueError(f"the eigenvalues of A must be distinct, got {modes}")
        if self.uncertain and self.pipeline != "input-aware":
            raise ValueError(f"uncertain = {self.uncertain!r} needs the pipeline 'input-aware', not {self.pipeline!r}")
        biased = any(self.bias) if isinstance(self.bias, tuple) else self.bias
        if biased and (self.uncertain or self.pipeline != "input-aware"):
            raise ValueError(f"bias = {self.bias!r} needs the pipeline 'input-aware' without uncertain parameters")
        if self.estimate_parameters and not any(self.uncertain.values()):
            raise ValueError(f"estimate_parameters needs uncertain parameters, got uncertain = {self.uncertain!r}")
        if self.policy is not None and (self.pipeline != "input-aware" or not self.inputs):
            raise ValueError(
                f"policy = {self.policy!r} needs the pipeline 'input-aware' with inputs; got {self.pipeline!r}, "
                f"inputs = {self.inputs}"
            )
        if (self.pipeline == "spinn") != (self.forward_steps > 0):
            raise ValueError(f"forward_steps = {self.forward_steps} must be > 0 for 'spinn', 0 for 'input-aware'")
        own = {name: getattr(self, name) for name in ("collocation", "box_factor", "solved_output_layer", "transients")}
        changed = [f"{name} = {value!r}" for name, value in own.items() if value != getattr(Config, name)]
        if changed and self.pipeline != "spinn":
            raise ValueError(f"{', '.join(changed)}: settings of the pipeline 'spinn', not {self.pipeline!r}")
        return self


def setting_types() -> dict[str, Any]:
    """Return each setting's type, which includes its limits, by name."""
    return {entry.name: entry.type for entry in dataclasses.fields(Config)}


def read_changes(path: Path) -> dict[str, Any]:
    """Read settings from a TOML or JSON file."""
    language, loads = ("TOML", tomllib.loads) if path.suffix == ".toml" else ("JSON", json.loads)
    try:
        settings = loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # a syntax error, or a text in another encoding
        raise ValueError(f"{path} is not valid {language}: {error}") from None
    if not isinstance(settings, dict):
        raise ValueError(f"{path} must hold settings by name, got a {type(settings).__name__}")
    return checked_changes(settings, str(path))


def checked_changes(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Check the names of settings, and their JSON values against their types and limits."""
    # Only the option --policy may name code to run, not a file of settings.
    names = sorted(set(setting_types()) - {"pipeline", "policy"})
    for name in settings:
        if name not in names:
            close = suggestion(name, names)
            raise ValueError(f"{where}: unknown setting {name!r}{close}; there are {', '.join(names)}")
    return _validated(settings, where)


def settings_of(training: Mapping[str, Any], **changes: Any) -> Config:
    """Return the configuration in an artifact's training metadata, with some settings changed."""
    settings = {name: training[name] for name in setting_types() if training.get(name) is not None}
    if not {"pipeline", "eigenvalues"} <= set(settings):
        raise ValueError("the observer holds no settings of its training: use one that kkl-gym train made")
    return Config(**{**_validated(settings, "the observer's training"), **changes})


def _validated(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Check JSON values of settings against their types and limits."""
    types, checked = setting_types(), {}
    for name, value in settings.items():
        try:
            checked[name] = TypeAdapter(types[name]).validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            raise ValueError(f"{where}: {name} = {value!r}: {error.errors()[0]['msg']}") from None
    return checked
