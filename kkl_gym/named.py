"""Signals of any environment by their names: entries of observations, of actions and of ``info``."""

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from kkl_gym.signals import Inputs, Outputs
from observers.checks import real_array, shown

Space = gym.Space[Any]
FUNCTIONS = {"cos": np.cos, "sin": np.sin}
_FUNCTION = re.compile(r"(cos|sin)\((.+)\)")
_INDEX = re.compile(r"(?:obs\[)?(\d+)\]?")
_INFO = re.compile(r"info\[([^\[\]]+)\](?:\[(\d+)\])?")


def observed(space: Space) -> tuple[str, ...]:
    """Return the names of the entries of a flattened observation."""
    if not isinstance(space, spaces.Dict):
        return tuple(f"obs[{i}]" for i in range(_size(space)))
    sizes = {key: _size(part) for key, part in space.items()}
    return tuple(key if n == 1 else f"{key}[{i}]" for key, n in sizes.items() for i in range(n))


def acting(space: Space) -> tuple[str, ...]:
    """Return the names of the entries of a flattened action, ``action[0]`` and so on; discrete actions are one-hot."""
    return tuple(f"action[{i}]" for i in range(_size(space)))


def _size(space: Space) -> int:
    try:
        return spaces.flatdim(space)
    except (NotImplementedError, ValueError):  # graph and sequence spaces
        return 0


def resolved(names: Sequence[str | int], space: Space, *, role: str, source: str) -> tuple[str, ...]:
    """Return the full names of signals, such as ``obs[2]`` for 2; ValueError if a name is unknown."""
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ValueError(f"{role} must be a sequence of names or indices, such as [0, 1], got {shown(names)}")
    there, found = observed(space), list[str]()
    for name in map(str, names):
        function = _FUNCTION.fullmatch(name)
        entries = _entries(name if function is None or name in there else function[2].strip(), space, there)
        if not entries or (function and len(entries) > 1):
            known = textwrap.shorten(", ".join(there), 200, placeholder=" ...") or "no numbers"
            ask = "" if not entries else ": cos and sin take a single entry"
            raise ValueError(
                f"{role} contains {name!r}, but an observation of {source} holds {known}{ask}; an index stands for its "
                "entry (2 for obs[2]), and info[KEY] for an entry of info"
            )
        found += [f"{function[1]}({entry})" for entry in entries] if function else entries
    return tuple(found)


def _entries(name: str, space: Space, there: tuple[str, ...]) -> tuple[str, ...]:
    """Return the entries that a name without cos or sin stands for; empty if it names no entry."""
    if name in there or _INFO.fullmatch(name):
        return (name,)
    if index := _INDEX.fullmatch(name):
        return there[int(index[1]) : int(index[1]) + 1]
    keys = space.keys() if isinstance(space, spaces.Dict) else ()
    if name.endswith("[0]") and name[:-3] in keys and name[:-3] in there:
        return (name[:-3],)
    return tuple(entry for entry in there if name in keys and entry.startswith(f"{name}["))


class Reader:
    """Reads n named signals from observations and ``info``; ``missing`` allows NaN. Bounds: ``low``, ``high`` (n,)."""

    def __init__(self, space: Space, names: Sequence[str], *, source: str, missing: bool = False) -> None:
        there, self._source = observed(space), source
        functions = [None if name in there else _FUNCTION.fullmatch(name) for name in names]
        entries = [name if function is None else function[2] for name, function in zip(names, functions)]
        infos = dict.fromkeys(entry for entry in entries if entry not in there)
        self._infos = {entry: _info(entry) for entry in infos}
        self.keys = tuple(dict.fromkeys(key for key, _ in self._infos.values()))
        chosen = sorted({there.index(entry) for entry in entries if entry in there})
        columns = [there[i] for i in chosen]
        self._outputs = None
        low, high = np.zeros(0), np.zeros(0)
        # Of a Dict only the keys with chosen entries are read, because others may be images.
        if chosen and isinstance(space, spaces.Dict):
            owners = [key for key, part in space.items() for _ in range(_size(part))]
            read = spaces.Dict({key: space[key] for key in dict.fromkeys(owners[i] for i in chosen)})
            space, chosen = read, [observed(read).index(column) for column in columns]
        if chosen:
            self._outputs = Outputs(space, chosen, (), source=source, missing=missing)
        if self._outputs is not None:
            low, high = self._outputs.low, self._outputs.high
        columns += infos
        self._take = np.array([columns.index(entry) for entry in entries], dtype=int)
        self._functions = [(i, FUNCTIONS[function[1]]) for i, function in enumerate(functions) if function]
        unbounded = np.full(len(infos), np.inf)
        self.low, self.high = (
            np.concatenate([side, end])[self._take] for side, end in ((low, -unbounded), (high, unbounded))
        )
        for i, _ in self._functions:
            self.low[i], self.high[i] = -1.0, 1.0

    def __call__(self, observation: Any, info: Mapping[str, Any], batch: tuple[int, ...] = ()) -> np.ndarray:
        """Return the signals, (*batch, n)."""
        parts = [] if self._outputs is None else [self._outputs(observation, batch)]
        parts += [self._of_info(info, entry, batch) for entry in self._infos]
        y = np.concatenate(parts, axis=-1)[..., self._take]
        for i, function in self._functions:
            y[..., i] = function(y[..., i])
        return y

    def _of_info(self, info: Mapping[str, Any], entry: str, batch: tuple[int, ...]) -> np.ndarray:
        key, index = self._infos[entry]
        if key not in info:
            there = textwrap.shorten(", ".join(map(str, info)), 200, placeholder=" ...") or "nothing"
            raise ValueError(f"info of {self._source} has no {key!r}; there is {there}")
        values = info[key]
        flags = isinstance(values, bool | np.bool_) or getattr(values, "dtype", None) == np.bool_
        values = (np.asarray(values, dtype=float) if flags else real_array(entry, values)).reshape(*batch, -1)
        if index is None and values.shape[-1] != 1:
            raise ValueError(f"{entry} of {self._source} holds {values.shape[-1]} numbers: name one, as in {entry}[0]")
        if (index or 0) >= values.shape[-1]:
            raise ValueError(f"{entry}: info of {self._source} holds {values.shape[-1]} numbers there, indexed from 0")
        return values[..., [index or 0]]


def _info(entry: str) -> tuple[str, int | None]:
    """Return an entry's key in ``info``, and its index within the value of this key, None without an index."""
    found = _INFO.fullmatch(entry)
    if found is None:
        raise ValueError(f"there is no entry {entry!r}")
    return found[1], None if found[2] is None else int(found[2])


class InputReader:
    """Reads named inputs from actions."""

    def __init__(self, space: Space, names: Sequence[str], *, source: str) -> None:
        self._inputs, there = Inputs(space, source=source), acting(space)
        for name in names:
            if name not in there:
                raise ValueError(f"inputs contains {name!r}, but the inputs of {source} are {', '.join(there)}")
        self._take = np.array([there.index(name) for name in names], dtype=int)

    def __call__(self, action: Any, batch: tuple[int, ...] = ()) -> np.ndarray:
        """Return the inputs, (*batch, n): bounded boxes scaled to [-1, 1] and clipped, discrete actions one-hot."""
        return self._inputs(action, batch)[..., self._take]


__all__ = ["InputReader", "Reader", "acting", "observed", "resolved"]
