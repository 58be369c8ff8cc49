"""Minari data sets, the format in which rollouts of environments are exchanged. Nothing in one runs."""

import copy
import errno
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from kkl_gym.identity import APPEARANCE, sampling_interval
from observers.checks import check_dt
from observers.storage import UNFINISHED, clear_unfinished
from training.records.episodes import Episode, Rollouts
from training.records.signals import Signals

if TYPE_CHECKING:
    from minari import MinariDataset

PREFIX = "minari:"  # of the name of a data set among names of files
KEY = "kkl_gym"  # in the metadata, of what Minari has no place for
DATA, METADATA = "data", "metadata.json"  # where a data set keeps both


def is_dataset(name: str | Path) -> bool:
    """Whether a name is that of a Minari data set: ``minari:ID``, or a folder that holds one."""
    return str(name).startswith(PREFIX) or any((Path(name) / part / METADATA).is_file() for part in (DATA, "."))


def read_dataset(name: str | Path, warn: Callable[[str], object]) -> Rollouts:
    """Read a Minari data set."""
    _require()
    try:
        dataset = _found(str(name))
        metadata = dataset.storage.metadata
        own = metadata.get(KEY, {})
        signals = Signals(measured=own.get("measured", ()), hidden=own.get("hidden", ()))
        dt = check_dt(own["dt"]) if "dt" in own else None
        episodes = [
            Episode(one.observations, one.actions, one.rewards, bool(one.terminations[-1:].any()), one.infos or {})
            for one in dataset.iterate_episodes()
        ]
    except (AssertionError, AttributeError, KeyError, OSError, TypeError, ValueError, NotImplementedError) as error:
        raise ValueError(f"{name} cannot be read as a Minari data set: {error}") from error
    if not episodes:
        raise ValueError(f"{name} holds no episode")
    spec = dataset.env_spec
    kwargs = {} if spec is None else {key: value for key, value in spec.kwargs.items() if key not in APPEARANCE}
    return Rollouts(
        str(name).removeprefix(PREFIX),
        None if spec is None else {"id": spec.id, "kwargs": kwargs},
        dt or _interval(str(name), spec, kwargs, warn),
        metadata["observation_space"],
        metadata["action_space"],
        episodes,
        signals,
    )


def write_dataset(rollouts: Rollouts, spec: "gym.envs.registration.EnvSpec | None", *, policy: str) -> Path:
    """Write a Minari data set, whole or not at all.

    What a process left beside it that was killed is removed, see :func:`observers.storage.clear_unfinished`.
    """
    folder = dataset_folder(rollouts.name)
    from minari import __version__
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = parse_dataset_id(rollouts.name)[0]
    if namespace is not None and namespace not in list_local_namespaces():
        create_namespace(namespace)
    clear_unfinished(folder.parent)
    temporary = folder.with_name(f"{UNFINISHED}{secrets.token_hex(4)}")
    temporary.mkdir(parents=True)
    try:
        storage = MinariStorage.new(
            temporary / DATA,
            observation_space=rollouts.observation_space,
            action_space=rollouts.action_space,
            env_spec=None if spec is None else _written(spec),
            jpeg_encoding=False,
        )
        storage.update_episodes(
            EpisodeBuffer(
                observations=episode.observations,
                actions=episode.actions,
                rewards=list(episode.rewards),
                terminations=_at_the_end(episode, episode.terminated),
                truncations=_at_the_end(episode, not episode.terminated),
                infos=dict(episode.infos),
            )
            for episode in rollouts.episodes
        )
        named = {role: list(getattr(rollouts.signals, role)) for role in ("measured", "hidden")}
        storage.update_metadata(
            {
                "dataset_id": rollouts.name,
                "minari_version": __version__,
                "algorithm_name": policy,
                KEY: {"dt": rollouts.dt, **named},
            }
        )
        os.rename(temporary, folder)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            _refuse_existing(folder, rollouts.name)  # another process was quicker
        raise
    return folder


def dataset_folder(name: str) -> Path:
    """The folder of a data set that is to be written."""
    _require()
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage.datasets_root_dir import get_dataset_path

    try:
        parse_dataset_id(name)
    except (TypeError, ValueError):
        raise ValueError(f"a Minari data set is called as in pendulum/random-v0, got {name!r}") from None
    folder = Path(get_dataset_path(name))
    _refuse_existing(folder, name)
    there = next(parent for parent in folder.parents if parent.exists())
    if not os.access(there, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(there))
    return folder


def _refuse_existing(folder: Path, name: str) -> None:
    if folder.exists():
        raise ValueError(f"there is a data set {name} already; name another (--dataset), or `minari delete {name}`")


def _written(spec: "gym.envs.registration.EnvSpec") -> "gym.envs.registration.EnvSpec":
    """A specification as JSON can hold it: classes and functions by where they are written."""
    found = copy.copy(spec)
    for name in ("entry_point", "vector_entry_point"):
        made_by = getattr(spec, name)
        if callable(made_by):
            what = getattr(made_by, "__qualname__", type(made_by).__qualname__)
            setattr(found, name, f"{made_by.__module__}:{what}")
    return found


def _at_the_end(episode: Episode, value: bool) -> list[bool]:
    return [False] * (len(episode.rewards) - 1) + [value]


def _found(name: str) -> "MinariDataset":
    import minari
    from minari.storage.datasets_root_dir import get_dataset_path

    folder = Path(get_dataset_path(name.removeprefix(PREFIX)) if name.startswith(PREFIX) else name)
    data = next((part for part in (folder / DATA, folder) if (part / METADATA).is_file()), None)
    if data is None:
        raise ValueError(f"there is none in {folder}; `minari list local` says which there are")
    said = json.loads((data / METADATA).read_text(encoding="utf-8"))
    if not {"observation_space", "action_space"} <= said.keys():  # Minari would make the environment, whatever it runs
        raise ValueError("it does not say its spaces")
    return minari.MinariDataset(data)


def _interval(name: str, spec: Any, kwargs: Mapping[str, Any], warn: Callable[[str], object]) -> float:
    """Seconds between samples, asked of an environment of Gymnasium's own; to make others may run what a file says."""
    registered = None if spec is None else gym.registry.get(spec.id)
    if registered is not None and str(registered.entry_point).startswith("gymnasium."):
        try:
            env = gym.make(spec.id, **kwargs)
        except Exception as error:  # whatever is missing
            warn(f"{name}: a step counts as 1 s, as {spec.id} cannot be made: {error}")
            return 1.0
        with env:
            return sampling_interval(env)
    warn(f"{name} says no sampling interval: a step counts as 1 s")
    return 1.0


def _require() -> None:
    try:
        import h5py  # noqa: F401
        import minari  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f'{error}: Minari data sets need pip install "kkl-gym[envs]"', name=error.name
        ) from None
