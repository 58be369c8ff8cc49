"""A sensor between a system's output and its observer or agent."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kkl_gym.equation_errors import is_sequence
from observers.checks import integer, is_finite, noise_level, shown

# Largest delay and largest gap between samples, in steps; environments store delay + 1 samples.
MAX_SAMPLES = 10_000


@dataclass(frozen=True)
class Sensor:
    """A sensor with faults: y = clip(round(gain h(x) + bias + c + v)), possibly delayed or missing at some steps.

    c is first-order coloured noise: its autocorrelation over t seconds is exp(-t / time_constant). v is the white
    ``measurement_noise`` of the environment. Every parameter is one number for all outputs, or a sequence with one for
    each. Where the sensor delivers no sample, ``info["y"]`` is NaN, the observer predicts without correction, and an
    observation of the output repeats the last sample. The first sample of an episode is never missing.

    Parameters
    ----------
    gain : float or sequence of float, length ny
        Factor of the output.
    bias : float or sequence of float, length ny
        Offset, in the units of y.
    coloured_noise : float or sequence of float, length ny
        Standard deviation of c.
    time_constant : float or sequence of float, length ny, optional
        Time constant of c in seconds; required with coloured noise.
    quantum : float or sequence of float, length ny
        Resolution: y is rounded to multiples of it. 0 does not round.
    saturation : tuple of (low, high), optional
        Limits to which y is clipped, each a number or a sequence of length ny.
    delay : int or sequence of int, length ny
        Steps by which samples arrive late. The sample at reset is never late; it is repeated until the next arrives.
    drop_out : float or sequence of float, length ny
        Probability, below 1, with which a sample is lost, independently of others.
    every : int or sequence of int, length ny
        Number of steps from one sample to the next; 1 gives a sample at every step.

    Raises
    ------
    ValueError
        If a parameter is not as described.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from kkl_gym import Sensor
    >>> env = gym.make("KKLLorenz-v0", sensor=Sensor(quantum=0.5, every=2), measurement_noise=0.0)
    >>> obs, info = env.reset(seed=0)
    >>> [float(env.step([0.0])[4]["y"][0]) for _ in range(4)]
    [nan, -11.5, nan, -11.0]
    """

    gain: float | Sequence[float] = 1.0
    bias: float | Sequence[float] = 0.0
    coloured_noise: float | Sequence[float] = 0.0
    time_constant: float | Sequence[float] | None = None
    quantum: float | Sequence[float] = 0.0
    saturation: tuple[float | Sequence[float], float | Sequence[float]] | None = None
    delay: int | Sequence[int] = 0
    drop_out: float | Sequence[float] = 0.0
    every: int | Sequence[int] = 1

    def __post_init__(self) -> None:
        checks: dict[str, Callable[[str, Any], float]] = {
            "gain": _finite,
            "bias": _finite,
            "coloured_noise": noise_level,
            "time_constant": _number("positive, finite number of seconds", lambda value: value > 0),
            "quantum": noise_level,
            "delay": lambda name, value: integer(name, value, 0, MAX_SAMPLES),
            "drop_out": _number("probability, from 0 to below 1", lambda value: 0 <= value < 1),
            "every": lambda name, value: integer(name, value, 1, MAX_SAMPLES),
        }
        for name, check in checks.items():
            if name != "time_constant" or self.time_constant is not None:
                object.__setattr__(self, name, _each(f"the sensor's {name}", getattr(self, name), check))
        if np.any(self.coloured_noise) and self.time_constant is None:
            raise ValueError(f"coloured_noise = {self.coloured_noise} needs a time_constant in seconds")
        if self.saturation is not None:
            if not is_sequence(self.saturation) or len(self.saturation) != 2:
                raise ValueError(f"the sensor's saturation must be (low, high), got {shown(self.saturation)}")
            ends = tuple(_each(f"the sensor's saturation[{i}]", end, _finite) for i, end in enumerate(self.saturation))
            if len({len(end) for end in ends if isinstance(end, tuple)}) < 2 and not np.all(np.less(ends[0], ends[1])):
                raise ValueError(f"the sensor's saturation must be (low, high) with low < high, got {ends}")
            object.__setattr__(self, "saturation", ends)

    @property
    def is_random(self) -> bool:
        """Whether the sensor draws random numbers."""
        return bool(np.any(self.coloured_noise) or np.any(self.drop_out))

    def columns(self, ny: int) -> dict[str, np.ndarray]:
        """Return parameters by name, each (ny, 1): saturation as ``low`` and ``high``; unset time constants are 1."""
        low, high = (-math.inf, math.inf) if self.saturation is None else self.saturation
        given = vars(self) | {"low": low, "high": high, "time_constant": self.time_constant or 1.0}
        del given["saturation"]
        for name, value in given.items():
            if isinstance(value, tuple) and len(value) != ny:
                name = "saturation" if name in ("low", "high") else name
                raise ValueError(
                    f"the sensor's {name} must be one number, or one for each of {ny} outputs, got {shown(value)}"
                )
        return {name: np.broadcast_to(np.array(value), ny)[:, None] for name, value in given.items()}

    def bounds(self, low: np.ndarray, high: np.ndarray, noise: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of y for bounds (ny,) of h(x), with margins: half a quantum, six noise standard deviations."""
        of = {name: column[:, 0] for name, column in self.columns(len(low)).items()}
        ends = of["gain"] * np.stack([low, high]) + of["bias"]
        margin = 6.0 * np.hypot(noise, of["coloured_noise"]) + of["quantum"] / 2
        return tuple(np.clip([ends.min(0) - margin, ends.max(0) + margin], of["low"], of["high"]))


