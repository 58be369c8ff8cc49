"""From an environment to an observer for it, in one call."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from observers import Artifact
from observers.checks import flag
from training.jobs import refuse_checkpoints
from training.progress import ProgressBars, progress_bars
from training.recorded.config import RecordedConfig, recorded_config
from training.recorded.preparing import split
from training.rollouts.playing import make, roll_out
from training.rollouts.policies import RANDOM, Policy, policy_of


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
    tracking: bool = False,
    out: str | Path | None = None,
    console: Console | ProgressBars | None = None,
    **settings: Any,
) -> Artifact:
    """Learn an observer for any environment from rollouts in which the hidden signals are seen.

    Parameters
    ----------
    env_id : str
        As ``gym.make`` takes it.
    measured, hidden : sequence of str or int
        What the observer sees, and what it estimates, one of each at least: indices in the flattened observation,
        keys of a Dict, or ``info[key]``, see :func:`kkl_gym.named.resolved`.
    policy : str or callable
        Who acts, see :func:`training.rollouts.policy_of`. Estimates are good where it has been.
    episodes, steps : int, optional
        How much is played, to whichever is reached first; by default 100,000 steps.
    env_kwargs : mapping of str to object, optional
        Arguments of the environment.
    seed : int
        Of the rollouts and of the training.
    tracking : bool
        Whether the observer learns error bars too, and to track, which lowers its errors under noise and takes a minute
        or two, see :func:`training.recorded.tracking.learn_recorded_tracking`. What is measured has to be among the
        hidden signals.
    out : str or Path, optional
        A folder, which then receives checkpoints and ENV_ID.safetensors; by default nothing is written.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default nowhere.
    **settings : object
        Of :class:`training.recorded.config.RecordedConfig`.

    Returns
    -------
    Artifact
        The observer; ``training["held_out_errors"]`` are its errors on episodes that were not trained on.

    Raises
    ------
    ValueError
        If an argument makes no sense, or as :func:`training.recorded.fit.train_recorded` and, with ``tracking``,
        :func:`training.recorded.tracking.learn_recorded_tracking`.
    """
    from training.recorded.calibrating import require_enough  # torch takes seconds to import
    from training.recorded.errorbars import learn_recorded_error_bars
    from training.recorded.fit import train_recorded
    from training.recorded.tracking import check_trackable, learn_recorded_tracking, linear_output

    if episodes is None and steps is None:
        steps = 100_000
    settings = {"seed": seed} | settings
    checked = _check(hidden, settings, None if out is None else Path(out))
    if flag("tracking", tracking):
        check_trackable(checked)
        if not checked.held_out:
            raise ValueError("error bars are calibrated on what is held out: held_out must be positive, got 0")
    with tempfile.TemporaryDirectory() as scratch, progress_bars(console) as progress:
        folder = Path(scratch) / "run" if out is None else Path(out)
        playing = progress.phase(f"playing {env_id}", steps or episodes or 1)
        with make(env_id, env_kwargs) as env, playing as report:
            rollouts = roll_out(
                env,
                policy_of(policy, env),
                measured=measured,
                hidden=hidden,
                episodes=episodes,
                steps=steps,
                seed=seed,
                report=report,
            )
        records = rollouts.records()
        if tracking:  # an error now, not after minutes
            linear_output(records)
            require_enough(split(records, checked.held_out, checked.seed)[1])
        config = recorded_config(records, settings)
        name = (rollouts.environment or {})["id"].replace("/", "-")
        artifact = train_recorded(records, config, folder, name=name, console=progress).artifact
        if out is not None:
            artifact.save(folder / f"{name}.safetensors")  # before anything else may fail
        if tracking:
            artifact = learn_recorded_error_bars(artifact, records, seed=seed, console=progress)
            artifact = learn_recorded_tracking(artifact, records, seed=seed, console=progress)
        if out is not None:
            artifact.save(folder / f"{name}.safetensors")
    return artifact


def _check(hidden: Sequence[str | int], settings: Mapping[str, Any], out: Path | None) -> RecordedConfig:
    """What would be an error after all was played is one before; settings that rollouts decide are not right yet."""
    if not np.size(hidden):
        raise ValueError("say which signals are hidden, which the observer is to estimate, as in hidden=[2]")
    chosen_later: dict[str, Any] = {"eigenvalues": (-1.0,), "dt": 1.0, "measurement_noise_max": 1.0}
    config = RecordedConfig(**chosen_later | {name: value for name, value in settings.items() if value is not None})
    if out is not None:
        refuse_checkpoints(out)
    return config


__all__ = ["learn"]
