"""Train an agent with stable-baselines3 on a control task."""

import ast
import hashlib
import json
from dataclasses import asdict
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

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
from observers.storage import naming
from training.agents.agent import Agent, fingerprint, rules
from training.agents.bridge import SB3VecEnv
from training.agents.checkpoint import CURVE, Checkpoint
from training.agents.cost import Cost
from training.agents.information import OBSERVED, Features, Information, make, observer_of
from training.agents.policy import linear, perceptron
from training.agents.seeds import agent_training_seed
from training.agents.tasks import PREFERRED, ControlTask
from training.checkpoints import SUFFIX

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
    resume: bool = False,
    progress: Progress | None = None,
) -> Agent:
    """Train one agent, with checkpoints.

    A training that goes on from a checkpoint begins new episodes, so that it makes another agent than one that never
    stopped; ``Agent.training`` then says how many times it was resumed.
    """
    if algorithm is not None and algorithm not in FEEDFORWARD:
        raise ValueError(f"algorithm must be one of {', '.join(FEEDFORWARD)}, got {algorithm!r}")
    if observer is not None and information not in OBSERVED:
        raise ValueError(f"an agent that knows {information!r} has no use for the observer {observer!r}")
    name, settings = hyperparameters(task, algorithm)
    named = (observer or observer_of(get_system(task.system))) if information in OBSERVED else None
    env = make(task, information, settings["n_envs"], observer=named)
    timesteps = settings["n_timesteps"] if timesteps is None else timesteps
    if timesteps < 1:
        raise ValueError(f"timesteps must be positive, got {timesteps}")
    seen: dict[str, Any] = {
        "information": information,
        "observer": named,
        "fingerprint": None if named is None else fingerprint(named),
        "rules": rules(task),
    }
    how = {"algorithm": name, **settings, "seed": seed}
    identity = json.dumps([asdict(task), seen, how, timesteps], sort_keys=True)
    checkpoint = Checkpoint(folder / f"agent{SUFFIX}", hashlib.sha256(identity.encode()).hexdigest())
    if not resume:
        checkpoint.path.unlink(missing_ok=True)
    model = fit(
        name,
        settings,
        env=env,
        task=task,
        timesteps=timesteps,
        seed=seed,
        folder=folder,
        checkpoint=checkpoint,
        progress=progress,
        description=f"{get_system(task.system).name} {information}",
    )
    resumed = {"resumed": checkpoint.resumed} if checkpoint.resumed else {}
    agent = Agent(
        network=perceptron(model),
        squashed=name == "sac",
        task=task,
        training={**how, "timesteps": model.num_timesteps, **resumed},
        **seen,
    )
    agent.save(folder / "agent.safetensors")
    return agent


def fit(
    algorithm: str,
    settings: dict[str, Any],
    *,
    env: Features,
    task: ControlTask,
    timesteps: int,
    seed: int,
    folder: Path,
    checkpoint: Checkpoint | None = None,
    progress: Progress | None = None,
    description: str,
) -> BaseAlgorithm:
    """Train on minus the cost, with the learning curve in FOLDER/progress.csv; goes on from the checkpoint's file."""
    settings = {key: value for key, value in settings.items() if key not in ("n_envs", "n_timesteps")}
    vec_env = VecMonitor(SB3VecEnv(Cost(env, task)))
    rate = settings.pop("learning_rate")
    if isinstance(rate, str):
        rate = linear(float(rate.removeprefix("lin_")))
    first, callbacks = (
        agent_training_seed(seed),
        list[BaseCallback]([_Bar(progress, f"{description} {seed}", timesteps)]),
    )
    settings["policy_kwargs"] = {"activation_fn": nn.Tanh, **settings.get("policy_kwargs", {})}
    model = ALGORITHMS[algorithm](env=vec_env, seed=seed, device="cpu", learning_rate=rate, **settings)
    with naming(folder / CURVE):  # which alone is written without its name in errors
        model.set_logger(configure(str(folder), ["csv"]))
        try:
            if checkpoint is not None:
                callbacks.append(checkpoint)
                checkpoint.restore(model, timesteps)
                if checkpoint.resumed:
                    first = agent_training_seed(seed, checkpoint.resumed, env.num_envs)
                    model.set_random_seed(first)
            vec_env.seed(first)  # only now: the model has seeded it with ``seed``
            model.learn(timesteps - model.num_timesteps, callback=callbacks, reset_num_timesteps=False)
        finally:
            model.logger.close()
            vec_env.close()
    return model


def hyperparameters(task: ControlTask, algorithm: str | None = None) -> tuple[str, dict[str, Any]]:
    """Find the algorithm and its settings for a task."""
    system = get_system(task.system)
    name = algorithm or PREFERRED.get(system.name, "ppo")
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; there are {', '.join(ALGORITHMS)}")
    known = _read(name)
    settings = dict(known.get(ENV_IDS.get(system.name, "default"), known["default"]))
    for key in ("env_kwargs", "env_wrapper"):  # what rl-zoo3 makes the task of
        settings.pop(key, None)
    if isinstance(given := settings.get("policy_kwargs"), str):
        settings["policy_kwargs"] = _keywords(given)
    return name, settings


@cache
def _read(name: str) -> dict[str, Any]:
    text = files("training.agents").joinpath("hyperparameters", f"{name}.yml").read_text()
    return dict(yaml.safe_load(text))


def _keywords(call: str) -> dict[str, Any]:
    """Arguments of ``dict(...)``, as rl-zoo3 needs it for a class, but for the activation: tanh everywhere here."""
    tree: Any = ast.parse(call, mode="eval")
    return {k.arg: ast.literal_eval(k.value) for k in tree.body.keywords if k.arg != "activation_fn"}


class _Bar(BaseCallback):
    """Progress by actions."""

    def __init__(self, progress: Progress | None, name: str, total: int) -> None:
        super().__init__()
        self._progress, self._name, self._total = progress, name, total

    def _on_training_start(self) -> None:
        if self._progress is not None:
            done = self.model.num_timesteps  # more than none where a training goes on
            self._bar = self._progress.add_task(self._name, total=self._total, completed=done)

    def _on_step(self) -> bool:
        if self._progress is not None:  # the last rollout ends past the last step
            self._progress.update(self._bar, completed=min(self.num_timesteps, self._total))
        return True
