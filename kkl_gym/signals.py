"""Outputs and inputs as rows of real numbers, read from observations and actions, single or in batches."""

import copy
import math
import operator
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from observers.checks import LARGEST, all_finite, integer, is_finite, real_array, shown

Space = gym.Space[Any]
Entries = Sequence[int] | Sequence[str]
"""Indices in a flattened observation, or keys of a Dict."""
Angles = Sequence[int | Sequence[int]] | Sequence[str | Sequence[str]]
"""Entries that are angles, and pairs of entries that are the cosine and the sine of an angle."""
TURN = 2 * math.pi
# If an angle's bounds are one of these distances apart, the unit is unclear: it may be turns, half turns or rad.
UNITS = 1.0, 2.0, 4.0


class Outputs:
    """The measured outputs in an environment's observations.

    Entries are numbered as by :func:`gymnasium.spaces.flatten`, with Discrete values one-hot. Outputs have this order,
    or that of the indices in ``measured``. If ``measured`` holds keys, only those keys of a Dict are read. Images in a
    Dict are left out, but raise an error if ``measured`` holds indices.
    """

    def __init__(
        self,
        space: Space,
        measured: Entries | None,
        angles: Angles,
        *,
        period: float | None = None,
        source: str,
        missing: bool = False,
    ) -> None:
        self._missing = missing  # whether NaN may stand for an entry that is missing
        self.measured = None if measured is None else _entries("measured", measured)
        self.angles = angle_entries(angles)
        self.period = period
        if period is not None and not (is_finite(period) and period > 0):
            raise ValueError(f"period must be the positive length of a turn, such as 360, got {shown(period)}")
        if self.measured == ():
            raise ValueError("measured must name at least one entry of the observation; None measures all")
        self._source = f"the observation of {source}"
        self._parts: dict[Any, Space] = dict(space.items()) if isinstance(space, spaces.Dict) else {None: space}
        keys = isinstance((self.measured or (0,))[0], str)
        if self.measured and keys:
            _check_keys("measured", self.measured, self._parts)
            self._parts = {key: part for key, part in self._parts.items() if key in self.measured}
        # The keys that an agent still sees of a Dict; None for other observations, or if indices choose entries.
        self.keys = dict(self._parts) if isinstance(space, spaces.Dict) and (keys or not self.measured) else None
        if self.keys is not None:
            self._parts = {key: part for key, part in self._parts.items() if not _is_image(part)}
        for key, part in self._parts.items():
            _check(part, self._source if key is None else f"{self._source}, {key!r},")
        owners = [key for key, part in self._parts.items() for _ in range(spaces.flatdim(part))]
        if not owners:
            raise ValueError(f"{self._source} holds no numbers: there is nothing to remember")
        low, high = (np.concatenate(side) for side in zip(*map(_limits, self._parts.values())))
        self._names = [  # names of the entries in messages
            f"entry {i}" if key is None else f"entry {i - owners.index(key)} of {key!r}" for i, key in enumerate(owners)
        ]
        taken = list(range(len(owners)))
        if self.measured and not keys:
            taken = _positions("measured", self.measured, owners)
        each = [angle if isinstance(angle, tuple) else (angle,) for angle in self.angles]
        if keys and each and not isinstance(each[0][0], str):
            raise ValueError(f"angles must be keys, because measured holds keys, got {self.angles}")
        at = [tuple(_positions("angles", (entry,), owners) for entry in angle) for angle in each]
        if not {i for angle in at for entry in angle for i in entry} <= set(taken):
            raise ValueError(f"angles must be among the measured entries, {self.measured}, got {self.angles}")
        plain = [i for angle in at if len(angle) == 1 for i in angle[0]]
        if period is not None and not plain:
            raise ValueError(f"period = {period:g} has no effect: angles names only pairs, or no entry")
        units = {i: TURN / (self.period or self._period_of(low[i], high[i], self._names[i])) for i in plain}
        self._take = np.repeat(taken, [1 + (i in units) for i in taken])
        self._whole = self._take.tolist() == list(range(len(owners)))
        self._sines = np.flatnonzero(np.isin(self._take, plain))[1::2]
        self._cosines = self._sines - 1
        self._units = np.array([units[i] for i in self._take[self._sines]])  # rad per unit of each angle
        self.pairs = list(zip(self._cosines.tolist(), self._sines.tolist()))  # indices of cosines and sines
        place = self._take.tolist().index
        for angle, names in zip(at, each):
            if len(angle) == 2:
                if len(angle[0]) != len(angle[1]):
                    raise ValueError(
                        f"keys of cosines and sines must have equally many entries, got {names} with {len(angle[0])} "
                        f"and {len(angle[1])}"
                    )
                self.pairs += [(place(cosine), place(sine)) for cosine, sine in zip(*angle)]
        self.low, self.high = low[self._take], high[self._take]
        for side in (self._cosines, self._sines):
            self.low[side], self.high[side] = -1.0, 1.0
        # Cosines and sines that replace an angle are outputs, but belong to no key of a Dict.
        self.unseen = np.sort([*self._cosines, *self._sines]).astype(int)

    def _period_of(self, low: float, high: float, name: str) -> float:
        """Return the length of a turn in an angle's unit, as it follows from the angle's bounds."""
        width = high - low
        if np.isinf(width) or (width < 2.01 * TURN and width not in UNITS):
            return TURN
        if width in (360.0, 720.0):
            return 360.0
        raise ValueError(
            f"the period of the angle in {name} of {self._source} is unknown: its bounds are {low:g} and {high:g}; "
            "pass period=, 2 * math.pi for rad, 360 for degrees, 1 for turns"
        )

    def flat(self, observation: Any, batch: tuple[int, ...] = ()) -> np.ndarray:
        """Return an observation, or its measured keys, flattened to (*batch, entries)."""
        parts = [
            _signals(self._source, part, observation if key is None else observation[key], batch)
            for key, part in self._parts.items()
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def __call__(self, observation: Any, batch: tuple[int, ...] = ()) -> np.ndarray:
        """Return the outputs in an observation, (*batch, ny)."""
        return self.of_flat(self.flat(observation, batch))

    def of_flat(self, y: np.ndarray) -> np.ndarray:
        """Return the outputs (..., ny) in flat observations ``y`` (..., entries)."""
        if not self._whole:
            y = y[..., self._take]
        if not all_finite(np.where(np.isnan(y), 0.0, y) if self._missing else y):
            at = np.argwhere(~(np.abs(y) <= LARGEST))[0]
            row = f", row {at[0]}" if y.ndim > 1 else ""
            raise ValueError(
                f"{self._source} holds {y[tuple(at)]} in {self._names[self._take[at[-1]]]}{row}: "
                "it would stay in the memory, so replace it, with gymnasium.wrappers.TransformObservation for instance"
            )
        if len(self._sines):
            angles = self._units * y[..., self._sines]
            y[..., self._cosines], y[..., self._sines] = np.cos(angles), np.sin(angles)
        return y

    def kept(self, observation: Any, flat: np.ndarray) -> dict[str, Any]:
        """Return the part of a Dict that an agent still sees: boxes from ``flat``, and copies of all other values."""
        kept, at = {key: copy.deepcopy(observation[key]) for key in self.keys or ()}, 0
        for key, part in self._parts.items():
            end = at + spaces.flatdim(part)
            if isinstance(part, spaces.Box):
                kept[key] = flat[..., at:end].reshape(flat.shape[:-1] + part.shape).astype(part.dtype)
            at = end
        return kept


class Inputs:
    """The inputs in an environment's actions: bounded boxes scaled to [-1, 1], Discrete actions one-hot."""

    def __init__(self, space: Space, *, source: str) -> None:
        self._space, self._source = space, f"the action of {source}"
        _check(space, self._source)
        self.low, self.high = _limits(space)
        boxes = [isinstance(leaf, spaces.Box) for leaf in _leaves(space) for _ in range(spaces.flatdim(leaf))]
        # Bounds beyond LARGEST, such as the largest float, are not used as a scale.
        scaled = np.array(boxes, dtype=bool) & (abs(self.low) <= LARGEST) & (abs(self.high) <= LARGEST)
        low, high = np.where(scaled, self.low, -1.0), np.where(scaled, self.high, 1.0)
        self._middle, self._half = (low + high) / 2, np.where(high > low, (high - low) / 2, 1.0)
        self._plain = not self._middle.any() and bool((self._half == 1.0).all())
        self.low[scaled], self.high[scaled] = -1.0, 1.0

    def __call__(self, action: Any, batch: tuple[int, ...] = ()) -> np.ndarray:
        """Return the inputs in an action, (*batch, nu)."""
        u = _signals(self._source, self._space, action, batch)
        if not all_finite(u):
            raise ValueError(f"{self._source} must hold numbers within ±{LARGEST:g}, got {shown(action)}")
        if not self._plain:
            u = (u - self._middle) / self._half
        return np.minimum(np.maximum(u, self.low), self.high)


def _is_sequence(values: Any) -> bool:
    return isinstance(values, list | tuple | range) or (isinstance(values, np.ndarray) and values.ndim > 0)


def _entries(name: str, values: Any) -> tuple[Any, ...]:
    """Return indices or keys as a tuple, or raise ValueError."""
    if not _is_sequence(values):
        raise ValueError(f"{name} must be a sequence of indices or of keys, such as [0, 2], got {shown(values)}")
    keys = [value for value in values if isinstance(value, str)]
    found = tuple(map(str, keys)) if keys else tuple(integer(f"an entry of {name}", value, 0) for value in values)
    if len(found) != len(values):
        raise ValueError(f"{name} must be indices or keys, not both, got {shown(values)}")
    if len(set(found)) != len(found):
        raise ValueError(f"{name} must name each entry once, got {shown(values)}")
    return found


def angle_entries(values: Any) -> tuple[Any, ...]:
    """Return a tuple of entries and of pairs of entries, or raise ValueError."""
    if not _is_sequence(values):
        raise ValueError(
            "angles must be a sequence of indices or of keys, or of pairs of them, such as [2] or [(0, 1)], got "
            f"{shown(values)}"
        )
    pairs = [_is_sequence(value) for value in values]
    for value, pair in zip(values, pairs):
        if pair and len(value) != 2:
            raise ValueError(f"a pair in angles must be a cosine and a sine, such as (0, 1), got {shown(value)}")
    names = iter(
        _entries("angles", [name for value, pair in zip(values, pairs) for name in (value if pair else (value,))])
    )
    return tuple((next(names), next(names)) if pair else next(names) for pair in pairs)


def _check_keys(name: str, keys: Collection[str], known: Collection[Any]) -> None:
    for key in keys:
        if key not in known:
            there = "keys " + ", ".join(map(repr, known)) if None not in known else "no keys: name indices"
            raise ValueError(f"{name} names {key!r}, but the observation has {there}")


def _positions(name: str, chosen: tuple[Any, ...], owners: list[Any]) -> list[int]:
    """Return the indices of chosen entries in a flat observation; ``owners`` are the keys of all its entries."""
    if chosen and isinstance(chosen[0], str):
        _check_keys(name, chosen, dict.fromkeys(owners))
        return [i for i, key in enumerate(owners) if key in chosen]
    for i in chosen:
        if i >= len(owners):
            raise ValueError(
                f"{name} names entry {i}, but the flattened observation has entries 0 to {len(owners) - 1}"
            )
    return list(chosen)


def _leaves(space: Space) -> Iterator[Space]:
    """Yield the elementary spaces within a space, in the order of a flattened value."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        for part in space.values() if isinstance(space, spaces.Dict) else space:
            yield from _leaves(part)
    else:
        yield space


def _is_image(space: Space) -> bool:
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) > 1


def _check(space: Space, source: str) -> None:
    """Raise ValueError if an elementary space within a space is an image, or of a kind that cannot be remembered."""
    for leaf in _leaves(space):
        if _is_image(leaf):
            raise ValueError(
                f"{source} is an image, {leaf}: first wrap the environment in an encoder to a vector, for instance "
                "by gymnasium.wrappers.TransformObservation, or name only other keys of a Dict in measured=[...]"
            )
        if not isinstance(leaf, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
            raise ValueError(
                f"{source} holds {shown(leaf)}, and only Box, Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple "
                "of these can be remembered: first wrap the environment to convert it, or leave out its key"
            )


def _limits(space: Space) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of a space's signals."""
    if spaces.flatdim(space) == 0:  # Gymnasium cannot flatten an empty space to a box
        return np.zeros(0), np.zeros(0)
    flat: Any = spaces.flatten_space(space)
    return flat.low.astype(float), flat.high.astype(float)


def _signals(source: str, space: Space, value: Any, batch: tuple[int, ...]) -> np.ndarray:
    """Flatten a value, or each row of a batch, like :func:`gymnasium.spaces.flatten`."""
    try:
        return _read(space, value, batch)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        values = f"{batch[0]} values" if batch else "a value"
        raise ValueError(f"{source} must be {values} of {space}, got {shown(value)}") from error


def _read(space: Space, value: Any, batch: tuple[int, ...]) -> np.ndarray:
    if isinstance(space, spaces.Box) and space.dtype != np.bool_:
        return real_array("it", value).reshape(*batch, space.low.size)
    if isinstance(space, spaces.Box | spaces.MultiBinary):  # a Box of bool, or MultiBinary
        array = value if isinstance(value, np.ndarray) else np.asarray(value)
        flags = array.astype(np.int8) if array.dtype == np.bool_ else value
        return real_array("it", flags).reshape(*batch, spaces.flatdim(space))
    if isinstance(space, spaces.Discrete):
        return _one_hot(value, int(space.n), int(space.start), batch)
    if isinstance(space, spaces.MultiDiscrete):
        columns = np.reshape(value, (*batch, space.nvec.size))
        sizes = zip(space.nvec.ravel().tolist(), space.start.ravel().tolist())
        parts = [_one_hot(columns[..., i], n, start, batch) for i, (n, start) in enumerate(sizes)]
    elif isinstance(space, spaces.Dict):
        parts = [_read(part, value[key], batch) for key, part in space.items()]
    else:
        parts = [_read(part, one, batch) for part, one in zip(space, value, strict=True)]  # type: ignore[call-overload]
    return np.concatenate(parts, axis=-1)


def _one_hot(value: Any, n: int, start: int, batch: tuple[int, ...]) -> np.ndarray:
    if not batch:
        one = operator.index(value) - start
        if not 0 <= one < n:
            raise ValueError("out of range")
        row = np.zeros(n)
        row[one] = 1.0
        return row
    index = np.reshape(value, -1)
    if index.dtype.kind not in "iu" or index.size != math.prod(batch):
        raise ValueError("no integers")
    chosen = index.astype(np.int64) - start
    if not 0 <= chosen.min() <= chosen.max() < n:
        raise ValueError("out of range")
    out = np.zeros((len(chosen), n))
    out[np.arange(len(chosen)), chosen] = 1.0
    return out.reshape(*batch, n)


__all__ = ["Angles", "Entries", "Inputs", "Outputs"]
