"""Train an agent with stable-baselines3 on a control task."""

from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from rich.progress import Progress
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor
from torch import nn

from kkl_gym import ENV_IDS, get_system
from kkl_gym.wrappers.vector import VectorEnv, VectorWrapper
from observers import MLP
from training.agents.agent import Agent, fingerprint, rules, versioned
from training.agents.bridge import SB3VecEnv
from training.agents.information import Features, Information, make, observer_of
from training.agents.play import Policy
from training.seeds import agent_training_seed
from training.systems import ControlTask, profile

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC, "ppo_lstm": RecurrentPPO}
FEEDFORWARD = ("ppo", "sac")  # whose policies are perceptrons, which ship


def learn(
    task: ControlTask,
    information: Information,
    folder: Path,
    *,
    seed: int = 0,
    timesteps: int | None = None,
    observer: str | None = None,
    algorithm: str | None = None,
    progress: Progress | None = None,
) -> Agent:
    """Train one agent.

    Parameters
    ----------
    task : ControlTask
        What it is to do.
    information : {"state", "x_hat", "z", "y", "stacked", "ekf"}
        What it knows, as for :func:`training.agents.information.make`.
    folder : Path
        Receives agent.safetensors and the learning curve, progress.csv.
    seed : int
        Seed of networks, exploration and episodes.
    timesteps : int, optional
        Actions in all rows together; by default what hyperparameters/ALGORITHM.yml says.
    observer : str, optional
        A shipped map or a ``.safetensors`` file, for an agent that knows "x_hat" or "z"; by default
        :func:`training.agents.information.observer_of` the system.
    algorithm : {"ppo", "sac"}, optional
        By default that of the system's profile.
    progress : rich.progress.Progress, optional
        Where a bar is shown.

    Returns
    -------
    Agent
        As saved.

    Raises
    ------
    ValueError
        On an unknown algorithm or a number of timesteps that makes no sense, or if no observer ships for the system.
    """
    if algorithm is not None and algorithm not in FEEDFORWARD:
        raise ValueError(f"algorithm must be one of {', '.join(FEEDFORWARD)}, got {algorithm!r}")
    if observer is not None and information not in ("x_hat", "z"):
        raise ValueError(f"an agent that knows {information!r} has no use for the observer {observer!r}")
    name, settings = hyperparameters(task, algorithm)
    named = versioned(observer or observer_of(get_system(task.system))) if information in ("x_hat", "z") else None
    env = make(task, information, settings["n_envs"], observer=named)
    timesteps = settings["n_timesteps"] if timesteps is None else timesteps
    model = _fit(
        name,
        settings,
        env=env,
        task=task,
        timesteps=timesteps,
        seed=seed,
        folder=folder,
        progress=progress,
        description=f"{task.system} {information}",
    )
    agent = Agent(
        network=_policy(model),
        squashed=name == "sac",
        task=task,
        information=information,
        observer=named,
        fingerprint=None if named is None else fingerprint(named),
        rules=rules(task),
        training={"algorithm": name, **settings, "seed": seed, "timesteps": model.num_timesteps},
    )
    agent.save(folder / "agent.safetensors")
    return agent


def learn_recurrent(
    task: ControlTask,
    of: Literal["y", "state"],
    folder: Path,
    *,
    seed: int = 0,
    timesteps: int | None = None,
    progress: Progress | None = None,
) -> Callable[[], Policy]:
    """Train RecurrentPPO on the noisy output, or on the full state as a control, each with the action before.

    Parameters
    ----------
    task : ControlTask
        What the agent is to do.
    of : {"y", "state"}
        What it sees.
    folder : Path
        Receives the learning curve, progress.csv.
    seed : int
        Seed of networks, exploration and episodes.
    timesteps : int, optional
        Actions in all rows together; by default what hyperparameters/ppo_lstm.yml says.
    progress : rich.progress.Progress, optional
        Where a bar is shown.

    Returns
    -------
    callable
        Makes a policy, with a memory of its own, for one play.

    Raises
    ------
    ValueError
        If the number of timesteps makes no sense.
    """
    name, settings = hyperparameters(task, "ppo_lstm")
    env = make(task, of, settings["n_envs"], with_action=True)
    timesteps = settings["n_timesteps"] if timesteps is None else timesteps
    model = _fit(
        name,
        settings,
        env=env,
        task=task,
        timesteps=timesteps,
        seed=seed,
        folder=folder,
        progress=progress,
        description=f"{task.system} recurrent {of}",
    )

    def policy() -> Policy:
        memory: dict[str, Any] = {"state": None, "episode_start": None}

        def act(obs: np.ndarray) -> np.ndarray:
            if memory["episode_start"] is None:
                memory["episode_start"] = np.ones(len(obs), dtype=bool)
            action, memory["state"] = model.predict(obs, deterministic=True, **memory)
            memory["episode_start"] = np.zeros(len(obs), dtype=bool)
            bounded: np.ndarray = np.clip(action, -1.0, 1.0)
            return bounded

        return act

    return policy