def sensor_of(value: Any) -> Sensor | None:
    """Return a Sensor from a Sensor or from a mapping of its parameters; None stays None."""
    if value is None or isinstance(value, Sensor):
        return value
    names = [field.name for field in dataclasses.fields(Sensor)]
    if not isinstance(value, Mapping):
        raise ValueError(f"sensor must be a kkl_gym.Sensor or a dict of {', '.join(names)}, got {shown(value)}")
    for name in value:
        if name not in names:
            raise ValueError(f"a sensor has no {shown(name)}; it has {', '.join(names)}")
    return Sensor(**value)


class Readings:
    """The sensors of n environments at run time, with their coloured noise and their delayed samples."""

    def __init__(self, sensor: Sensor, ny: int, dt: float, n: int) -> None:
        self._of = of = sensor.columns(ny)
        self._ny, self._outputs, self._everyone = ny, np.arange(ny)[:, None], np.arange(n)
        self._decay = np.exp(-dt / of["time_constant"])
        self._fresh = np.sqrt(-np.expm1(-2 * dt / of["time_constant"]))
        self._rounded = bool(of["quantum"].any())
        self._quantum = np.where(of["quantum"] > 0, of["quantum"], 1.0)
        self._noise = np.zeros((ny, n))  # coloured noise with variance 1
        self._age = np.zeros(n, dtype=np.int64)  # steps since reset
        self._kept = np.zeros((int(of["delay"].max()) + 1, ny, n))  # ring buffer of the latest samples

    @np.errstate(over="ignore", invalid="ignore")  # outputs of states that escaped may overflow
    def read(self, h: np.ndarray, v: np.ndarray, rows: np.ndarray | None = None, *, start: bool) -> np.ndarray:
        """Return samples (ny, m) of environments ``rows`` (m,) at an episode's start or next step, NaN where missing.

        Shapes: ``h`` (ny, m); ``v``, white noise (ny, m), or for a random sensor (3 ny, m) with the sensor's draws.
        """
        rows, of, drawn = self._everyone if rows is None else rows, self._of, len(v) > self._ny
        white, fresh, chance = np.split(v, 3) if drawn else (v, None, None)
        y = of["gain"] * h + of["bias"] + white
        if fresh is not None:
            noise = fresh if start else self._decay * self._noise[:, rows] + self._fresh * fresh
            self._noise[:, rows] = noise
            y += of["coloured_noise"] * noise
        if self._rounded:
            y = np.where(of["quantum"] > 0, self._quantum * np.rint(y / self._quantum), y)
        y = np.clip(y, of["low"], of["high"])
        age = self._age[rows] = 0 if start else self._age[rows] + 1
        if start:
            self._kept[:, :, rows] = y
            return y
        lost = age % of["every"] != 0
        if chance is not None:
            lost |= chance < of["drop_out"]
        y[lost] = np.nan
        length = len(self._kept)
        if length == 1:  # no delay
            return y
        self._kept[age % length, :, rows] = y.T
        return self._kept[(age - of["delay"]) % length, self._outputs, rows]


def _each(name: str, value: Any, check: Callable[[str, Any], float]) -> float | tuple[float, ...]:
    if is_sequence(value):
        return tuple(check(f"{name}[{i}]", one) for i, one in enumerate(value))
    return check(name, value)


def _number(wanted: str, holds: Callable[[float], bool]) -> Callable[[str, Any], float]:
    def check(name: str, value: Any) -> float:
        if not is_finite(value) or not holds(value):
            raise ValueError(f"{name} must be a {wanted}, got {shown(value)}")
        return float(value)

    return check


_finite = _number("finite number", lambda value: True)


__all__ = ["Sensor"]
