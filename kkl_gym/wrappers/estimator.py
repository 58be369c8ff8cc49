"""The observer inside single and vector wrappers, and the observations and ``info`` that it gives."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym.plant import Plant
from observers import Artifact, KKLObserver, shipped
from observers.checks import choice, flag, shown
from observers.estimator import Estimator, Running
from observers.factors import standard_deviations
from observers.names import resolve


class Estimates:
    """Adapts any state estimator to the calls of :class:`VectorEstimate`; the true starts ``x0`` are ignored."""

    def __init__(self, estimator: Estimator[Any], space: gym.spaces.Box) -> None:
        self._running, self.space = Running(estimator), space
        self.advance = self._running.advance

    def reset(self, y0: np.ndarray, x0: np.ndarray) -> None:
        """Begin an episode with its first samples. Shapes: ``y0`` (n, ny), ``x0`` (n, nx)."""
        self._running.reset(y0)

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray) -> None:
        """Begin episodes where ``rows`` (n,) is True, with their first samples (number of True, ny)."""
        self._running.restart(y0, rows)

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the entries (m, ...) to add to ``info``, of all environments or the m where ``rows`` (n,) is True."""
        return {"x_hat": self._running.decode(rows)}

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the observations in a report, (m, width)."""
        return report["x_hat"]


class KKLEstimator:
    """A learned observer for one environment or a batch, and the space of its observations."""

    def __init__(
        self,
        artifact: Artifact,
        space: gym.spaces.Box,
        *,
        estimate: str = "x",
        measurement_noise: float | Sequence[float] | None = None,
        process_noise: float | None = None,
        blind: bool = False,
        ignore_input: bool = False,
        monitor: bool = False,
        known_start: bool = False,
        uncertainty: bool = False,
        compiled: bool | None = None,
    ) -> None:
        choice("estimate", estimate, ("x", "z"))
        self._uncertainty = flag("uncertainty", uncertainty)
        self._ignore_input = flag("ignore_input", ignore_input)
        self._known_start = flag("known_start", known_start)
        self._monitor = flag("monitor", monitor)
        self.estimate, self.space, self._blind = estimate, space, blind
        tracks = estimate == "x" or self._monitor or self._known_start
        how: dict[str, Any] = {"process_noise": process_noise, "monitor": monitor, "compiled": compiled}
        self.observer = KKLObserver(self.asked(artifact), measurement_noise, tracking=None if tracks else False, **how)

    @classmethod
    def of_plant(
        cls,
        plant: Plant,
        observer: str | os.PathLike[str] | Artifact | None,
        *,
        estimate: str = "x",
        measurement_noise: float | Sequence[float] | None = None,
        ignore_input: bool = False,
        known_start: bool = False,
        uncertainty: bool = False,
        **how: Any,
    ) -> "KKLEstimator":
        """Return an observer for a plant, by default at the plant's noise levels; ValueError if it does not fit."""
        choice("estimate", estimate, ("x", "z"))
        uncertainty, system = flag("uncertainty", uncertainty), plant.system
        if observer is None and system.name not in shipped():
            raise ValueError(f"no map ships for {system.name!r}: train one and pass observer='….safetensors'")
        artifact = observer if isinstance(observer, Artifact) else Artifact.read(resolve(observer or system.name))
        # A wrong system must be reported before wrong noise levels.
        artifact.check(system.name, system.parameters, dt=plant.dt, ny=system.ny, nu=system.nu)
        if flag("known_start", known_start) and artifact.nx > system.nx:
            raise ValueError("leave known_start out: this observer estimates a bias too, of which no start is known")
        space: gym.spaces.Box = gym.spaces.Box(-np.inf, np.inf, (artifact.filter.size,))
        if estimate == "x":
            space = _estimate_space(plant, artifact.nx)
        if uncertainty:
            low, high = with_deviations(space.low, space.high)
            space = gym.spaces.Box(low, high, dtype=np.float32)
        return cls(
            artifact,
            space,
            estimate=estimate,
            measurement_noise=plant.measurement_noise if measurement_noise is None else measurement_noise,
            process_noise=plant.process_noise,
            blind=artifact.nu == 0 < system.nu,
            ignore_input=ignore_input,
            known_start=known_start,
            uncertainty=uncertainty,
            **how,
        )

    def replace(self, observer: str | os.PathLike[str] | Artifact) -> None:
        """Use another map, which must have the same filter; the filter's state stays."""
        self.observer.replace(self.asked(observer))

    def asked(self, observer: str | os.PathLike[str] | Artifact) -> Artifact:
        """Return the artifact that :meth:`replace` would use; ValueError if it lacks a part that an option needs."""
        artifact = observer if isinstance(observer, Artifact) else Artifact.read(resolve(observer))
        if self._known_start:
            artifact.require_known_start(tracking=artifact.motion is not None)  # now, not at the first reset
        if self._uncertainty and self.estimate != "x":
            raise ValueError(f"uncertainty=True is about x_hat: it needs estimate='x', got {self.estimate!r}")
        if self._uncertainty:
            artifact.require_covariance()
        return artifact

    def known(self, u: np.ndarray) -> np.ndarray | None:
        """Return ``u`` (..., nu), or None for a map without inputs; ValueError if u is then nonzero and not ignored."""
        if not self._blind:
            return u
        if not self._ignore_input and u.any():
            raise ValueError(
                f"the map {self.observer.artifact.system!r} in use takes no inputs, but the agent applied u = {u}; "
                "use the default map, keep the action at 0, or pass ignore_input=True"
            )
        return None

    def reset(self, y0: np.ndarray, x0: np.ndarray) -> None:
        """Begin an episode with its first samples. Shapes: ``y0`` (..., ny), ``x0`` (..., nx)."""
        self.observer.reset(y0, x0 if self._known_start else None)

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray) -> None:
        """Begin episodes where ``rows`` (n,) is True, with their first samples (number of True, ny)."""
        self.observer.restart(y0, rows, x0 if self._known_start else None)

    def advance(self, y: np.ndarray, u: np.ndarray | None, rows: np.ndarray | None = None) -> None:
        """Process samples (..., ny), NaN where missing, and the inputs (..., nu) that led to them."""
        self.observer.advance(y, None if u is None else self.known(u), rows)

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the entries to add to ``info``, of all environments or where ``rows`` (...,) is True."""
        found = {"z": self.observer.z if rows is None else self.observer.z[rows]}
        if self.estimate == "x":
            found["x_hat"] = self.observer.decode(rows)
            if self._uncertainty:
                found["x_cov"] = self.observer.decode_covariance(rows)
            if self.observer.artifact.estimated_parameters:
                found["parameters_hat"] = self.observer.parameters_hat[... if rows is None else rows]
        if self.observer.gate is not None:
            found["rejected"] = self.observer.rejected if rows is None else self.observer.rejected[rows]
        if self._monitor:
            found["score"] = self.observer.score if rows is None else self.observer.score[rows]
        return found

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the observations in a report, (..., width)."""
        if self._uncertainty:
            return np.concatenate([report["x_hat"], standard_deviations(report["x_cov"])], axis=-1)
        return report["x_hat" if self.estimate == "x" else "z"]

    def listed(self, report: Mapping[str, np.ndarray]) -> list[float]:
        """Return :meth:`shown` for a single sample as a list, which is faster than NumPy for a few numbers."""
        values: list[float] = report["x_hat" if self.estimate == "x" else "z"].tolist()
        if self._uncertainty:
            variances = report["x_cov"].ravel().tolist()[:: len(values) + 1]
            values += [math.sqrt(value) if value >= 0.0 else math.nan for value in variances]
        return values


