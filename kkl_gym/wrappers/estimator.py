"""What single and vector wrappers share: an observer fitted to a plant, and what it shows."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from typing import Protocol

import gymnasium as gym
import numpy as np

from kkl_gym.plant import Plant
from kkl_gym.rows import clipped
from observers import Artifact, KKLObserver, LinearFilter, shipped
from observers.checks import choice, flag
from observers.names import resolve
from observers.spread import deviations


class Estimator(Protocol):
    """A batch of observers, as :class:`VectorEstimate` drives them.

    Attributes
    ----------
    space : gymnasium.spaces.Box
        Of one row's observation.
    """

    space: gym.spaces.Box

    def reset(self, y0: np.ndarray, x0: np.ndarray) -> object:
        """Forget the past and take in the first samples.

        Parameters
        ----------
        y0 : ndarray, shape (n, ny)
            First samples.
        x0 : ndarray, shape (n, nx)
            True states at these samples, for observers that are meant to know their starts.
        """
        ...

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray) -> None:
        """Forget the past in some rows and take in their first samples.

        Parameters
        ----------
        y0 : ndarray, shape (number of True in rows, ny)
            First samples.
        rows : ndarray of bool, shape (n,)
            Which rows begin anew.
        x0 : ndarray, shape (number of True in rows, nx)
            True states at these samples, as for :meth:`reset`.
        """
        ...

    def advance(self, y: np.ndarray, u: np.ndarray | None, rows: np.ndarray | None = None) -> None:
        """Take in one sample and the input that led to it.

        Parameters
        ----------
        y : ndarray, shape (n, ny)
            Samples.
        u : ndarray, shape (n, nu), or None
            Inputs held before them; None is zero.
        rows : ndarray of bool, shape (n,), optional
            Which rows take them in; None is all.
        """
        ...

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """What ``info`` gains.

        Parameters
        ----------
        rows : ndarray of bool, shape (n,), optional
            Of which rows; None is all.

        Returns
        -------
        dict of str to ndarray, shape (number of rows, ...)
            Values by their key in ``info``; ``x_hat`` are estimated states.
        """
        ...

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """What of a report is the observation.

        Parameters
        ----------
        report : mapping of str to ndarray
            As :meth:`report` returns it.

        Returns
        -------
        ndarray, shape (number of rows, width)
            Values for ``space``, not yet clipped.
        """
        ...


class KKLEstimator:
    """A learned observer, one sample or a batch at a time, and the space of what it shows.

    Parameters
    ----------
    artifact : Artifact
        The observer.
    space : gymnasium.spaces.Box
        Of what is shown of a row.
    estimate : {"x", "z"}
        Whether the state estimate is shown, or the filter's state.
    measurement_noise : float, sequence of float or None
        The noise level that the observer assumes, of all outputs or each; None takes the artifact's.
    process_noise : float, optional
        Likewise of the motion.
    blind : bool
        Whether inputs act that the map does not know of.
    ignore_input : bool
        Whether it is used even so.
    monitor : bool
        Whether to keep the score.
    known_start : bool
        Whether the observer is told the true state at the start of an episode, and only there.
    uncertainty : bool
        Whether standard deviations are shown behind the state estimate.
    compiled : bool, optional
        As for :class:`observers.KKLObserver`.

    Attributes
    ----------
    observer : KKLObserver
        The observer, its noise levels set.
    estimate : str
        As given.
    space : gymnasium.spaces.Box
        As given.

    Raises
    ------
    ValueError
        If ``estimate`` is unknown, a flag is no bool, the noise level is beyond the map's range, or ``uncertainty`` is
        asked for beside z.
    observers.ArtifactError
        If the artifact holds no forward map or flow and ``known_start`` is asked for, or no error bars and
        ``uncertainty``.
    """

    def __init__(
        self,
        artifact: Artifact,
        space: gym.spaces.Box,
        *,
        estimate: str,
        measurement_noise: float | Sequence[float] | None,
        process_noise: float | None = None,
        blind: bool = False,
        ignore_input: bool = False,
        monitor: bool,
        known_start: bool,
        uncertainty: bool,
        compiled: bool | None = None,
    ) -> None:
        choice("estimate", estimate, ("x", "z"))
        self._uncertainty = flag("uncertainty", uncertainty)
        self._ignore_input = flag("ignore_input", ignore_input)
        self._known_start = flag("known_start", known_start)
        self._monitor = flag("monitor", monitor)
        self.estimate, self.space, self._blind = estimate, space, blind
        self.observer = KKLObserver(
            self.asked(artifact), measurement_noise, process_noise=process_noise, monitor=monitor, compiled=compiled
        )

    @classmethod
    def of_plant(
        cls,
        plant: Plant,
        observer: str | os.PathLike[str] | Artifact | None,
        *,
        estimate: str,
        measurement_noise: float | Sequence[float] | None,
        ignore_input: bool,
        monitor: bool,
        known_start: bool,
        uncertainty: bool,
        compiled: bool | None = None,
    ) -> "KKLEstimator":
        """An observer that was learned for a plant, at the plant's levels of noise.

        Parameters
        ----------
        plant : Plant
            What is observed.
        observer : str or path or Artifact or None
            A shipped name, a path if it ends in ``.safetensors``, or what is behind one; None takes the map shipped for
            the plant's system.
        estimate, measurement_noise, ignore_input, monitor, known_start, uncertainty, compiled
            As for the class; without a level of measurement noise the plant's.

        Returns
        -------
        KKLEstimator
            The observer.

        Raises
        ------
        ValueError
            As the class, and if no map ships for the system.
        observers.ArtifactError
            As the class, and if the file is missing or damaged, or was made for another system, other parameters or
            another dt.
        """
        choice("estimate", estimate, ("x", "z"))
        uncertainty, system = flag("uncertainty", uncertainty), plant.system
        if observer is None and system.name not in shipped():
            raise ValueError(f"no map ships for {system.name!r}: train one and pass observer='….safetensors'")
        artifact = observer if isinstance(observer, Artifact) else Artifact.read(resolve(observer or system.name))
        artifact.check(system.name, system.parameters, dt=plant.dt, ny=system.ny, nu=system.nu)  # before noise
        space = _filter_space(plant, artifact.filter) if estimate == "z" else plant.state_space
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
            monitor=monitor,
            known_start=known_start,
            uncertainty=uncertainty,
            compiled=compiled,
        )

    def replace(self, observer: str | os.PathLike[str] | Artifact) -> None:
        """Take other maps for the same filter, which goes on.

        Parameters
        ----------
        observer : str or path or Artifact
            A shipped name, a path if it ends in ``.safetensors``, or what is behind one.

        Raises
        ------
        ValueError
            As :meth:`observers.KKLObserver.replace`.
        observers.ArtifactError
            If it differs in more than its maps, or holds no forward map and starts are known, or no error bars and
            they are shown.
        """
        self.observer.replace(self.asked(observer))

    def asked(self, observer: str | os.PathLike[str] | Artifact) -> Artifact:
        """What :meth:`replace` would take.

        Parameters
        ----------
        observer : str or path or Artifact
            As there.

        Returns
        -------
        Artifact
            The observer, without its flow where nobody asks for what that estimates.

        Raises
        ------
        ValueError
            If it holds no forward map and starts are known, or no error bars and they are shown.
        observers.ArtifactError
            If the file is missing or damaged.
        """
        artifact = observer if isinstance(observer, Artifact) else Artifact.read(resolve(observer))
        if self._known_start:
            artifact.require_known_start()  # an error now, not at the first reset
        if self._uncertainty and self.estimate != "x":
            raise ValueError(f"uncertainty=True is about x_hat: it needs estimate='x', got {self.estimate!r}")
        if self._uncertainty:
            artifact.require_spread()
        if self.estimate == "x" or self._monitor or self._known_start:
            return artifact
        return dataclasses.replace(artifact, flow=None)

    def known(self, u: np.ndarray) -> np.ndarray | None:
        """The input as far as the map knows it.

        Parameters
        ----------
        u : ndarray, shape (..., nu)
            What the environment applied.

        Returns
        -------
        ndarray, shape (..., nu), or None
            The same; None if the map knows no inputs.

        Raises
        ------
        ValueError
            If the agent acts on a map that knows no inputs, and ``ignore_input`` is false.
        """
        if not self._blind:
            return u
        if not self._ignore_input and u.any():
            raise ValueError(
                f"the map {self.observer.artifact.system!r} in use knows no inputs, but the agent applied u = {u}; "
                "use the default map, keep the action at 0, or pass ignore_input=True"
            )
        return None

    def reset(self, y0: np.ndarray, x0: np.ndarray) -> None:
        """Forget the past and take in the first samples.

        Parameters
        ----------
        y0 : ndarray, shape (..., ny)
            First samples, whose leading shape is the batch's.
        x0 : ndarray, shape (..., nx)
            True states, which are not looked at unless starts are known.
        """
        self.observer.reset(y0, x0 if self._known_start else None)

    def restart(self, y0: np.ndarray, rows: np.ndarray, x0: np.ndarray) -> None:
        """Forget the past in some rows and take in their first samples.

        Parameters
        ----------
        y0 : ndarray, shape (number of True in rows, ny)
            First samples.
        rows : ndarray of bool, shape (n,)
            Which rows begin anew.
        x0 : ndarray, shape (number of True in rows, nx)
            True states, as for :meth:`reset`.
        """
        self.observer.restart(y0, rows, x0 if self._known_start else None)

    def advance(self, y: np.ndarray, u: np.ndarray | None, rows: np.ndarray | None = None) -> None:
        """Take in samples and the inputs that led to them.

        Parameters
        ----------
        y : ndarray, shape (..., ny)
            Samples.
        u : ndarray, shape (..., nu), or None
            Inputs held before them; None is zero.
        rows : ndarray of bool, shape (...,), optional
            Which rows take them in; None is all.

        Raises
        ------
        ValueError
            As :meth:`known`.
        """
        self.observer.advance(y, None if u is None else self.known(u), rows)

    def report(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """What ``info`` gains.

        Parameters
        ----------
        rows : ndarray of bool, shape (...,), optional
            Of which rows; None is all.

        Returns
        -------
        dict of str to ndarray
            ``z``, and ``x_hat`` if it is shown, with ``x_cov`` beside it if standard deviations are, and
            ``parameters_hat`` if the map estimates parameters: with ``estimate="z"`` the network is not evaluated.
            ``score`` with a monitor, which evaluates the network in any case.
        """
        found = {"z": self.observer.z if rows is None else self.observer.z[rows]}
        if self.estimate == "x":
            found["x_hat"] = self.observer.decode(rows)
            if self._uncertainty:
                found["x_cov"] = self.observer.decode_covariance(rows)
            if self.observer.artifact.estimated_parameters:
                found["parameters_hat"] = self.observer.parameters_hat[... if rows is None else rows]
        if self._monitor:
            found["score"] = self.observer.score if rows is None else self.observer.score[rows]
        return found

    def shown(self, report: Mapping[str, np.ndarray]) -> np.ndarray:
        """What of a report is the observation.

        Parameters
        ----------
        report : mapping of str to ndarray
            As :meth:`report` returns it.

        Returns
        -------
        ndarray, shape (..., width)
            x_hat or z, not yet clipped; behind x_hat its standard deviations if they are shown.
        """
        if self._uncertainty:
            return np.concatenate([report["x_hat"], deviations(report["x_cov"])], axis=-1)
        return report["x_hat" if self.estimate == "x" else "z"]

    def listed(self, report: Mapping[str, np.ndarray]) -> list[float]:
        """As :meth:`shown`, of a single sample: of so few numbers every call of NumPy would be felt.

        Parameters
        ----------
        report : mapping of str to ndarray
            As :meth:`report` returns it.

        Returns
        -------
        list of float
            What :meth:`shown` returns.
        """
        values: list[float] = report["x_hat" if self.estimate == "x" else "z"].tolist()
        if self._uncertainty:
            variances = report["x_cov"].ravel().tolist()[:: len(values) + 1]
            values += [math.sqrt(value) if value >= 0.0 else math.nan for value in variances]
        return values


def observation(values: np.ndarray, space: gym.spaces.Box) -> np.ndarray:
    """Values as observations: float32, within the bounds of their space.

    Parameters
    ----------
    values : ndarray, shape (..., width)
        One row or many.
    space : gymnasium.spaces.Box, shape (width,)
        Of one row.

    Returns
    -------
    ndarray of float32, shape (..., width)
        A copy.
    """
    return clipped(values, space.low, space.high)


def with_deviations(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of states and of their standard deviations behind them, which are no larger than the bounds are wide.

    Parameters
    ----------
    low, high : ndarray, shape (nx,)
        Bounds of the states.

    Returns
    -------
    low, high : ndarray, shape (2 nx,)
        Bounds of both.
    """
    with np.errstate(over="ignore"):  # what float32 cannot hold is unbounded
        return np.concatenate([low, np.zeros_like(low)]), np.concatenate([high, high - low])


