"""A source of simulated motions."""

import functools
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from kkl_gym.simulate import simulate
from kkl_gym.system import System
from observers import Artifact, Equations, LinearFilter
from training.config import Config
from training.maps.coordinates import spread
from training.presets import named_policy
from training.seeds import Stream, generator
from training.sources import Increments, Pairs, Runs
from training.trajectories.equations import describe, digest, field_expression, output_facts
from training.trajectories.motions import DRIVEN, KINDS, Motions, Report, recording_ages
from training.trajectories.parameters import blind, nominal_share, relative_ranges, with_bias, with_parameters

LEAD_IN_SHARE = 0.4  # in this share of the motions without inputs, earlier inputs have moved the start
BEYOND = 2.0  # size, relative to X, of the box in which a third of the calibration runs start
# Random inputs drive half of the calibration runs. A policy, if given, drives all, and explores in half of them.
SOUND: dict[str, Any] = {"kinds": ("steps", "zero", "sine", "zero", "pulses", "zero"), "far": 1 / 3, "own": 2}
LEAST_NOISE = 0.001  # least measurement noise of a tracker, relative to the system's (if 0, to 5 % of y's range)
LEAST_PROCESS_NOISE = 0.005  # a tracker's least process noise, in System.scale per System.pace; a tenth of the default
WINDOW, RUN = 0.5, 20.0  # durations of a tracker's window and of a calibration run, in multiples of System.pace
SUBSTEPS = 64  # largest number of Runge-Kutta steps in a sampling interval
INTEGRATION_ERROR = 2e-5  # steps are halved until 99 % of the errors are below this, in standard deviations of x
TOO_FAR_OFF = 0.01  # in the same unit: if SUBSTEPS steps err by more, as where f jumps, a Flow is learned instead
INCREMENTS, JUDGED = 200_000, 0.05  # number of increments for a Flow, and the share held out to measure its error
DEVIATIONS = (1e-4, 0.3)  # least and largest rms distance of an increment's start from a motion, in standard deviations


