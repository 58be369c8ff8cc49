"""Vector environments that are simulated as one batch."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from kkl_gym.compiled import SamplingStep, batch_step
from kkl_gym.equations import components
from kkl_gym.plant import NOISE_BLOCK, OfPlant, Plant
from kkl_gym.rendering import ARRAYS, Canvas, Trails, render_metadata
from kkl_gym.sensor import Readings
from kkl_gym.simulate import followed_rows
from kkl_gym.system import System, reward_of
from observers.checks import bool_array, choice, integer, mapping, real_array, shown

Infos = dict[str, Any]
Rows = np.ndarray | slice
ALL = slice(None)  # all rows; indexing by this slice gives a view
# The noise of this number of rows is drawn and transposed together; it fits the processor's cache.
ROWS_AT_ONCE = 64
MOST_ENVS = 1_000_000  # each stores 256 samples of noise, about 10 kB


class KKLVectorEnv(OfPlant, gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """``num_envs`` copies of :class:`KKLEnv` with equal parameters, simulated as one batch.

    Each row behaves like a :class:`KKLEnv` with the row's seed and the same time limit: starts and noise are the same,
    and states agree to rounding. ``info`` holds the same keys, as arrays with a row for each environment. For each key
    a mask ``_key`` marks the rows that reported it, as in Gymnasium's own vector environments.

    **Autoreset modes.** ``"NextStep"``: the step after a row's episode ends ignores the row's action and resets the
    row. ``"SameStep"``: the row is reset at once; ``info["final_obs"]`` and ``info["final_info"]`` hold the episode's
    last observation and info. ``"Disabled"``: a row stays at its episode's end, with reward 0 and its flags still set,
    until ``reset(options={"reset_mask": mask})``. While a row stays there, its ``u`` and ``escaped`` are not reported.

    Parameters
    ----------
    system : str or System
        As for :class:`KKLEnv`.
    num_envs : int
        Number of environments.
    render_mode : {None, "rgb_array"}
        Whether :meth:`render` draws.
    max_episode_steps : int, optional
        Steps after which an episode is truncated; None or -1: never. ``gym.make_vec`` passes the registered number by
        default.
    autoreset_mode : str or gymnasium.vector.AutoresetMode
        One of the modes above.
    **options
        ``dt``, ``process_noise``, ``measurement_noise``, ``observe``, ``parameters``, ``start_box`` and ``sensor``, as
        for :class:`KKLEnv`.

    Raises
    ------
    ValueError
        As for :class:`KKLEnv`. Also if ``num_envs`` is not an integer from 1 to a million, ``max_episode_steps`` is
        neither None, -1 nor a positive integer, or the mode is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from kkl_gym import KKLVectorEnv
    >>> envs = KKLVectorEnv("van_der_pol", 3, max_episode_steps=100)
    >>> obs, info = envs.reset(seed=0)
    >>> obs.shape, info["y"].shape
    ((3, 2), (3, 1))
    >>> obs, reward, terminated, truncated, info = envs.step(np.ones((3, 1)))
    >>> info["u"].tolist(), info["sample"].tolist()
    ([[5.0], [5.0], [5.0]], [1, 1, 1])
    """

    def __init__(
        self,
        system: str | System,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        num_envs = integer("num_envs", num_envs, 1, MOST_ENVS)
        if max_episode_steps == -1:  # no time limit, as in gym.make
            max_episode_steps = None
        if max_episode_steps is not None:
            max_episode_steps = integer("max_episode_steps", max_episode_steps, 1)
        self.plant = Plant(system, **options)
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.autoreset_mode = autoreset_mode_of(autoreset_mode)
        self.render_mode = render_mode
        self.metadata = render_metadata(self.plant.dt, ARRAYS, render_mode) | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = self.plant.observation_space
        self.single_action_space = self.plant.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

        nx, ny = self.system.nx, self.plant.ny
        self._readings = None if self.sensor is None else Readings(self.sensor, ny, self.plant.dt, num_envs)
        self._u_max = np.array(self.system.u_max, dtype=float)
        self._bounds = np.array(self.system.bounds, dtype=float).T[..., None]
        self._exchanged()
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._seeds: list[int | None] = [None] * num_envs
        # A block of unscaled noise for each row, and how many of its samples have been used. At first all count as
        # used, so that the first reset draws a block.
        self._w, self._v = (np.empty((NOISE_BLOCK, width, num_envs)) for width in (nx, self.plant.nv))
        self._used = np.full(num_envs, NOISE_BLOCK)
        self._everyone = np.arange(num_envs)
        self._x = np.full((nx, num_envs), np.nan)  # components before rows, as in all arrays of this class
        self._y = self._held = np.full((ny, num_envs), np.nan)
        self._sample = np.zeros(num_envs, dtype=np.int64)
        self._escaped, self._terminated, self._truncated = np.zeros((3, num_envs), dtype=bool)
        self._ready = False
        # The last observations. A wrapper with an observer compares them with the observations that it receives.
        self.emitted = b""
        self._u = np.zeros((self.system.nu, num_envs))
        self._trails = None if render_mode is None else Trails(self.num_envs)
        self._canvas: Canvas | None = None

    @property
    def compiled(self) -> bool:
        """Whether Numba (extra ``fast``) compiles steps. If it cannot compile f, the logger ``kkl_gym`` reports why."""
        return self._advance.obstacle is None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Start episodes. Returns observations and info of all rows, with masks of the rows that were reset.

        Parameters
        ----------
        seed : int or sequence of int or None, length num_envs, optional
            One seed for each row, or a number n for the seeds n, n + 1, ...; None continues with the present
            generators.
        options : mapping, optional
            ``"x0"`` is the start, shape (nx,) for all rows or (num_envs, nx). Without it starts are drawn (see
            ``start_box``). ``"reset_mask"``, boolean of shape (num_envs,), marks the rows to reset; by default all.

        Raises
        ------
        ValueError
            If an option is unknown, a shape or a seed is invalid, or a start lies outside the declared bounds. The
            environments are then unchanged.
        gymnasium.error.ResetNeeded
            If the mask selects only some rows before all rows have been reset once.
        """
        given, mask = with_mask(options, self.num_envs)
        x0 = (given or {}).get("x0")
        for key in given or {}:
            if key not in ("x0", "reset_mask"):
                raise ValueError(f'unknown reset option {shown(key)}; there are "x0" and "reset_mask"')
        if not self._ready and not mask.all():
            raise gym.error.ResetNeeded("reset() all rows before some of them")
        rows = np.flatnonzero(mask).tolist()
        seeds = self._spread(seed)
        starts = None
        if x0 is not None:
            many = real_array("x0", x0)
            if many.ndim > 1 and many.shape != (self.num_envs, self.system.nx):
                raise ValueError(
                    f"x0 must have the shape ({self.system.nx},) or ({self.num_envs}, {self.system.nx}), got shape "
                    f"{many.shape}"
                )
            starts = np.array([self.plant.start(many[row] if many.ndim > 1 else many) for row in rows])
        for row, generator in {row: np_random(seeds[row]) for row in rows if seeds[row] is not None}.items():
            self._rngs[row], self._seeds[row] = generator
            self._used[row] = NOISE_BLOCK
        self._begin(np.array(rows), starts)
        self._ready = True
        self._trace()
        return self._observation(), self._info(mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Hold the inputs over one sampling interval. Rows that reset instead, or stay at their end, get reward 0.

        Parameters
        ----------
        actions : array_like, shape (num_envs, nu)
            Inputs divided by their bounds; values outside [-1, 1] are clipped.

        Raises
        ------
        ValueError
            If the shape is wrong, or an action is NaN or not a number. The environments are then unchanged.
        gymnasium.error.ResetNeeded
            Before :meth:`reset`.
        """
        if not self._ready:
            raise gym.error.ResetNeeded("call reset() before step()")
        u = self._inputs(actions)
        self._u = u
        over = self._terminated | self._truncated
        rows = np.flatnonzero(~over) if over.any() else ALL
        reward = np.zeros(self.num_envs)
        if not over.all():
            reward[rows] = self._move(rows, u[:, rows])
        info: Infos = {}
        if rows is not ALL:
            u[:, over] = 0.0
            if self.autoreset_mode is AutoresetMode.NEXT_STEP:
                self._begin(np.flatnonzero(over))
            else:
                info = {"_u": ~over, "_escaped": ~over}
        terminated, truncated = self._terminated.copy(), self._truncated.copy()
        info = self._info(np.ones(self.num_envs, dtype=bool)) | info
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            final = last_of_episodes(self._observation(), info, ended)
            self._begin(np.flatnonzero(ended))
            info = self._info(np.ones(self.num_envs, dtype=bool)) | final
        self._trace()
        return self._observation(), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw the phase portrait of each row's episode, like :meth:`KKLEnv.render`; None without ``render_mode``."""
        return self.draw()

    def draw(self, estimates: Trails | None = None) -> tuple[np.ndarray, ...] | None:
        """Draw the phase portraits with the estimated and the true states of each row."""
        if self._trails is None:
            return None
        if not self._ready:
            raise gym.error.ResetNeeded("call reset() before render()")
        estimated = estimates is not None and any(estimates.rows)
        if self._canvas is None or self._canvas.estimates != estimated:
            self._canvas = Canvas(self.system, estimated)
        guesses = [()] * self.num_envs if estimates is None else estimates.rows
        return tuple(self._canvas.draw(*row) for row in zip(self._trails.rows, guesses, self._u.T))

    def __getstate__(self) -> dict[str, Any]:
        # Compiled steps and canvases cannot be copied; they are made again at their next use.
        return {**self.__dict__, "_step": None, "_canvas": None}

    @property  # type: ignore[override]
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """The rows' generators; :meth:`reset` seeds them."""
        return tuple(self._rng(row) for row in range(self.num_envs))

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        raise AttributeError("each row has a generator of its own; seed them by reset(seed=...)")

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The rows' seeds, None for a row that has not been used."""
        return tuple(self._seeds)

    def _spread(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Return a seed for each row, None for rows without one."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, np.ndarray):
            seed = seed[()] if seed.ndim == 0 else list(seed)
        if isinstance(seed, Sequence) and not isinstance(seed, str | bytes | bytearray | memoryview):
            if len(seed) != self.num_envs:
                raise ValueError(f"there are {self.num_envs} environments and {len(seed)} seeds: {shown(seed)}")
            return [None if one is None else integer(f"seed[{i}]", one, 0) for i, one in enumerate(seed)]
        first = integer("seed, if it is not a list with one for each row,", seed, 0)
        return [first + i for i in range(self.num_envs)]

    def _rng(self, row: int) -> np.random.Generator:
        rng = self._rngs[row]
        if rng is None:
            self._rngs[row], self._seeds[row] = rng, _ = np_random()
        return rng

    def _begin(self, rows: np.ndarray, starts: np.ndarray | None = None) -> None:
        """Start episodes in some rows, with draws in the same order as those of :class:`KKLEnv`."""
        if starts is None:
            starts = np.array([self.plant.draw_start(self._rng(row)) for row in rows.tolist()])
        self._x[:, rows] = starts.T
        self._y[:, rows] = self._measure(self._x[:, rows], self._noise(rows)[1], rows, start=True)
        self._u[:, rows] = 0.0
        self._sample[rows] = 0
        self._escaped[rows] = self._terminated[rows] = self._truncated[rows] = False

    def _exchanged(self) -> None:
        self._reward = reward_of(self.system, rows=True)
        self._step: SamplingStep[np.ndarray] | None = None

    @property
    def _advance(self) -> SamplingStep[np.ndarray]:
        if self._step is None:
            self._step = batch_step(self.system)
        return self._step

    def _move(self, rows: Rows, u: np.ndarray) -> Any:
        """Advance some rows by a sampling interval; return their rewards."""
        before = self._x[:, rows]
        w, v = self._noise(rows)
        x = self._advance(before, u, w, self.plant.dt)
        escaped = self._outside(x)
        # A step may also end outside the bounds because its substeps were too coarse. Finer substeps verify the escape.
        if escaped.any():
            x = followed_rows(self.system, before, u, w, dt=self.plant.dt, end=x, rows=np.flatnonzero(escaped))
            escaped = self._outside(x)
        # Rows that escaped keep the last state and output inside the bounds.
        if escaped.any():
            x = np.where(escaped, before, x)
            y = np.where(escaped, self._y[:, rows], self._measure(x, v, rows, start=False))
        else:
            y = self._measure(x, v, rows, start=False)
        reward, ended = self._judged(x, u)
        self._x[:, rows], self._y[:, rows], self._escaped[rows], self._terminated[rows] = x, y, escaped, escaped | ended
        self._sample[rows] += 1
        self._truncated[rows] = self._sample[rows] >= (self.max_episode_steps or np.inf)
        return reward

    def _outside(self, x: np.ndarray) -> np.ndarray:
        """A mask (n,) of the states (nx, n) that lie outside the bounds or are not finite."""
        low, high = self._bounds
        return ~((x >= low) & (x <= high)).all(0)

    def _inputs(self, actions: np.ndarray) -> np.ndarray:
        values = real_array("actions", actions)
        if values.shape != (self.num_envs, self.system.nu):
            raise ValueError(f"actions must have shape ({self.num_envs}, {self.system.nu}), got {values.shape}")
        u = np.ascontiguousarray((np.minimum(np.maximum(values, -1.0), 1.0) * self._u_max).T)
        if np.isnan(u).any():
            raise ValueError(f"actions must be numbers; NaN in rows {np.flatnonzero(np.isnan(u).any(0)).tolist()}")
        return u

    def _noise(self, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Return the next sample of the noises w (nx, rows) and v (nv, rows)."""
        used, drawn = self._used[rows].copy(), self._everyone[rows]
        if used.max() == NOISE_BLOCK:
            self._draw(drawn[used == NOISE_BLOCK])
            used[used == NOISE_BLOCK] = 0
        self._used[rows] = used + 1
        if rows is ALL and (used == used[0]).all():  # the usual case needs no copies
            w, v = self.plant.noise(self._w[used[0]].T, self._v[used[0]].T)
        else:
            w, v = self.plant.noise(self._w[used, :, drawn], self._v[used, :, drawn])
        return w.T, v.T

    def _draw(self, rows: np.ndarray) -> None:
        """Draw a new block of noise for each given row, from the row's generator; the first axis of blocks is time."""
        w, v = (np.empty((ROWS_AT_ONCE, *block.shape[:2])) for block in (self._w, self._v))
        for first in range(0, len(rows), ROWS_AT_ONCE):
            some = rows[first : first + ROWS_AT_ONCE]
            for i, row in enumerate(some.tolist()):
                self.plant.draw_noise(self._rng(row), w[i], v[i])
            at: Any = slice(some[0], some[-1] + 1) if len(rows) == self.num_envs else some
            for block, drawn in ((self._w, w), (self._v, v)):
                block[:, :, at] = drawn[: len(some)].transpose(1, 2, 0)

    def _measure(self, x: np.ndarray, v: np.ndarray, rows: Rows, *, start: bool) -> np.ndarray:
        # This is System.output with components before rows, in a third of the time.
        white = v if self._readings is None else np.zeros((self.plant.ny, x.shape[1]))
        try:
            y = np.array([hi + vi for hi, vi in zip(self.system.h(x), white, strict=True)])
        except Exception:
            components(self.system.h, x)  # raises an EquationError that names the fault
            raise
        return y if self._readings is None else self._readings.read(y, v, self._everyone[rows], start=start)

    def _observation(self) -> np.ndarray:
        self._held = self._y if self._readings is None else np.where(np.isnan(self._y), self._held, self._y)
        values = self._x if self.plant.observe == "state" else self._held
        obs = values.T.astype(np.float32, order="C")
        if self.plant.observe == "output":
            space = self.single_observation_space
            np.clip(obs, space.low, space.high, out=obs)  # type: ignore[attr-defined]
        self.emitted = obs.tobytes()
        return obs

    def _info(self, rows: np.ndarray) -> Infos:
        info: Infos = {}
        arrays = {"y": self._y.T, "x": self._x.T, "u": self._u.T, "sample": self._sample, "escaped": self._escaped}
        for key, values in arrays.items():
            info |= {key: values.copy(), f"_{key}": rows.copy()}
        return info

    def _trace(self) -> None:
        if self._trails is not None:
            self._trails.add(self._x.T, self._sample)


def with_mask(options: Mapping[str, Any] | None, n: int) -> tuple[dict[str, Any] | None, np.ndarray]:
    """Return the reset options and the mask (n,); options are copied, as some environments pop the mask."""
    given = dict(mapping("options", options))
    if given.get("reset_mask") is None:
        return None if options is None else given, np.ones(n, dtype=bool)
    mask = bool_array("reset_mask", given["reset_mask"], (n,))
    if not mask.any():
        raise ValueError(f"reset_mask must be boolean with a True in it, got {shown(mask)}")
    return {**given, "reset_mask": mask}, mask


def autoreset_mode_of(mode: str | AutoresetMode) -> AutoresetMode:
    """Return Gymnasium's autoreset mode, given as an AutoresetMode or a text like "NextStep", or raise ValueError."""
    if isinstance(mode, AutoresetMode):
        return mode
    return AutoresetMode(choice("autoreset_mode", mode, [known.value for known in AutoresetMode]))


def last_of_episodes(obs: np.ndarray, info: Infos, ended: np.ndarray) -> Infos:
    """Return ``final_obs`` and ``final_info`` of the rows ``ended`` (n,), with masks, as in Gymnasium."""
    final_obs = np.full(len(ended), None, dtype=object)
    for row in np.flatnonzero(ended):
        final_obs[row] = obs[row].copy()
    final_info: Infos = {}
    for key, values in info.items():
        if not key.startswith("_"):
            kept = np.zeros_like(values)
            kept[ended] = values[ended]
            final_info |= {key: kept, f"_{key}": ended.copy()}
    return {"final_obs": final_obs, "_final_obs": ended.copy(), "final_info": final_info, "_final_info": ended.copy()}


__all__ = ["KKLVectorEnv"]