def _fit(
    algorithm: str,
    settings: dict[str, Any],
    *,
    env: Features,
    task: ControlTask,
    timesteps: int,
    seed: int,
    folder: Path,
    progress: Progress | None,
    description: str,
) -> BaseAlgorithm:
    """Train on minus the cost, with the learning curve in FOLDER/progress.csv."""
    if timesteps < 1:
        raise ValueError(f"timesteps must be positive, got {timesteps}")
    settings = {key: value for key, value in settings.items() if key not in ("n_envs", "n_timesteps")}
    vec_env = VecMonitor(SB3VecEnv(Cost(env, task)))
    rate = settings.pop("learning_rate")
    if isinstance(rate, str):
        rate = _linear(float(rate.removeprefix("lin_")))
    first = agent_training_seed(seed)
    settings["policy_kwargs"] = {"activation_fn": nn.Tanh, **settings.get("policy_kwargs", {})}
    model = ALGORITHMS[algorithm](env=vec_env, seed=seed, device="cpu", learning_rate=rate, **settings)
    model.set_logger(configure(str(folder), ["csv"]))
    vec_env.seed(first)  # only now: the model has just seeded it with ``seed``
    try:
        model.learn(timesteps, callback=_Bar(progress, f"{description} {seed}", timesteps))
    finally:
        model.logger.close()
        vec_env.close()
    return model


def hyperparameters(task: ControlTask, algorithm: str | None = None) -> tuple[str, dict[str, Any]]:
    """Find the algorithm and its settings for a task.

    Parameters
    ----------
    task : ControlTask
        Of a shipped system, which has settings of its own, or of one of the user's, which gets the defaults.
    algorithm : {"ppo", "sac", "ppo_lstm"}, optional
        By default that of the system's profile.

    Returns
    -------
    algorithm : str
        Its name.
    settings : dict
        What hyperparameters/ALGORITHM.yml says of it.

    Raises
    ------
    ValueError
        If the algorithm is unknown.
    """
    system = get_system(task.system)
    name = algorithm or profile(system).algorithm
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; there are {', '.join(ALGORITHMS)}")
    known = _read(name)
    return name, dict(known.get(ENV_IDS.get(system.name, "default"), known["default"]))


@cache
def _read(name: str) -> dict[str, Any]:
    text = files("training.agents").joinpath("hyperparameters", f"{name}.yml").read_text()
    return dict(yaml.safe_load(text))


WORST = 10.0  # of the cost, three scales off in every state; beyond it, networks would learn little else


class Cost(VectorWrapper):
    """Rewards minus the cost c, at most ``WORST``, from the reward 1/(1 + 4c) averaged over an action's samples.

    The environment's reward is flat far from the target, where c still tells an agent which way to go. A state that
    escapes is taken to stay where it left for the rest of the episode, so that escaping never pays.

    Parameters
    ----------
    env : VectorEnv
        Whose rewards are replaced; it resets in the same step.
    task : ControlTask
        What made it.
    """

    def __init__(self, env: VectorEnv, task: ControlTask) -> None:
        super().__init__(env)
        self._task = task

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step, and replace the rewards.

        Parameters
        ----------
        actions : ndarray, shape (n, nu)
            As the environment takes them.

        Returns
        -------
        obs, reward, terminated, truncated, info
            What the environment returns, but for the rewards.
        """
        obs, total, terminated, truncated, info = self.env.step(actions)
        samples = np.full(self.num_envs, self._task.repeat)
        remaining = np.zeros(self.num_envs)
        if terminated.any():
            age = info["final_info"]["sample"]
            samples = np.where(terminated, (age - 1) % self._task.repeat + 1, samples)
            remaining = np.where(terminated, self._task.steps - np.ceil(age / self._task.repeat), 0.0)
        cost = np.minimum((samples / np.maximum(total, 1e-6) - 1.0) / 4.0, WORST)
        return obs, -cost * (1.0 + remaining), terminated, truncated, info


def _linear(start: float) -> Callable[[float], float]:
    return lambda remaining: start * max(remaining, 0.0)  # the last rollout ends past the last step


def _policy(model: BaseAlgorithm) -> MLP:
    """The deterministic policy's layers."""
    if isinstance(model, SAC):
        body: Any = [*model.actor.latent_pi, model.actor.mu]
    else:
        policy: Any = model.policy
        body = [*policy.mlp_extractor.policy_net, policy.action_net]
    layers = [layer for layer in body if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        return MLP([_array(layer.weight) for layer in layers], [_array(layer.bias) for layer in layers], "tanh")


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()


class _Bar(BaseCallback):
    """Progress by actions."""

    def __init__(self, progress: Progress | None, name: str, total: int) -> None:
        super().__init__()
        self._progress = progress
        self._bar = None if progress is None else progress.add_task(name, total=total)

    def _on_step(self) -> bool:
        if self._progress is not None and self._bar is not None:
            self._progress.update(self._bar, completed=self.num_timesteps)
        return True