def _filter_space(plant: Plant, linear: LinearFilter) -> gym.spaces.Box:
    """Bounds of the filter's state under outputs within the output space and inputs within their bounds.

    A known start may lie outside for a while, where the motion that led to it did; what is shown is then clipped.
    """
    y_max = np.maximum(np.abs(plant.output_space.low), np.abs(plant.output_space.high)).astype(float)
    bound = reach(linear, y_max, np.array(plant.system.u_max[: linear.nu])).astype(np.float32)
    return gym.spaces.Box(-bound, bound, dtype=np.float32)


def reach(linear: LinearFilter, y_max: np.ndarray, u_max: np.ndarray) -> np.ndarray:
    """Largest sizes that the state of a filter can have.

    Each is the response to the worst signal, the L1 norm of its impulse response. The filter starts from where a
    constant output would have led, so that its start lies within as well.

    Parameters
    ----------
    linear : LinearFilter
        The filter.
    y_max : ndarray, shape (ny,)
        Largest sizes of the outputs, which may be infinite.
    u_max : ndarray, shape (nu,)
        Those of the inputs, likewise.

    Returns
    -------
    ndarray, shape (size,)
        Infinite where a signal's size is that acts there.
    """
    driven = np.hstack([linear.early_y, linear.late_y, linear.held_u])
    limits = np.concatenate([y_max, y_max, u_max])
    endless = (driven[:, np.isinf(limits)] != 0).any(1)
    limits = np.where(np.isinf(limits), 0.0, limits)
    forgetting = np.abs(np.linalg.eigvals(linear.transition)).max()
    bound = np.zeros(linear.size)
    for _ in range(int(np.ceil(np.log(1e-4) / np.log(forgetting)))):
        bound += np.abs(driven) @ limits
        driven = linear.transition @ driven
    return np.where(endless, np.inf, 1.001 * bound)  # for the tail of the sum
