"""Gymnasium environments of single systems, with process noise, measurement noise and a bounded input."""

import itertools
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from kkl_gym.compiled import single_step
from kkl_gym.equations import complex_motion, components
from kkl_gym.plant import OfPlant, Plant
from kkl_gym.rendering import (
    ARRAYS_AND_WINDOWS,
    TRAIL,
    Canvas,
    Window,
    render_metadata,
    samples_a_frame,
)
from kkl_gym.sensor import Readings, Sensor
from kkl_gym.simulate import advance, followed
from kkl_gym.system import Box, Components, System, reward_of
from observers.checks import integer, mapping, real_array, shown

# A reset after this number of samples compiles the step; in shorter simulations compiling costs more than it saves.
SOON = 1000
_KEYS = (("a", "d"), ("s", "w"))  # keys for the lower and the upper bound of the first two inputs
_INTEGER, _FLOAT32 = np.dtype(np.int64), np.dtype(np.float32)
_ACTIONS = (_FLOAT32, np.dtype(np.float64))  # dtypes of actions that need no conversion


class KKLEnv(OfPlant, gym.Env[np.ndarray, np.ndarray]):
    r"""Environment with one system under process noise and measurement noise.

    x' = f(x) + g(x) u + w, y_k = h(x(t_k)) + v_k. The simulation holds the input and the process noise over each
    sampling interval (paper, sec. 7, eq. sys-noisy).

    **Timing.** ``reset`` returns the sample y_0 = h(x_0) + v_0; ``step(a_k)`` holds u_k and w_k over [t_k, t_k+1]
    and returns the sample y_k+1.

    **Action.** ``Box(-1, 1, (nu,))``, multiplied by the system's input bounds; values outside are clipped. Under action
    0 the motion is free.

    **Observation.** float32: the true state x (``observe="state"``) or the noisy output y (``observe="output"``). x is
    within the system's declared bounds. y is clipped to the range of noise-free outputs within these bounds, widened by
    six standard deviations of the noise. Where the ``sensor`` delivers no sample, an output keeps its last value.

    **Info.** The keys are the same at reset and at steps. ``y`` is the noisy output (NaN where the ``sensor`` delivers
    no sample), ``x`` the true state, and ``u`` the physical input that acted (zero at reset). These arrays are float64
    and not clipped to the observation space. ``sample``, an integer of shape (), counts sampling intervals since reset.
    ``escaped``, a bool of shape (), is true if the state left its declared bounds.

    **Reward.** The system's ``reward(x, u)`` at the new state x. The default is 1 / (1 + 4 c) in (0, 1] with
    c = mean(((x - target) / scale)^2). This reward is 1 at the system's target.

    **Ends.** An episode is ``terminated`` where the system's ``terminated(x)`` is true, and where the state leaves its
    declared bounds (``info["escaped"]``). At an escape, the last state and output inside the bounds are returned.
    The registered ids truncate after 5,000 steps.

    Parameters
    ----------
    system : str or System
        A shipped name, ``"module:Class"``, ``"script.py:Class"``, or a :class:`kkl_gym.System`.
    dt : float, optional
        Sampling interval in seconds. None takes the system's own, 0.01 s for the shipped ones.
    process_noise : float, optional
        Bound of the uniform noise w, as a multiple of the system's ``scale`` per second:
        \|w_i\| <= process_noise * scale_i. None takes the system's own default.
    measurement_noise : float or sequence of float, length ny, optional
        Standard deviation of the Gaussian noise v on each sample: one for all outputs, or one for each. None takes the
        system's own: 0.5 for the shipped ones; for others, if not set, 5 % of the range of each output over X.
    observe : {"state", "output"}
        Whether the agent sees the state x or the output y.
    parameters : mapping of str to float, optional
        Physical parameters of the system, by name, where they differ from its defaults.
    start_box : tuple of (float, float), length nx, optional
        (low, high) of each state: episodes start in this box. None takes the system's own starts, by default its
        training box.
    sensor : Sensor or mapping of its parameters, optional
        Sensor between the output and the observer. None is an ideal sensor, apart from the measurement noise.
    render_mode : {None, "rgb_array", "human"}
        What :meth:`render` does: nothing, return an image, or draw in a window. "human" needs the extra ``human``. Its
        window shows the motion in real time, from :meth:`reset` until :meth:`close`. An observer around the
        environment draws its estimate in the same window.

    Raises
    ------
    ValueError
        If the system, a parameter, ``observe`` or ``render_mode`` is unknown, dt <= 0, a noise level is negative or
        beyond 1e12, the ``sensor`` is invalid, or ``start_box`` does not lie within the declared bounds.

    Examples
    --------
    >>> import numpy as np
    >>> from kkl_gym import KKLEnv
    >>> env = KKLEnv("lorenz", dt=0.02, observe="output")
    >>> obs, info = env.reset(seed=0)
    >>> obs.shape, info["x"].shape
    ((1,), (3,))
    >>> obs, reward, terminated, truncated, info = env.step(np.array([0.5]))
    >>> info["u"], info["sample"]
    (array([5.]), array(1))
    """

    metadata = render_metadata(0.01, ARRAYS_AND_WINDOWS)

    def __init__(
        self,
        system: str | System,
        *,
        dt: float | None = None,
        process_noise: float | None = None,
        measurement_noise: float | Sequence[float] | None = None,
        observe: Literal["state", "output"] = "state",
        parameters: Mapping[str, float] | None = None,
        start_box: Box | None = None,
        sensor: Sensor | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.plant = Plant(
            system,
            dt=dt,
            process_noise=process_noise,
            measurement_noise=measurement_noise,
            observe=observe,
            parameters=parameters,
            start_box=start_box,
            sensor=sensor,
        )
        self.render_mode, self.metadata = render_mode, render_metadata(self.plant.dt, ARRAYS_AND_WINDOWS, render_mode)
        self.observe = observe
        self.observation_space, self.action_space = self.plant.observation_space, self.plant.action_space

        # Every step reads these attributes; Python numbers are faster here than arrays.
        self._nu = self.system.nu
        # Numbers of samples in this episode, and in earlier episodes of the same system.
        self._sample = self._samples = 0
        self._advance: Callable[..., Components]
        self._exchanged()
        self._bounds, self._u_max = self.system.bounds, self.system.u_max
        self._limits = [*zip(self.observation_space.low.tolist(), self.observation_space.high.tolist(), strict=True)]
        self._noise: list[tuple[list[float], list[float]]] = []
        self._readings = None if self.sensor is None else Readings(self.sensor, self.plant.ny, self.plant.dt, 1)
        self._held: list[float] = []  # the last sample of each output that the sensor delivered
        self._x: tuple[float, ...] | None = None
        self._u: list[float] | None = None  # the last input, for rendering
        self._trail: deque[tuple[float, ...]] = deque(maxlen=TRAIL)
        self._canvas: Canvas | None = None
        self._window: Window | None = None
        # The last observation. An outer observer wrapper raises an error if it receives another one.
        self.emitted = b""
        # Number of observer wrappers outside. The outermost draws the window; without a wrapper, the environment does.
        self.drawn_by = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, and return its first observation and info, which the class describes.

        Parameters
        ----------
        seed : int, optional
            Seed of starts and noise. None continues with the present generator.
        options : dict, optional
            ``"x0"``, shape (nx,), is the start. Without it the start is drawn (see ``start_box``).

        Raises
        ------
        ValueError
            If x0 has the wrong shape, is not finite or lies outside the declared bounds, if ``options`` is not a
            mapping or holds an unknown key, or if the seed is not an integer or is negative. The environment is then
            unchanged.
        """
        start = None
        for key, value in mapping("options", options).items():
            if key != "x0":
                raise ValueError(f'unknown reset option {shown(key)}; the only one is "x0"')
            start = None if value is None else self.plant.start(value)
        if seed is not None:
            seed = integer("seed", seed, 0)
            self._noise.clear()
        super().reset(seed=seed)
        if start is None:
            start = self.plant.draw_start(self.np_random)
        self._x = tuple(start.tolist())
        self._y = self._measure(self._next_noise()[1], start=True)
        self._samples += self._sample
        self._sample = 0
        if self._samples >= SOON:
            self._advance = single_step(self.system).advance
        self._u = None
        self._trail.clear()
        self._trail.append(self._x)
        if self.render_mode == "human" and not self.drawn_by:
            self.animate()
        info = self._info([0.0] * self._nu, False)
        return self._observation(info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold the input over one sampling interval, and return what the class describes.

        Parameters
        ----------
        action : array_like, shape (nu,)
            Inputs divided by their bounds; values outside [-1, 1] are clipped.

        Raises
        ------
        ValueError
            If the action has the wrong shape, or holds NaN or non-numbers. The environment is then unchanged.
        gymnasium.error.ResetNeeded
            Before :meth:`reset`.
        """
        if self._x is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        u = self._input(action)
        w, v = self._next_noise()
        x = self._advance(self._x, u, w, self.plant.dt)
        escaped = not self._inside(x)
        # A step may also end outside the bounds because its substeps were too coarse. Finer substeps verify the escape.
        if escaped:
            x = followed(self.system, self._x, u, w, dt=self.dt, end=x)
            escaped = not self._inside(x)
        if not escaped:
            self._x = tuple(x)
            self._y = self._measure(v, start=False)
        self._sample += 1
        if self.render_mode is not None:
            self._trail.append(self._x)
            self._u = u
            if self.render_mode == "human" and not self.drawn_by:
                self.animate()
        reward, ended = self._judged(self._x, u)
        info = self._info(u, escaped)
        return self._observation(info), float(reward), escaped or bool(ended), False, info

    def render(self) -> np.ndarray | None:
        """Draw the phase portrait so far. Returns a uint8 image (height, width, 3) for "rgb_array", otherwise None."""
        return self.draw()

    def draw(self, estimates: Collection[Sequence[float]] = ()) -> np.ndarray | None:
        """Draw the phase portrait with the states and the ``estimates`` so far, in order of time."""
        if self.render_mode is None:
            return None
        if self._x is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        if self._canvas is None or self._canvas.estimates != bool(estimates):
            self._canvas = Canvas(self.system, bool(estimates))
        frame = self._canvas.draw(self._trail, estimates, self._u)
        if self.render_mode != "human":
            return frame
        if self._window is None:
            self._window = Window(self.system.name.replace("_", " "), self.dt)
        self._window.show(frame)
        return None

    def animate(self, estimates: Collection[Sequence[float]] = ()) -> None:
        """Draw the window's next frame, if one is due at this sample; ``estimates`` as for :meth:`draw`."""
        if self._sample % samples_a_frame(self.dt) == 0:
            self.draw(estimates)

    def close(self) -> None:
        """Close the window, if one is open; the next frame opens another."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def get_keys_to_action(self) -> dict[tuple[int, ...], np.ndarray]:
        """Return keys for :func:`gymnasium.utils.play.play`.

        The keys a and d set the first input to its lower and upper bound, s and w the second. Also pass
        ``noop=np.zeros(nu, np.float32)`` to ``play``: this is the action while no key is pressed.
        """
        actions = {}
        for ends in itertools.product(*((("", 0), (low, -1), (high, 1)) for low, high in _KEYS[: self._nu])):
            action = np.zeros(self._nu, np.float32)
            action[: len(ends)] = [end for _, end in ends]
            actions[tuple(ord(key) for key, _ in ends if key)] = action
        del actions[()]
        return actions

    def __getstate__(self) -> dict[str, Any]:
        # Windows and compiled steps cannot be copied. A copy opens a window at its next frame, and compiles at a reset.
        return {**self.__dict__, "_canvas": None, "_window": None, "_advance": partial(advance, self.system)}

    def _exchanged(self) -> None:
        self._reward = reward_of(self.system)
        self._advance = partial(advance, self.system)
        # The next reset adds _sample, and _samples is then 0: samples of the old system do not count towards SOON.
        self._samples = -self._sample

    def _input(self, action: np.ndarray) -> list[float]:
        if type(action) is not np.ndarray or action.dtype not in _ACTIONS:
            action = real_array("the action", action)
        if action.shape != (self._nu,):
            raise ValueError(f"the action must have shape ({self._nu},), got {shown(action)}")
        u = []
        for a, u_max in zip(action.tolist(), self._u_max):
            if a != a:
                raise ValueError(f"the action must be numbers, got {shown(action)}")
            u.append(u_max if a > 1.0 else -u_max if a < -1.0 else a * u_max)
        return u

    def _measure(self, v: list[float], *, start: bool) -> list[float]:
        white = v if self._readings is None else [0.0] * self.plant.ny
        try:
            y = [float(hi + vi) for hi, vi in zip(self.system.h(self._x), white)]  # type: ignore[arg-type]
        except Exception:
            components(self.system.h, self._x)  # raises an EquationError that names the fault
            raise
        if self._readings is None:
            return y
        y = self._readings.read(np.array(y)[:, None], np.array(v)[:, None], start=start)[:, 0].tolist()
        self._held = [last if yi != yi else yi for yi, last in zip(y, y if start else self._held)]
        return y

    def _inside(self, x: Any) -> bool:
        try:
            for xi, (low, high) in zip(x, self._bounds):
                if not low <= xi <= high:  # false for NaN too
                    return False
        except TypeError:  # complex numbers cannot be compared
            raise complex_motion(self.system, self._x) from None
        return True

    def _observation(self, info: dict[str, Any]) -> np.ndarray:
        if self.observe == "state":  # the state is always within the bounds
            obs: np.ndarray = info["x"].astype(_FLOAT32)
        else:
            y = self._y if self._readings is None else self._held
            obs = np.array([max(low, min(high, yi)) for yi, (low, high) in zip(y, self._limits)], dtype=_FLOAT32)
        self.emitted = obs.tobytes()
        return obs

    def _info(self, u: list[float], escaped: bool) -> dict[str, Any]:
        return {
            "y": np.array(self._y),
            "x": np.array(self._x),
            "u": np.array(u),
            "sample": np.array(self._sample, _INTEGER),
            "escaped": np.array(escaped),
        }

    def _next_noise(self) -> tuple[list[float], list[float]]:
        """Return the next sample of the noises (w, v)."""
        if not self._noise:
            w, v = self.plant.noise(*self.plant.draw_noise(self.np_random))
            self._noise = [*zip(w.tolist()[::-1], v.tolist()[::-1], strict=True)]
        return self._noise.pop()
