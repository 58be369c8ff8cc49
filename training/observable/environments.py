"""From an environment to what its outputs tell of its hidden signals, in one call."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from training.evaluation.levels import Level
from training.observable.found import Observability
from training.observable.recorded import of_records
from training.progress import ProgressBars, progress_bars
from training.rollouts import Policy, make, policy_of, roll_out
from training.rollouts.policies import RANDOM

STEPS = 10_000  # that are played where nothing else is asked for


def observability(
    env_id: str,
    *,
    measured: Sequence[str | int],
    hidden: Sequence[str | int],
    policy: str | Policy = RANDOM,
    episodes: int | None = None,
    steps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    measurement_noise: Sequence[Level] | None = None,
    seed: int = 0,
    console: Console | ProgressBars | None = None,
) -> Observability:
    """Find which hidden signals of any environment its outputs and actions determine, before an observer is trained.

    Parameters
    ----------
    env_id : str
        As ``gym.make`` takes it.
    measured, hidden : sequence of str or int
        What an observer would see, and what it would estimate, as for :func:`training.learn`.
    policy : str or callable
        Who acts, see :func:`training.rollouts.policy_of`. What is found holds where it has been.
    episodes, steps : int, optional
        How much is played, to whichever is reached first; by default 10,000 steps.
    env_kwargs : mapping of str to object, optional
        Arguments of the environment.
    measurement_noise : sequence of (float or tuple of float), optional
        Standard deviations on each sample of y, of all outputs or each, beside 0; by default 1 % and 10 % of those of
        the outputs.
    seed : int
        Of the rollouts and of the comparison.
    console : rich.console.Console or ProgressBars, optional
        Where progress is shown; by default nowhere.

    Returns
    -------
    Observability
        What was found; ``judgements`` says it in words.

    Raises
    ------
    ValueError
        If an argument makes no sense, or as :func:`training.observable.of_records`.
    """
    if episodes is None and steps is None:
        steps = STEPS
    if not hidden:
        raise ValueError("say which signals are hidden, as in hidden=[2]")
    with progress_bars(console) as progress, make(env_id, env_kwargs) as env:
        with progress.phase(f"playing {env_id}", steps or episodes or 1) as report:
            rollouts = roll_out(
                env,
                policy_of(policy, env),
                measured=[str(name) for name in measured],
                hidden=[str(name) for name in hidden],
                episodes=episodes,
                steps=steps,
                seed=seed,
                report=report,
            )
        with progress.phase("comparing neighbours", 100) as report:
            found = of_records(
                rollouts.records(),
                measurement_noise=measurement_noise,
                seed=seed,
                report=lambda share: report(100 * share),
            )
    return found


__all__ = ["observability"]
