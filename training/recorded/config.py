"""What fitting an observer to recorded states is made of."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from observers import Artifact
from observers.checks import check_dt
from training.config import STRICT, Activation, Count, Levels, NotNegative, Optimiser, Positive, Share
from training.records import Record, median_step, sampling_interval
from training.spectrum import evenly_spaced

MODES = 12  # for each output
SLOWEST, FASTEST = 0.15, 10.0  # eigenvalues, in multiples of the rate of the signals
MEMORIES = 3.0  # of the filter in a record at least, unless its slowest mode were faster than the signals
FASTEST_MODE = 0.5  # bound of |eigenvalue| * dt
# Of rollouts, whose hidden signals an agent wants within steps: how many modes, the slowest and the fastest per step.
# Few modes that are far apart forget the start soon, and tell single steps from each other.
EPISODE_MODES, EPISODE_SLOWEST, EPISODE_FASTEST = 6, 0.2, 4.0
EPISODE_MEMORIES = 1.5  # of the filter in an episode at least
NOISE_SHARE = 0.1  # of an output's standard deviation: the largest noise beside that of the records


@dataclass(frozen=True, config=STRICT)
class RecordedConfig:
    """A training on recorded states; together with the records it determines the artifact.

    Settings that :class:`training.config.Config` has as well are explained there. :func:`recorded_config` chooses those
    that have no default from the records.
    """

    eigenvalues: tuple[Annotated[float, Field(lt=0)], ...]
    """Real eigenvalues of A, in 1/s."""
    dt: Positive
    """Sampling interval in seconds, to which records are resampled."""
    measurement_noise_max: Levels
    """Largest standard deviation of measurement noise beside that which the records hold, of all outputs or of each."""
    pairs: tuple[tuple[Annotated[float, Field(lt=0)], Positive], ...] = ()
    """Complex pairs a +- iw of eigenvalues of A beside the real ones."""
    samples: Annotated[int, Field(ge=2)] = 60
    """Ages of the filter at which it is paired with recorded states."""
    windows: Count = 8000
    """Starts of the filter for each age."""
    width: Count = 96
    """Neurons in each hidden layer."""
    depth: Count = 2
    """Number of hidden layers."""
    activation: Activation = "tanh"
    """Activation of the hidden layers."""
    optimiser: Optimiser = "soap"
    """Optimiser of all networks."""
    batch: Annotated[int, Field(ge=64, multiple_of=32)] = 1024
    """Samples in a batch."""
    learning_rate: Positive = 3e-3
    """Highest learning rate."""
    inverse_steps: Count = 3000
    """Batches for each network."""
    members: Count = 3
    """Networks that are fitted from other random numbers and averaged: what one makes up beyond the records, the others
    do not. They end as one network, as wide as all together."""
    inputs: bool = True
    """Whether the filter takes in recorded inputs."""
    arbitrary_zero: tuple[str, ...] = ()
    """Measured signals whose zero is arbitrary, such as angles of encoders that were zeroed anywhere: the map sees how
    they change, and not where they are."""
    noise_free_share: Share = 0.5
    """Share of the samples without noise beside that which the records hold."""
    high_noise_emphasis: Positive = 2.0
    """How often samples have high levels of noise."""
    untold_noise: NotNegative = 0.0
    """Standard deviation of further noise in every sample, over the largest level, of which the map is not told: it
    keeps networks from learning the noise of few records by heart."""
    held_out: Annotated[float, Field(ge=0, lt=1)] = 0.2
    """Share of the records that is not trained on, and on which errors are measured; whole records where there are
    five or more, else the end of each."""
    cpu_seconds: Positive | None = None
    """CPU seconds after which the training of all networks together ends, steps done or not."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of everything random."""


