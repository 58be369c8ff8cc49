"""Show an environment and its observer in a window; sliders set noise and input, buttons choose a sensor fault.

For your own system: ``python examples/live.py --system script.py --observer runs/NAME/NAME.safetensors``.
"""

import time
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
import tyro

import kkl_gym
from observers import Artifact
from observers.names import resolve
from training.commands.options import Shown, shown
from training.evaluation.faults import BIAS, FAULTS, Fault
from training.evaluation.levels import Level
from training.figures import ALARM, ESTIMATE, MEASURED, TRUTH, style

SECONDS = 12.0  # longest time axis, in multiples of System.pace
FRAME = 0.04  # seconds between frames
# Largest number of samples between two frames. If more are due, the motion in the window slows down.
MOST = 100
KEYS = "space: pause   n: new start   left, right: input   up, down: noise   f: next fault"


class Sensor(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Adds noise and faults to outputs that have no measurement noise; ``level`` and ``fault`` may be changed."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], level: Level, *, seed: int) -> None:
        super().__init__(env)
        self.level = level
        self.fault: Fault = "none"
        self._rng = np.random.default_rng(seed)
        plant = env.unwrapped.plant  # type: ignore[attr-defined]
        low, high = plant.start_box
        starts = np.random.default_rng(0).uniform(low, high, (256, plant.system.nx))
        self._bias = BIAS * np.ptp(plant.system.output(starts), axis=0)

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset the environment; the first sample has no fault."""
        obs, info = self.env.reset(**options)
        self._last = self._noisy(info["y"])
        return obs, info | {"y": self._last}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """Step the environment; ``info["y"]`` is the sensor's reading."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        y = self._noisy(info["y"])
        self._last = {"none": y, "bias": y + self._bias, "drop-out": 0.0 * y, "freeze": self._last}[self.fault]
        return obs, reward, terminated, truncated, info | {"y": self._last}

    def _noisy(self, y: np.ndarray) -> np.ndarray:
        return y + np.asarray(self.level) * self._rng.standard_normal(y.shape)


class Live:
    """An environment with its observer, on a figure that is redrawn continuously.

    ``clock`` is the time in s from sample to sample in the window, where one System.pace lasts 1 s. ``history`` holds
    x, x_hat, y and the monitor's score for each sample in the drawing.
    """

    def __init__(self, figure: Any, environment: Shown, measurement_noise: Level | None, *, seed: int) -> None:
        bare = gym.make(
            environment.env_id, **environment.options, measurement_noise=0.0, disable_env_checker=True
        ).unwrapped
        self.system, self.dt = environment.system, bare.dt  # type: ignore[attr-defined]
        level = self.system.measurement_noise if measurement_noise is None else measurement_noise
        self.sensor = Sensor(bare, level, seed=seed)
        limits = Artifact.read(resolve(environment.observer or self.system.name)).limits
        self.env = kkl_gym.KKLObservation(
            self.sensor, environment.observer, measurement_noise=level, monitor=limits is not None
        )
        self.clock = self.dt / self.system.pace
        self.seconds = min(SECONDS * self.system.pace, self.system.duration / 4)
        self.paused = False
        self.history: deque[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = deque(
            maxlen=round(self.seconds / self.dt) + 1
        )
        self._action = np.zeros(self.system.nu, np.float32)
        self._seed: int | None = seed
        self._layout(figure)
        self.restart()

    def restart(self) -> None:
        """Begin a motion at a new start."""
        _, info = self.env.reset(seed=self._seed)
        self._seed = None
        self.history.clear()
        self._remember(info)

    def advance(self, samples: int) -> None:
        """Advance by a number of samples; after a termination, begin a new motion."""
        for _ in range(samples):
            _, _, terminated, _, info = self.env.step(self._action)
            self._remember(info)
            if terminated:
                self.restart()

    def draw(self) -> list[Any]:
        """Update the drawing, and return its changed parts."""
        x, x_hat, y, score = (np.array(column) for column in zip(*self.history, strict=True))
        t = (np.arange(len(x)) - len(x) + 1) * self.dt
        i, j = self.system.portrait
        for states, (trail, dot) in zip((x, x_hat), self._portrait, strict=True):
            trail.set_data(states[:, i], states[:, j])
            dot.set_data(states[-1:, i], states[-1:, j])
        for k, (truth, guess) in enumerate(self._lanes):
            truth.set_data(t, x[:, k])
            guess.set_data(t, x_hat[:, k])
        for k, dots in self._measured:
            dots.set_data(t, y[:, k])
        self._score.set_data(t, np.minimum(score, 2.5))
        sound = not score[-1] > 1
        self._score.set_color(TRUTH if sound else ALARM)
        self._score_text.set_text("" if np.isnan(score[-1]) else f"{score[-1]:.2f}" + ("" if sound else ": a fault?"))
        return self.artists

    def press(self, key: str | None) -> None:
        """Act on a key that ``KEYS`` lists, and ignore all others."""
        if key == " ":
            self.paused = not self.paused
        elif key == "n":
            self.restart()
        elif key == "f":
            self._faults.set_active((FAULTS.index(self.sensor.fault) + 1) % len(FAULTS))
        elif key in ("left", "right") and self._input is not None:
            self._input.set_val(self._input.val + (0.1 if key == "right" else -0.1))
        elif key in ("up", "down"):
            step = self._noise.valmax / 20
            self._noise.set_val(self._noise.val + (step if key == "up" else -step))

    def _remember(self, info: dict[str, Any]) -> None:
        self.history.append((info["x"], info["x_hat"], info["y"], float(info.get("score", np.nan))))

    def _layout(self, figure: Any) -> None:
        system = self.system
        figure.suptitle(f"{system.name.replace('_', ' ')}: the observer sees only the output and the input")
        outer, controls = figure.subfigures(2, height_ratios=[6, 1])
        left, right = outer.subfigures(1, 2, width_ratios=[4, 5])
        portrait = left.subplots()
        i, j = system.portrait
        portrait.set(xlabel=system.state_names[i], ylabel=system.state_names[j])
        portrait.set(xlim=_wider(system.X[i]), ylim=_wider(system.X[j]))
        self._portrait = _pair(portrait, "-", "o")
        axes = right.subplots(system.nx + 1, sharex=True)
        self._lanes, self._measured = [], []
        C = self.env.observer.artifact.C
        for k, ax in enumerate(axes[:-1]):
            for output, row in enumerate([] if C is None else C):
                if np.array_equal(row, np.eye(system.nx)[k]):
                    self._measured.append((output, ax.plot([], [], ".", color=MEASURED, ms=1.5, animated=True)[0]))
            self._lanes.append([line for (line,) in _pair(ax, "-")])
            ax.set(ylim=_wider(system.X[k]), ylabel=system.state_names[k])
        last = axes[-1]
        last.set(xlim=(-self.seconds, 0.0), ylim=(0.0, 2.5), ylabel="score", xlabel="seconds ago")
        last.axhline(1.0, color=ALARM, ls="--", lw=1)
        (self._score,) = last.plot([], [], lw=1, animated=True)
        self._score_text = last.text(0.01, 0.75, "", transform=last.transAxes, animated=True)
        lines = [line for pair in (*self._portrait, *self._lanes) for line in pair]
        self.artists = [*(dots for _, dots in self._measured), *lines, self._score, self._score_text]
        (truth, guess), samples = self._lanes[0], [dots for _, dots in self._measured[:1]]
        names = ["state", "estimate", "sample"][: 2 + len(samples)]
        right.legend([truth, guess, *samples], names, loc="upper right", ncols=3, frameon=False, markerscale=4)
        self._widgets(controls)

    def _widgets(self, figure: Any) -> None:
        from matplotlib.widgets import RadioButtons, Slider

        system, level = self.system, float(np.max(self.sensor.level))
        end = float(np.max(self.env.observer.artifact.inverse.measurement_noise_max))
        end = end if np.isfinite(end) else 4.0 * float(np.max(system.measurement_noise)) or 1.0
        self._noise = Slider(figure.add_axes((0.08, 0.6, 0.3, 0.2)), "noise", 0.0, max(end, level), valinit=level)
        self._noise.on_changed(self._set_noise)
        self._input: Any = None
        if system.nu:
            self._input = Slider(figure.add_axes((0.08, 0.3, 0.3, 0.2)), "input", -1.0, 1.0, valinit=0.0)
            self._input.on_changed(self._set_input)
        self._faults = RadioButtons(figure.add_axes((0.5, 0.1, 0.15, 0.85), frameon=False), FAULTS)
        self._faults.on_clicked(self._set_fault)
        figure.text(0.02, 0.05, KEYS, size="small")

    def _set_noise(self, level: float) -> None:
        observer = self.env.observer  # the map may limit the level of each output
        self.sensor.level = observer.measurement_noise = observer.artifact.inverse.within(float(level))

    def _set_input(self, share: float) -> None:
        self._action[:1] = share

    def _set_fault(self, fault: Any) -> None:
        self.sensor.fault = fault


def show(environment: Shown, measurement_noise: Level | None, *, seed: int) -> Any:
    """Open a window and show an environment in it until it is closed."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation
    from matplotlib.backends.registry import BackendFilter, backend_registry

    backend = plt.get_backend()
    windows = backend_registry.list_builtin(BackendFilter.INTERACTIVE)  # type: ignore[no-untyped-call]
    if backend.lower() not in windows:
        raise ValueError(
            f"this needs a window, and matplotlib's backend here is {backend!r}: run it where there is a display, "
            "with tkinter or PyQt installed; MPLBACKEND must not name a backend without windows"
        )
    with style():
        figure: Any = plt.figure(figsize=(12, 7.5), layout="none")
        live = Live(figure, environment, measurement_noise, seed=seed)
        before = time.perf_counter()

        def frame(number: int) -> list[Any]:
            nonlocal before
            now = time.perf_counter()
            samples = round((now - before) / live.clock)
            if not live.paused:
                live.advance(min(samples, MOST))
            before += samples * live.clock
            return live.draw()

        manager = figure.canvas.manager
        if manager is not None and manager.key_press_handler_id is not None:
            figure.canvas.mpl_disconnect(manager.key_press_handler_id)  # turns matplotlib's own keys off
        figure.canvas.mpl_connect("key_press_event", lambda event: live.press(event.key))
        animation = FuncAnimation(figure, frame, interval=1000 * FRAME, blit=True, cache_frame_data=False)
        plt.show()
    return animation


def _pair(ax: Any, *styles: str) -> list[list[Any]]:
    """Draw empty lines: for the true state one in each style, and likewise for the estimate."""
    looks = ({"color": TRUTH, "lw": 3.5, "ms": 9.0}, {"color": ESTIMATE, "lw": 1.3, "ms": 5.0})
    return [[ax.plot([], [], style, animated=True, **look)[0] for style in styles] for look in looks]


def _wider(interval: tuple[float, float]) -> tuple[float, float]:
    low, high = interval
    margin = 0.15 * (high - low)
    return low - margin, high + margin


def main(
    system: str = "van_der_pol", observer: str | None = None, measurement_noise: float | None = None, seed: int = 0
) -> None:
    """Show a system until the window is closed.

    Args:
        system: a shipped system, or your own as script.py:Class.
        observer: a shipped map or a .safetensors file; by default the one that ships for the system.
        measurement_noise: standard deviation of the noise on each sample of y; by default that of the system.
        seed: seed of starts and noise.
    """
    (environment,) = shown(system, observer)
    if not environment.observed:
        raise ValueError(f"no observer ships for {environment.system.name!r}: name a file, --observer FILE")
    show(environment, measurement_noise, seed=seed)


if __name__ == "__main__":
    tyro.cli(main)
