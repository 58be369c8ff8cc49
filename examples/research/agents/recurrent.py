"""Recurrent agents, which learn from the noisy output what others are told."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from kkl_gym import get_system
from training.agents.information import make
from training.agents.learn import fit, hyperparameters
from training.agents.play import Policy
from training.agents.tasks import ControlTask


def learn_recurrent(
    task: ControlTask, of: Literal["y", "state"], folder: Path, *, seed: int = 0, timesteps: int | None = None
) -> Policy:
    """Train RecurrentPPO on the noisy output, or on the full state as a control, each with the action before."""
    name, settings = hyperparameters(task, "ppo_lstm")
    model = fit(
        name,
        settings,
        env=make(task, of, settings["n_envs"], with_action=True),
        task=task,
        timesteps=settings["n_timesteps"] if timesteps is None else timesteps,
        seed=seed,
        folder=folder,
        description=f"{get_system(task.system).name} recurrent {of}",
    )
    memory: dict[str, Any] = {"state": None, "episode_start": None}

    def act(obs: np.ndarray) -> np.ndarray:
        if memory["episode_start"] is None:
            memory["episode_start"] = np.ones(len(obs), dtype=bool)
        action, memory["state"] = model.predict(obs, deterministic=True, **memory)
        memory["episode_start"] = np.zeros(len(obs), dtype=bool)
        bounded: np.ndarray = np.clip(action, -1.0, 1.0)
        return bounded

    return act