class SimulatedSource:
    """Simulated motions of a system, with process noise and random inputs.

    Parameters
    ----------
    system : System
        The system to simulate.
    config : Config
        Settings of the training. The source itself reads only the settings of motions, such as duration, dt, inputs,
        policy, uncertain parameters, bias and seed.

    Raises
    ------
    ValueError
        If the policy is unknown or invalid, an uncertain parameter is 0 or no parameter of the system, or ``bias`` does
        not fit the outputs.
    """

    def __init__(self, system: System, config: Config) -> None:
        self.config, self.system = config, system
        policy = None if config.policy is None else named_policy(system, config.policy, config.dt)
        self.policy = policy and blind(policy, system.nx)
        if np.any(config.bias):
            system = with_bias(system, config.bias)
        self.ranges, self.model, self.plant = {}, system, system
        if config.uncertain:
            self.ranges = relative_ranges(system, config.uncertain)
            self.plant = with_parameters(system, self.ranges, in_training=True)
        self.estimated = tuple(self.ranges) if config.estimate_parameters else ()
        self.name = self.system.name
        self.nx, self.ny, self.dt, self.pace = system.nx, system.ny, config.dt, system.pace
        aware = config.pipeline == "input-aware"
        self.nu = system.nu if aware and config.inputs else 0
        self.has_free_map = bool(self.nu and config.free_inverse and not self.policy)
        self.process_noise_share = config.process_noise_share if aware else 0.0
        self.process_noise = float(system.process_noise) if self.process_noise_share else 0.0
        self.steps = max(1, round(config.duration / config.dt))
        self.ages = recording_ages(self.steps, config.samples)

    def identity(self) -> dict[str, Any]:
        """Return the equations, noise, policy and all else that motions depend on, except the settings."""
        system = self.system
        noise = {"process_noise": float(system.process_noise), "scale": list(map(float, system.scale))}
        identity = describe(system) | noise
        if self.ranges:
            identity["nominal_share"] = nominal_share(self.ranges)
        if self.policy:
            actions = self.policy(self.model.draw_starts(np.random.default_rng(0), 20))
            identity["policy_actions"] = digest(np.round(actions, 6).tolist())  # rounded, so that all machines agree
        return identity

    def facts(self) -> dict[str, Any]:
        """Return the arguments of :class:`observers.Artifact` that describe the system."""
        system, output = self.model, dict[str, Any]()
        with suppress(ValueError):  # tracking() reports this error
            output = output_facts(system)
        return {
            "system": self.name,
            "parameters": self.system.parameters,
            "measurement_noise": system.measurement_noise,
            "u_max": tuple(map(float, system.u_max)),
            "parameter_ranges": self.ranges,
            "estimated_parameters": self.estimated,
            **output,
        }

    def sampling(self, linear: LinearFilter) -> dict[str, Any]:
        """Return arguments of :class:`training.maps.inverse.TrajectorySampler` that depend on the system."""
        return {
            "measurement_noise": self.model.measurement_noise,
            "process_noise_max": self.process_noise,
            "parameters": len(self.estimated),
        }

    def pairs(self, linear: LinearFilter, *, free: bool = False, report: Report = lambda done: None) -> Pairs:
        """Return states of motions and of a filter along them. If ``free``, inputs act at most before a start."""
        config, rng = self.config, generator(Stream.TRAINING, self.config.seed, *([1] if free else []))
        how: dict[str, Any] = {"kinds": DRIVEN if self.has_free_map else KINDS, "policy": self.policy}
        if free:
            how = {"lead_in_share": LEAD_IN_SHARE, "lead_in_input": config.lead_in_input}
        how |= {"process_noise_share": self.process_noise_share, "box_factor": config.box_factor}
        motions = Motions(self.plant, self.dt, self.steps, **how)
        pairs = motions.beside(linear, self.ages, config.trajectories, rng, report)
        nominal = None
        if self.ranges:
            own = [self.model.parameters[name] for name in self.ranges]
            nominal = (pairs.x[0, :, self.nx :] == own).all(-1)
        return replace(pairs, x=pairs.x[..., : self.nx + len(self.estimated)], nominal=nominal)

    def runs(self, *, report: Report = lambda done: None) -> Runs:
        """Return motions, with process noise 0 or the system's; a third of them start in 2X, the others in X."""
        rng, steps = generator(Stream.CALIBRATION, self.config.seed), max(1, round(RUN * self.pace / self.dt))
        plant, n = with_parameters(self.model, self.ranges) if self.ranges else self.model, self.config.runs
        how: dict[str, Any] = SOUND | {"levels": (0.0, self.process_noise), "box_factor": BEYOND}
        motions = Motions(plant, self.dt, steps, **how, policy=self.policy).with_inputs(self.nu)
        x, u, noise, usual = motions.drawn(n, rng, lambda done: report(done / n))
        return Runs(x[..., : self.nx], plant.output(x), u[..., : self.nu], noise, usual, sound=True)

    def equations(self) -> Equations:
        """Return the system's equations as an expression, with as many Runge-Kutta steps as its motions need."""
        field = field_expression(self.model, inputs=bool(self.nu))
        if self.model.discrete:
            return Equations(field, 0)
        x, u = self._states(4)
        later = simulate(self.model, x, 1, self.dt, u=u[None] if self.model.nu else None)[-1]
        inside = np.isfinite(later).all(-1)
        for substeps in (2**i for i in range(SUBSTEPS.bit_length())):
            equations = Equations(field, substeps)
            with np.errstate(all="ignore"):  # too long a step may overflow
                apart = np.abs(equations(x, u, self.dt) - later)[inside] / self._scale[1]
            off = np.quantile(apart.max(-1), 0.99)
            if off <= INTEGRATION_ERROR:
                break
        if not off <= TOO_FAR_OFF:
            raise ValueError(
                f"{SUBSTEPS} Runge-Kutta steps per {self.dt:g} s err by {off:.2g} > {TOO_FAR_OFF:g} standard deviations"
            )
        return equations

    def increments(self, *, report: Report = lambda done: None) -> tuple[Increments, Increments]:
        """Return changes of the state over one sampling interval, near motions: for training, and held out."""
        rng = generator(Stream.CALIBRATION, self.config.seed, 5)
        along, u = self._states(300)
        rows = rng.integers(len(along), size=INCREMENTS)
        smallest, largest = np.log(DEVIATIONS)
        size = np.exp(rng.uniform(smallest, largest, (INCREMENTS, 1)))
        low, high = np.array(self.model.bounds, dtype=float).T
        x = np.clip(along[rows] + size * self._scale[1] * rng.standard_normal((INCREMENTS, self.nx)), low, high)
        u = np.where(rng.random((INCREMENTS, 1)) < 0.5, 0.0, u[rows]) if self.nu else np.zeros((INCREMENTS, 0))
        later = simulate(self.model, x, 1, self.dt, u=u[None] if self.nu else None)[-1]
        inside = np.isfinite(later).all(-1)
        both = x[inside], u[inside], (later - x)[inside]
        held = round(JUDGED * inside.sum())
        return Increments(*(each[held:] for each in both)), Increments(*(each[:held] for each in both))

    def judged(self, artifact: Artifact) -> dict[str, Any]:
        """Return no errors: ``kkl-gym evaluate`` measures those of simulated systems."""
        return {}

    def tracking(self) -> dict[str, Any]:
        """Return observers.Motion's arguments except equations, flow, factors; ValueError if tracking is impossible."""
        system = self.model
        if self.ranges:
            raise ValueError(f"a tracker needs exact parameters, but these are uncertain: {', '.join(self.ranges)}")
        output_facts(system)  # raises ValueError if an artifact cannot hold the output
        low, high = np.array(system.bounds, dtype=float).T
        offset, scale = self._scale
        mean, covariance = unknown_start(system)
        usual = np.broadcast_to(np.asarray(system.measurement_noise, dtype=float), (self.ny,))
        least = LEAST_NOISE * np.where(usual > 0, usual, 0.05 * np.array(system.output_range))
        return {
            "x_offset": offset,
            "x_scale": scale,
            "low": low,
            "high": high,
            "mean": mean,
            "covariance": covariance,
            "error": np.zeros(self.nx),
            "process_noise": np.array(system.scale) / scale * self.dt / np.sqrt(3),
            "least_process_noise": LEAST_PROCESS_NOISE / self.pace,
            "least_measurement_noise": least,
            "window": WINDOW * self.pace,
        }

    @functools.cached_property
    def _scale(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and standard deviation, (nx,) each, of the states along motions from X and 2X."""
        along, _ = self._states(4)
        return along.mean(0), spread(along)

    def _states(self, paces: float) -> tuple[np.ndarray, np.ndarray]:
        """Return states (n, nx) and inputs (n, nu) along motions from X and 2X over ``paces`` times System.pace."""
        rng, steps = generator(Stream.CALIBRATION, self.config.seed, 6), max(1, round(paces * self.pace / self.dt))
        motions = Motions(self.model, self.dt, steps, KINDS, self.policy, box_factor=BEYOND).with_inputs(self.nu)
        x, u, *_ = motions.drawn(100, rng)
        every = max(1, steps // 500)
        x, u = x[:-1:every].reshape(-1, self.nx), u[::every]
        return x, u.reshape(-1, self.model.nu) if self.nu else np.zeros((len(x), self.model.nu))


def unknown_start(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (nx,) and covariance (nx, nx) of starts drawn in X."""
    low, high = system.box()
    if type(system).draw_starts is System.draw_starts:
        return (low + high) / 2, np.diag((high - low) ** 2 / 12)
    x = system.draw_starts(np.random.default_rng(0), 10_000)
    return x.mean(0), np.cov(x.T).reshape(system.nx, -1) + np.diag(1e-6 * (high - low) ** 2)