def observation(values: np.ndarray, space: gym.spaces.Box) -> np.ndarray:
    """Return values (..., width) as observations: float32, clipped to their space."""
    with np.errstate(over="ignore"):  # values beyond float32 become infinite
        out = values.astype(np.float32)
    np.maximum(out, space.low, out=out)
    return np.minimum(out, space.high, out=out)


def check_untouched(obs: Any, emitted: bytes, env: Any, inside: Any) -> None:
    """Raise ValueError if ``env``, or a wrapper between it and the environment ``inside``, changed observations."""
    if isinstance(obs, np.ndarray) and obs.tobytes() == emitted:
        return
    between = []
    while env is not inside and hasattr(env, "env"):
        between.append(type(env).__name__)
        env = env.env
    raise ValueError(
        f"a wrapper between the environment and the observer ({', '.join(between) or shown(env)}) changes "
        "observations, but the observer reads info['y'], which stays the same: put that wrapper outside, or "
        "give the environment a sensor with the same effect, as in gym.make(ID, sensor=kkl_gym.Sensor(bias=0.1))"
    )


def with_deviations(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (2 nx,) of states, and of their standard deviations, which are at most ``high`` - ``low``."""
    with np.errstate(over="ignore"):  # widths beyond float32 become infinite
        return np.concatenate([low, np.zeros_like(low)]), np.concatenate([high, high - low])


def _estimate_space(plant: Plant, nx: int) -> gym.spaces.Box:
    """Return the space of estimates, with the bounds of the states; other estimates, as of a bias, are unbounded."""
    space, others = plant.state_space, np.full(max(0, nx - plant.system.nx), np.inf, dtype=np.float32)
    low, high = np.concatenate([space.low, -others]), np.concatenate([space.high, others])
    return gym.spaces.Box(low, high, dtype=np.float32)
