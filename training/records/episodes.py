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
    """What happened from a reset to the end.

    Parameters
    ----------
    observations : object
        n + 1 values of the observation space, as :func:`gymnasium.vector.utils.concatenate` stacks them.
    actions : object
        n values of the action space, each applied from its observation to the next.
    rewards : ndarray, shape (n,)
        Rewards.
    terminated : bool
        Whether the environment ended it, rather than a limit of time or the end of the recording.
    infos : mapping of str to ndarray, shape (n + 1, ...)
        What ``info`` held beside the observations.
    """

    observations: Any
    actions: Any
    rewards: np.ndarray
    terminated: bool
    infos: Mapping[str, Any]


@dataclass(frozen=True)
class Rollouts:
    """Episodes of one environment, and what it is.

    Parameters
    ----------
    name : str
        Of the data set, for messages.
    environment : mapping of str to object or None
        Id and arguments, as :func:`kkl_gym.identity.identity` finds them; None if nobody knows.
    dt : float
        Sampling interval in seconds.
    observation_space, action_space : gymnasium.Space
        Of the environment.
    episodes : sequence of Episode
        One at least.
    signals : Signals
        What counts as measured and as hidden where nobody says it.
    """

    name: str
    environment: Mapping[str, Any] | None
    dt: float
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    episodes: Sequence[Episode]
    signals: Signals = Signals()  # noqa: RUF009 - it is frozen

    def records(self, wanted: Signals | None = None) -> list[Record]:
        """Read the episodes.

        Parameters
        ----------
        wanted : Signals, optional
            What is measured and hidden, as :func:`kkl_gym.named.resolved` takes names; what is left empty is that of
            the rollouts, and of inputs all actions.

        Returns
        -------
        list of Record
            One of each episode with two observations or more. The input of the last sample, which leads nowhere, is
            the one before.

        Raises
        ------
        ValueError
            If nobody says what is measured, there is no such signal, it holds no numbers, or a reset does not say
            what is measured.
        """
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
