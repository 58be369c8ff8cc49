"""A system sampled under noise: what single and vector environments share."""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym.simulate import check_dt
from kkl_gym.system import Box, System
from kkl_gym.systems import get_system

NOISE_BLOCK = 256  # noise is drawn for so many samples at once, because single draws cost more than the simulation


class Plant:
    """A system, its sampling interval, its noise and the spaces that follow; parameters are those of :class:`KKLEnv`.

    Attributes
    ----------
    system, dt, process_noise, measurement_noise, observe : as given, with defaults filled in.
    start_box : low and high corner, each (nx,), of where episodes start.
    state_space, output_space : boxes of the states within the declared bounds and of the outputs that they allow.
    observation_space : that of the two which ``observe`` names.
    action_space : ``Box(-1, 1, (nu,))``.
    weights : of the squared deviations from the target in the reward's cost, (nx,).

    Raises ValueError on an unknown system or parameter, dt <= 0, a negative noise level, an unknown ``observe``, and a
    ``start_box`` that does not lie within the declared bounds.
    """

    def __init__(
        self,
        system: str | System,
        dt: float,
        *,
        process_noise: float | None,
        measurement_noise: float,
        observe: str,
        parameters: Mapping[str, float] | None,
        start_box: Box | None,
    ) -> None:
        self.system = get_system(system, parameters)
        check_dt(dt)
        process_noise = self.system.process_noise if process_noise is None else process_noise
        for name, level in (("process_noise", process_noise), ("measurement_noise", measurement_noise)):
            if isinstance(level, bool) or not isinstance(level, Real) or not 0 <= level < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {level!r}")
        if observe not in ("state", "output"):
            raise ValueError(f'observe must be "state" or "output", got {observe!r}')
        self.dt = float(dt)
        self.process_noise = float(process_noise)
        self.measurement_noise = float(measurement_noise)
        self.observe = observe
        self.start_box = _start_box(self.system, start_box)
        self.state_space = _float32_box(*zip(*self.system.bounds, strict=True))
        self.output_space = _float32_box(*output_bounds(self.system, 6.0 * self.measurement_noise))
        self.observation_space = self.state_space if observe == "state" else self.output_space
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.system.nu,), np.float32)
        self._w_range = 2.0 * self.process_noise * np.array(self.system.scale)
        self.weights = 1.0 / (self.system.nx * np.square(self.system.scale))

    def draw_noise(
        self, rng: np.random.Generator, w: np.ndarray | None = None, v: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """``NOISE_BLOCK`` samples for :meth:`noise` to scale, (samples, nx) and (samples, ny); in w and v, if given."""
        n, nx, ny = NOISE_BLOCK, self.system.nx, self.system.ny
        return rng.random((n, nx), out=w), rng.standard_normal((n, ny), out=v)

    def noise(self, drawn_w: np.ndarray, drawn_v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Process noise w and measurement noise v of what was drawn, (..., nx) and (..., ny)."""
        return (drawn_w - 0.5) * self._w_range, drawn_v * self.measurement_noise

    def draw_start(self, rng: np.random.Generator) -> np.ndarray:
        """A start uniform in ``start_box``, (nx,)."""
        low, high = self.start_box
        return rng.uniform(low, high)

    def start(self, x0: Any) -> np.ndarray:
        """The start that a user asks for, (nx,); raises ValueError if it is no state within the declared bounds."""
        start = np.asarray(x0, dtype=float)
        low, high = np.array(self.system.bounds).T
        if start.shape != (self.system.nx,) or not ((start >= low) & (start <= high)).all():
            raise ValueError(f"x0 must be {self.system.nx} numbers within {self.system.bounds}, got {x0!r}")
        return start


def _start_box(system: System, box: Box | None) -> tuple[np.ndarray, np.ndarray]:
    ends = np.array(system.X if box is None else box, dtype=float)  # a copy: it is kept
    low, high = np.array(system.bounds).T
    if ends.shape != (system.nx, 2):
        raise ValueError(f"start_box must be (low, high) for each of {system.nx} states, got {box!r}")
    if not ((low <= ends[:, 0]) & (ends[:, 0] <= ends[:, 1]) & (ends[:, 1] <= high)).all():
        raise ValueError(f"start_box must lie within the declared bounds {system.bounds}, low before high; got {box!r}")
    return ends[:, 0], ends[:, 1]


def output_bounds(system: System, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Low and high, each (ny,), of h over the declared bounds, widened by ``margin``.

    Evaluated at the corners, the faces' centres and the centre, which is exact for outputs monotone in each state.
    """
    ends = [(low, (low + high) / 2, high) for low, high in system.bounds]
    points = np.array(np.meshgrid(*ends, indexing="ij")).reshape(system.nx, -1)
    y = np.array([np.broadcast_to(yi, points.shape[1:]) for yi in system.h(points)])
    return y.min(1) - margin, y.max(1) + margin


def _float32_box(low: Any, high: Any) -> gym.spaces.Box:
    return gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)
