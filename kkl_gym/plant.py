"""The plant of single and vector environments: a system that is sampled under noise."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym.equation_errors import held, returned
from kkl_gym.equations import check_task
from kkl_gym.sensor import Sensor, sensor_of
from kkl_gym.simulate import check_interval
from kkl_gym.system import Box, Components, System
from kkl_gym.systems import get_system
from observers.checks import check_dt, choice, noise_level, noise_levels, real_array, shown

# To bound the outputs, h is evaluated at this number of random states, and on a grid of about this size or smaller.
_MOST_POINTS = 1000
# The noise of this number of samples is drawn at once, because single draws take longer than the simulation.
NOISE_BLOCK = 256


class Plant:
    """A system, its sampling interval, its noise, its sensor and the spaces that follow from them."""

    def __init__(
        self,
        system: str | System,
        *,
        dt: float | None = None,
        process_noise: float | None = None,
        measurement_noise: float | Sequence[float] | None = None,
        observe: str = "state",
        parameters: Mapping[str, float] | None = None,
        start_box: Box | None = None,
        sensor: Sensor | Mapping[str, Any] | None = None,
    ) -> None:
        self.system = get_system(system, parameters)
        self.dt = check_dt(self.system.dt if dt is None else dt)
        check_interval(self.system, self.dt)
        self.process_noise = noise_level(
            "process_noise", self.system.process_noise if process_noise is None else process_noise
        )
        self.measurement_noise = noise_levels(
            "measurement_noise",
            self.system.measurement_noise if measurement_noise is None else measurement_noise,
            self.system.ny,
        )
        self.observe = choice("observe", observe, ("state", "output"))
        self.start_box = _start_box(self.system, start_box)
        self._draws = start_box is None and type(self.system).draw_starts is not System.draw_starts
        self.state_space = _float32_box(*zip(*self.system.bounds, strict=True))
        self.sensor = sensor_of(sensor)
        noise = np.asarray(self.measurement_noise)
        low, high = output_bounds(self.system, 0.0 if self.sensor else 6.0 * noise)
        self.output_space = _float32_box(*(self.sensor.bounds(low, high, noise) if self.sensor else (low, high)))
        self.observation_space = self.state_space if observe == "state" else self.output_space
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.system.nu,), np.float32)
        self.ny = self.system.ny  # stored, because the property evaluates h
        self._v_scale = np.broadcast_to(noise, (self.ny,))
        self._random = self.sensor is not None and self.sensor.is_random
        if self._random:  # v then ends with the sensor's own draws, which are not scaled
            self._v_scale = np.append(self._v_scale, np.ones(2 * self.ny))
        self.nv = len(self._v_scale)
        self._w_range = 2.0 * self.process_noise * np.array(self.system.scale)

    def draw_noise(
        self, rng: np.random.Generator, w: np.ndarray | None = None, v: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw w (NOISE_BLOCK, nx) and v (NOISE_BLOCK, nv), into given arrays if any; :meth:`noise` scales them."""
        # A sensor draws from its own generator: a seed gives the same motions and noise with and without a sensor.
        n, ny = NOISE_BLOCK, self.ny
        w = rng.random((n, len(self._w_range)), out=w)
        if not self._random:
            return w, rng.standard_normal((n, ny), out=v)
        v, of_sensor = np.empty((n, self.nv)) if v is None else v, rng.spawn(1)[0]
        v[:, :ny] = rng.standard_normal((n, ny))
        v[:, ny : 2 * ny], v[:, 2 * ny :] = of_sensor.standard_normal((n, ny)), of_sensor.random((n, ny))
        return w, v

    def noise(self, drawn_w: np.ndarray, drawn_v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scale draws of w (..., nx) and v (..., nv) to the noise levels."""
        return (drawn_w - 0.5) * self._w_range, drawn_v * self._v_scale

    def draw_start(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a start, (nx,): uniform in ``start_box``, or by the system's ``draw_starts`` if no box was given."""
        if self._draws:
            return self.start(self.system.draw_starts(rng, 1)[0])
        low, high = self.start_box
        return rng.uniform(low, high)

    def start(self, x0: Any) -> np.ndarray:
        """Check a start ``x0`` (nx,), given by the user or by ``draw_starts``, and return it as an array."""
        start = real_array("x0", x0)
        low, high = np.array(self.system.bounds).T
        if start.shape != (self.system.nx,) or not ((start >= low) & (start <= high)).all():
            raise ValueError(f"x0 must be {self.system.nx} numbers within {self.system.bounds}, got {shown(x0)}")
        return start


class OfPlant:
    """Base class of single and vector environments: holds their plant and its properties."""

    plant: Plant
    _reward: Callable[[Components, Components], Any]

    @property
    def system(self) -> System:
        """The system. Between two steps it may be exchanged: ``env.system = env.system.replace({...})``."""
        return self.plant.system

    @system.setter
    def system(self, system: System) -> None:
        if type(system) is not type(self.plant.system):
            raise ValueError(f"the system can be exchanged for another {self.plant.system.name!r}, got {shown(system)}")
        check_interval(system, self.plant.dt)
        before, self.plant.system = self.plant.system, system
        try:
            self._exchanged()
        except Exception:
            self.plant.system = before
            raise

    def _exchanged(self) -> None:
        """After an exchange of the system, update everything that depends on it."""
        raise NotImplementedError

    def _judged(self, x: Components, u: Components) -> tuple[Any, Any]:
        """Return rewards (numbers or arrays) of intervals that ended at x under u, and whether episodes end at x."""
        system = self.plant.system
        try:
            reward, ended = self._reward(x, u), system.terminated(x)
            if system.states_task and not np.isfinite(reward).all():
                raise returned(system.reward, "finite numbers", f"{shown(reward)}; {held(x)}")
        except Exception:
            check_task(system, x, u)
            raise
        return reward, ended

    dt = property(lambda self: self.plant.dt, doc="Sampling interval in seconds.")
    process_noise = property(lambda self: self.plant.process_noise, doc="Bound of |w|, as a multiple of scale per s.")
    measurement_noise = property(lambda self: self.plant.measurement_noise, doc="Standard deviations of v.")
    sensor = property(lambda self: self.plant.sensor, doc="The sensor, None if it is ideal.")


def _start_box(system: System, box: Box | None) -> tuple[np.ndarray, np.ndarray]:
    ends = real_array("start_box", system.X if box is None else box).copy()  # a copy, because the plant stores it
    low, high = np.array(system.bounds).T
    if ends.shape != (system.nx, 2):
        raise ValueError(f"start_box must be (low, high) for each of {system.nx} states, got {shown(box)}")
    if not ((low <= ends[:, 0]) & (ends[:, 0] <= ends[:, 1]) & (ends[:, 1] <= high)).all():
        raise ValueError(
            f"start_box must lie within the declared bounds {system.bounds}, with low <= high, got {shown(box)}"
        )
    return ends[:, 0], ends[:, 1]


def output_bounds(system: System, margin: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of h(x) over the declared bounds of the state, widened by ``margin``.

    Without the margin, they are exact if h is monotone in each state.
    """
    # h is evaluated at random states, and on the grid of each state's low, middle and high values, where h must not be
    # NaN. With more than six states, only a part of the grid is taken. This part includes, for each output, the corner
    # towards which the output rises from the centre, and the opposite corner.
    low, high = np.array(system.bounds, dtype=float).T
    rng, nx = np.random.default_rng(0), system.nx
    if 3**nx <= _MOST_POINTS:
        marked = np.indices((3,) * nx).reshape(nx, -1).T
    else:
        steps = np.eye(nx, dtype=int)
        at_sides = low + (high - low) / 2 * np.concatenate([1 + steps, 1 - steps])
        with np.errstate(all="ignore"):
            above, below = np.split(system.output(at_sides), 2)
        rising = 2 * (above > below).T
        marked = np.concatenate([rising, 2 - rising, 1 + steps, 1 - steps, rng.integers(0, 3, (_MOST_POINTS, nx))])
    x = low + (high - low) / 2 * np.concatenate([marked, 2.0 * rng.random((_MOST_POINTS, nx))])
    with np.errstate(all="ignore"):
        y = system.output(x)
    lost = np.isnan(y).any(1) & (np.arange(len(x)) < len(marked))
    if lost.any():
        found = f"{y[lost][0].tolist()}; {held(x[lost][0])}: tighten the bounds to where h(x) is defined"
        raise returned(system.h, "numbers everywhere within the bounds", found)
    return np.nanmin(y, axis=0) - margin, np.nanmax(y, axis=0) + margin


def _float32_box(low: Any, high: Any) -> gym.spaces.Box:
    return gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)
