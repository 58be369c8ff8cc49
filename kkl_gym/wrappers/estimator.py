"""What single and vector wrappers share: an observer fitted to a plant, and what it shows."""

import os
from collections.abc import Mapping
from typing import Protocol

import gymnasium as gym
import numpy as np

from kkl_gym.compiled import clipped
from kkl_gym.plant import Plant
from observers import KKLObserver, load, shipped


class Estimator(Protocol):
    """A batch of observers, as :class:`VectorEstimate` drives them."""

    space: gym.spaces.Box
    """Of one row's observation."""

    def reset(self, y0: np.ndarray) -> object:
        """Take in the first samples, (n, ny)."""
        ...

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Begin anew in some rows, boolean (n,), from their first samples, (number of rows, ny)."""
        ...

    def advance(self, y: np.ndarray, u: np.ndarray | None, rows: np.ndarray | None = None) -> None:
        """Take in the samples y, (n, ny), that followed the inputs u, (n, nu), None being zero; in some rows only."""
        ...

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """What ``info`` gains, a row for each of the n rows or of ``rows``."""
        ...

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """What is shown of a report."""
        ...


class KKLEstimator:
    """An observer for a plant, and the space of what it shows; the parameters are those of :class:`KKLObservation`.

    Attributes
    ----------
    observer : the observer, its noise level set.
    estimate : "x" or "z".
    space : of the estimate shown.
    """

    def __init__(
        self,
        plant: Plant,
        observer: str | os.PathLike[str] | None,
        *,
        estimate: str,
        measurement_noise: float | None,
        ignore_input: bool,
        monitor: bool,
    ) -> None:
        if estimate not in ("x", "z"):
            raise ValueError(f'estimate must be "x" or "z", got {estimate!r}')
        system = plant.system
        if observer is None and system.name not in shipped():
            raise ValueError(f"no map ships for {system.name!r}: train one and pass observer='….safetensors'")
        self.observer: KKLObserver = load(
            system.name if observer is None else observer,
            plant.measurement_noise if measurement_noise is None else measurement_noise,
            process_noise=plant.process_noise,
            monitor=monitor,
        )
        self._monitor = monitor
        self.observer.artifact.check(system.name, system.parameters, dt=plant.dt, ny=system.ny, nu=system.nu)
        self.estimate = estimate
        self._blind = self.observer.artifact.nu == 0 and system.nu > 0
        self._ignore_input = ignore_input
        self.space = plant.state_space if estimate == "x" else _filter_space(plant, self.observer)

    def known(self, u: np.ndarray) -> np.ndarray | None:
        """The input as far as the map knows it; raises ValueError if the agent acts on a map that knows none."""
        if not self._blind:
            return u
        if not self._ignore_input and u.any():
            raise ValueError(
                f"the map {self.observer.artifact.system!r} in use knows no inputs, but the agent applied u = {u}; "
                "use the default map, keep the action at 0, or pass ignore_input=True"
            )
        return None

    def reset(self, y0: np.ndarray) -> None:
        """Take in the first samples, (..., ny)."""
        self.observer.reset(y0)

    def restart(self, y0: np.ndarray, rows: np.ndarray) -> None:
        """Begin anew in some rows of a batch."""
        self.observer.restart(y0, rows)

    def advance(self, y: np.ndarray, u: np.ndarray | None, rows: np.ndarray | None = None) -> None:
        """Take in samples and the inputs that led to them; raises ValueError as :meth:`known`."""
        self.observer.advance(y, None if u is None else self.known(u), rows)

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """z and, unless only z is shown, x_hat; the score, if it is kept; of all rows or of some."""
        found = {"z": self.observer.z if rows is None else self.observer.z[rows]}
        if self.estimate == "x":
            found["x_hat"] = self.observer.decode(rows)
        if self._monitor:
            found["score"] = self.observer.score if rows is None else self.observer.score[rows]
        return found

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """What is shown of a report: x_hat or z."""
        return report["x_hat" if self.estimate == "x" else "z"]


def observation(values: np.ndarray, space: gym.spaces.Box) -> np.ndarray:
    """Values, one row or many, (..., width), as observations of a row's space: float32, within its bounds."""
    return clipped(values, space.low, space.high)


def _filter_space(plant: Plant, observer: KKLObserver) -> gym.spaces.Box:
    """Bounds of the filter's state under outputs within the output space and inputs within their bounds.

    Each is the response to the worst signal, the L1 norm of its impulse response. The filter starts from where a
    constant output would have led, so that its start lies within as well.
    """
    linear = observer.artifact.filter
    y_max = np.maximum(np.abs(plant.output_space.low), np.abs(plant.output_space.high)).astype(float)
    driven = np.hstack([linear.early_y, linear.late_y, linear.held_u])
    limits = np.concatenate([y_max, y_max, plant.system.u_max[: linear.nu]])
    forgetting = np.abs(np.linalg.eigvals(linear.transition)).max()
    bound = np.zeros(linear.size)
    for _ in range(int(np.ceil(np.log(1e-4) / np.log(forgetting)))):
        bound += np.abs(driven) @ limits
        driven = linear.transition @ driven
    bound = (1.001 * bound).astype(np.float32)  # for the tail of the sum
    return gym.spaces.Box(-bound, bound, dtype=np.float32)