def recorded_config(records: Sequence[Record], changes: Mapping[str, Any] | None = None) -> RecordedConfig:
    """Choose what the records decide: dt, the eigenvalues of A, and the largest noise.

    dt is the median step, rounded where steps are uneven. The eigenvalues follow from the rate of the signals,
    :func:`signal_rate`, and from the length of the records; those of rollouts from dt and the length of episodes. The
    largest noise is a tenth of the standard deviation of each output.
    """
    given = {name: value for name, value in (changes or {}).items() if value is not None}
    chosen: dict[str, Any] = {"dt": sampling_interval(*records)} | given
    check_dt(chosen["dt"])
    if records[0].environment is not None and not np.isclose(chosen["dt"], median_step(*records), rtol=1e-6):
        raise ValueError(
            f"dt = {chosen['dt']:g} s: an observer for {records[0].environment['id']} takes a sample at each step, "
            f"every {median_step(*records):g} s; leave dt out"
        )
    if "eigenvalues" not in given and records[0].source:
        steps = float(np.median([len(record.t) for record in records]))
        slowest = min(max(EPISODE_SLOWEST, EPISODE_MEMORIES * np.log(1e3) / steps), EPISODE_FASTEST / 4)
        spaced = evenly_spaced(EPISODE_MODES, -slowest / chosen["dt"], -EPISODE_FASTEST / chosen["dt"])
        chosen["eigenvalues"] = tuple(float(f"{value:.6g}") for value in spaced)
    elif "eigenvalues" not in given:
        rate = signal_rate(records)
        length = np.median([record.duration for record in records])
        slowest = min(max(SLOWEST * rate, MEMORIES * np.log(1e3) / length), rate)
        spaced = evenly_spaced(MODES, -slowest, -min(FASTEST * rate, FASTEST_MODE / chosen["dt"]))
        chosen["eigenvalues"] = tuple(float(f"{value:.6g}") for value in spaced)
    if "measurement_noise_max" not in given:
        y = np.concatenate([record.y for record in records])
        levels = tuple(float(f"{NOISE_SHARE * size:.3g}") for size in np.nanstd(y, 0))
        if still := [name for name, level in zip(records[0].signals.measured, levels) if not level]:
            raise ValueError(f"{', '.join(still)} never changes and tells nothing: leave it out of what is measured")
        chosen["measurement_noise_max"] = levels[0] if len(levels) == 1 else levels
    return RecordedConfig(**chosen)


OF_THE_FILTER = ("eigenvalues", "pairs", "dt", "inputs", "arbitrary_zero")  # settings that stay for good
OF_THE_MAPS = tuple(field.name for field in fields(RecordedConfig) if field.name not in OF_THE_FILTER)


def config_of(artifact: Artifact, changes: Mapping[str, Any] | None = None) -> RecordedConfig:
    """Read how an observer was learned."""
    if artifact.training.get("pipeline") != "recorded":
        raise ValueError(f"the observer {artifact.system!r} was not learned from recorded states")
    names = (*OF_THE_MAPS, *OF_THE_FILTER)
    made = {name: _tuples(artifact.training[name]) for name in names if name in artifact.training}
    return RecordedConfig(**{**made, **(changes or {})})


def _tuples(value: Any) -> Any:
    """A setting as it was before a file made lists of tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def signal_rate(records: Sequence[Record]) -> float:
    """How fast signals change, in 1/s: rms of the derivative over standard deviation, the median of those that move."""
    rates = list[float]()
    for letter in "yx":
        columns = [getattr(record, letter) for record in records if getattr(record, letter) is not None]
        if columns:
            steps = [np.diff(values, axis=0) / np.diff(record.t)[:, None] for values, record in zip(columns, records)]
            change = np.sqrt(np.nanmean(np.concatenate(steps) ** 2, 0))
            size = np.nanstd(np.concatenate(columns), 0)
            rates += (change[size > 0] / size[size > 0]).tolist()
    moving = [rate for rate in rates if rate > 0]
    if not moving:
        raise ValueError(f"{records[0].name}: no signal moves, nor in any other record; there is nothing to learn from")
    return float(np.median(moving))
