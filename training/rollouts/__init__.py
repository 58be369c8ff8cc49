"""Rollouts of environments, and observers that are learned from them."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from observers import Artifact
from training.config import Config
from training.files import refuse_checkpoints
from training.progress import ProgressBars, progress_bars
from training.rollouts.playing import RANDOM, Policy, make, play, policy_of, roll_out
from training.sources.recorded import RecordedSource, recorded_preset


def learn(
    env_id: str,
    *,
    measured: Sequence[str | int],
    hidden: Sequence[str | int],
    policy: str | Policy = RANDOM,
    episodes: int | None = None,
    steps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    console: Console | ProgressBars | None = None,
    **settings: Any,
) -> Artifact:
    """Learn an observer for any environment from rollouts that contain the hidden signals.

    Parameters
    ----------
    env_id : str
        Id of the environment, as for ``gym.make``.
    measured, hidden : sequence of str or int
        Signals that the observer measures, and signals that it estimates, at least one of each: indices in the
        flattened observation, keys of a Dict, or ``info[key]``, see :func:`kkl_gym.named.resolved`.
    policy : str or callable
        "random", "wandering" (random, but held for some steps), "script.py:function", an agent as in "ppo:FILE.zip",
        or a function from observations to actions. Estimates are accurate only where the policy has been.
    episodes, steps : int, optional
        Episodes and steps to play, until either number is reached; by default 100,000 steps.
    env_kwargs : mapping of str to object, optional
        Arguments of the environment.
    seed : int
        Seed of the rollouts and of the training.
    out : str or Path, optional
        Folder for checkpoints and ENV_ID.safetensors; by default nothing is written.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default nowhere.
    **settings : object
        Settings of :class:`training.Config`, such as ``tracking=False``.

    Returns
    -------
    Artifact
        The observer. It tracks if each measured signal is a hidden signal, or a weighted sum of hidden signals.
        ``training["held_out_errors"]`` are its errors on held-out episodes; of fewer than five, the ends are held out.

    Raises
    ------
    ValueError
        If an argument is invalid, or for the reasons of :func:`training.train`.
    """
    from training.lessons import train  # torch takes seconds to import

    if not np.size(hidden):
        raise ValueError("name the hidden signals, which the observer is to estimate, as in hidden=[2]")
    settings = {"seed": seed} | settings
    # Config checks the settings before anything is played; -1 stands for eigenvalues that follow from the rollouts.
    Config("input-aware", **{"eigenvalues": (-1.0,)} | {name: v for name, v in settings.items() if v is not None})
    folder = None if out is None else Path(out)
    if folder is not None:
        refuse_checkpoints(folder)
    with progress_bars(console) as progress:
        signals: dict[str, Any] = {"measured": measured, "hidden": hidden}
        amount: dict[str, Any] = {"episodes": episodes, "steps": steps, "seed": seed}
        rollouts = play(env_id, partial(policy_of, policy), progress, **signals, **amount, env_kwargs=env_kwargs)
        records, name = rollouts.records(), (rollouts.environment or {})["id"].replace("/", "-")
        source = RecordedSource(records, recorded_preset(records, settings), name)
        artifact = train(source, folder=folder, console=progress).artifact
        if folder is not None:
            artifact.save(folder / f"{name}.safetensors")
    return artifact


__all__ = ["Policy", "learn", "make", "play", "policy_of", "roll_out"]
