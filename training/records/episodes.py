"""Episodes of an environment as records, and as Minari data sets. Reading runs no code from a data set."""

import copy
import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from kkl_gym.identity import APPEARANCE
from kkl_gym.named import InputReader, Reader, acting, resolved
from observers.checks import check_dt
from observers.storage import UNFINISHED
from training.files import require_writable
from training.records.record import Record, Signals

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

PREFIX = "minari:"  # marks names of data sets among names of files
KEY = "kkl_gym"  # key of this package's entries in a data set's metadata
METADATA = "data/metadata.json"  # path in the folder of a data set


@dataclass(frozen=True)
class Episode:
    """The n steps from a reset to the end of an episode. Shapes: ``rewards`` (n,), each of ``infos`` (n + 1, ...)."""

    observations: Any
    actions: Any
    rewards: np.ndarray
    terminated: bool
    infos: Mapping[str, Any]


@dataclass(frozen=True)
class Rollouts:
    """Episodes of one environment, with its spaces and the names of the signals."""

    name: str
    environment: Mapping[str, Any] | None
    dt: float
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    episodes: Sequence[Episode]
    signals: Signals = Signals()  # noqa: RUF009 - it is frozen
    spec: "EnvSpec | None" = None

    def records(self, wanted: Signals | None = None) -> list[Record]:
        """Make a record of each episode with the wanted signals, by default those of the rollouts."""
        wanted, space = wanted or Signals(), self.observation_space
        if wanted.time:
            raise ValueError(f"{self.name}: episodes have equal steps and no column of time; leave --time out")
        source = self.name if self.environment is None else self.environment["id"]
        measured, hidden = (
            resolved(getattr(wanted, role) or getattr(self.signals, role), space, role=role, source=source)
            for role in ("measured", "hidden")
        )
        if not measured:
            raise ValueError(f"{self.name}: name the measured entries of the observation (--measured 0,1)")
        signals = Signals("t", measured, wanted.inputs or acting(self.action_space), hidden)
        readers = [Reader(space, names, source=source) for names in (measured, hidden) if names]
        read_u = InputReader(self.action_space, signals.inputs, source=source)
        records = []
        for i, episode in enumerate(self.episodes):
            n, name = len(episode.rewards), f"{self.name}, episode {i}"
            if not n:
                continue
            try:
                y, *x = (read(episode.observations, episode.infos, (n + 1,)) for read in readers)
                u = read_u(episode.actions, (n,))
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            if missing := [column for column, value in zip(measured, y[0]) if np.isnan(value)]:
                raise ValueError(
                    f"{name}: {missing[0]} is missing after the reset, where an observer takes its first sample; "
                    "measure another signal"
                )
            held, t = (np.concatenate([u, u[-1:]]) if signals.inputs else None), self.dt * np.arange(n + 1)
            states = x[0] if x else None
            records.append(Record(name, t, y, held, states, signals, self.name, self.environment))
        return records


def is_dataset(name: str | Path) -> bool:
    """Return whether a name is that of a Minari data set: ``minari:ID``, or a folder that holds a data set."""
    return str(name).startswith(PREFIX) or (Path(name) / METADATA).is_file()


def read_dataset(name: str | Path, warn: Callable[[str], object]) -> Rollouts:
    """Read a Minari data set."""
    minari, name = _minari(), str(name)
    try:
        folder = _folder(name.removeprefix(PREFIX)) if name.startswith(PREFIX) else Path(name)
        written = json.loads((folder / METADATA).read_text(encoding="utf-8"))
        if "observation_space" not in written or "action_space" not in written:
            raise ValueError("its spaces are missing")  # to find them, Minari would run code of the environment
        dataset = minari.MinariDataset((folder / METADATA).parent)
        metadata, spec = dataset.storage.metadata, dataset.env_spec
        own = metadata.get(KEY, {})
        signals = Signals(measured=own.get("measured", ()), hidden=own.get("hidden", ()))
        dt = check_dt(own.get("dt", 1.0))
        episodes = [
            Episode(one.observations, one.actions, one.rewards, bool(one.terminations[-1:].any()), one.infos or {})
            for one in dataset.iterate_episodes()
        ]
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{name} cannot be read as a Minari data set: {error}") from error
    if not episodes:
        raise ValueError(f"{name} holds no episode")
    if "dt" not in own:
        warn(f"{name} has no sampling interval: a step counts as 1 s")
    kwargs = {} if spec is None else {key: value for key, value in spec.kwargs.items() if key not in APPEARANCE}
    environment = None if spec is None else {"id": spec.id, "kwargs": kwargs}
    spaces = metadata["observation_space"], metadata["action_space"]
    return Rollouts(name.removeprefix(PREFIX), environment, dt, *spaces, episodes, signals, spec)


def write_dataset(rollouts: Rollouts, *, policy: str) -> Path:
    """Write a Minari data set, whole or not at all."""
    folder, minari, spec = dataset_folder(rollouts.name), _minari(), copy.copy(rollouts.spec)
    namespace, *_ = minari.dataset.minari_dataset.parse_dataset_id(rollouts.name)
    if namespace is not None and namespace not in minari.namespace.list_local_namespaces():
        minari.namespace.create_namespace(namespace)
    for name in ("entry_point", "vector_entry_point"):
        if callable(getattr(spec, name, None)):
            setattr(spec, name, None)  # JSON cannot hold classes and functions
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=UNFINISHED) as temporary:
        whole = Path(temporary) / "whole"
        whole.mkdir()
        storage = minari.dataset.minari_storage.MinariStorage.new(
            (whole / METADATA).parent,
            observation_space=rollouts.observation_space,
            action_space=rollouts.action_space,
            env_spec=spec,
            jpeg_encoding=False,
        )
        for episode in rollouts.episodes:
            going_on = [False] * (len(episode.rewards) - 1)
            buffer = minari.data_collector.EpisodeBuffer(
                observations=episode.observations,
                actions=episode.actions,
                rewards=list(episode.rewards),
                terminations=[*going_on, episode.terminated],
                truncations=[*going_on, not episode.terminated],
                infos=dict(episode.infos),
            )
            storage.update_episodes([buffer])
        own = {"dt": rollouts.dt, "measured": rollouts.signals.measured, "hidden": rollouts.signals.hidden}
        whose = {"dataset_id": rollouts.name, "minari_version": minari.__version__, "algorithm_name": policy}
        storage.update_metadata(whose | {KEY: own})
        os.rename(whole, folder)
    return folder


def dataset_folder(name: str) -> Path:
    """Return a new data set's folder; raise an error if the name is invalid or taken, or the folder is unwritable."""
    try:
        _minari().dataset.minari_dataset.parse_dataset_id(name)
    except (TypeError, ValueError):
        raise ValueError(f"a Minari data set needs a name such as pendulum/random-v0, got {name!r}") from None
    folder = _folder(name)
    if folder.exists():
        raise ValueError(f"there is a data set {name} already; name another (--dataset), or run `minari delete {name}`")
    require_writable(folder)
    return folder


def _folder(name: str) -> Path:
    return Path(_minari().storage.datasets_root_dir.get_dataset_path(name))


def _minari() -> Any:
    try:
        import h5py  # noqa: F401
        import minari
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{error}: Minari data sets need pip install "kkl-gym[envs]"', name=error.name
        ) from None
    return minari
