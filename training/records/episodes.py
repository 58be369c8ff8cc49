"""Episodes of an environment as records: which entries of observations, actions and ``info`` are what."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from kkl_gym.named import InputReader, Reader, acting, resolved
from training.records.record import Record
from training.records.signals import Signals


@dataclass(frozen=True)
class Episode:
    """What happened from a reset to the end. Shapes: ``rewards`` (n,), ``infos`` (n + 1, ...)."""

    observations: Any
    actions: Any
    rewards: np.ndarray
    terminated: bool
    infos: Mapping[str, Any]


@dataclass(frozen=True)
class Rollouts:
    """Episodes of one environment, and what it is."""

    name: str
    environment: Mapping[str, Any] | None
    dt: float
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    episodes: Sequence[Episode]
    signals: Signals = Signals()  # noqa: RUF009 - it is frozen

    def records(self, wanted: Signals | None = None) -> list[Record]:
        """Read the episodes."""
        source = self.name if self.environment is None else self.environment["id"]
        wanted = wanted or Signals()
        if wanted.time:
            raise ValueError(f"{self.name}: episodes have equal steps and no column of time; leave --time out")
        measured, hidden = (
            resolved(
                getattr(wanted, role) or getattr(self.signals, role), self.observation_space, role=role, source=source
            )
            for role in ("measured", "hidden")
        )
        if not measured:
            raise ValueError(f"{self.name}: say which entries of the observation are measured (--measured 0,1)")
        signals = Signals("t", measured, wanted.inputs or acting(self.action_space), hidden)
        readers = [Reader(self.observation_space, names, source=source) for names in (measured, hidden) if names]
        read_u = InputReader(self.action_space, signals.inputs, source=source)
        found = []
        for i, episode in enumerate(self.episodes):
            n = len(episode.rewards)
            if not n:
                continue
            try:
                y, *x = (read(episode.observations, episode.infos, (n + 1,)) for read in readers)
                u = read_u(episode.actions, (n,))
            except ValueError as error:
                raise ValueError(f"{self.name}, episode {i}: {error}") from error
            if np.isnan(y[0]).any():
                raise ValueError(
                    f"{self.name}, episode {i}: {measured[int(np.isnan(y[0]).argmax())]} is not there after the reset, "
                    "where an observer takes its first sample; measure something else"
                )
            found.append(
                Record(
                    f"{self.name}, episode {i}",
                    self.dt * np.arange(n + 1),
                    y,
                    np.concatenate([u, u[-1:]]) if signals.inputs else None,
                    x[0] if hidden else None,
                    signals,
                    source=self.name,
                    environment=self.environment,
                )
            )
        return found
