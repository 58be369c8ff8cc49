"""Training of an agent by an algorithm of stable-baselines3."""

import ast
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize
from torch import nn

from kkl_gym import OWN_ID, get_system
from kkl_gym.wrappers.vector import VectorEnv
from training.agents.agent import Agent, fingerprint, rules
from training.agents.bridge import SB3VecEnv
from training.agents.checkpoint import Checkpoint
from training.agents.cost import Cost
from training.agents.environments import CLEAN_Y, vector
from training.agents.information import ESTIMATED, OBSERVED, Information, make, observer_of, weighted
from training.agents.observing import OBSERVER, Privileged, estimated_entries, learn_observer, refits, wander
from training.agents.policy import ALGORITHMS, CONTINUOUS, head_of, linear, lstm_in, perceptron
from training.agents.seeds import agent_training_seed
from training.agents.tasks import PREFERRED, Task
from training.progress import ProgressBars, progress_bars
from training.run import CHECKPOINT

RECURRENT = "ppo_lstm"
# A training that learns an observer has a first phase without estimates. Without noise, the phase takes this share of
# all steps, and the agent learns from true hidden signals: its policy also suits the later, very accurate estimates.
PRIVILEGED = 0.9
WANDERED = 0.1  # share of all steps that the first phase takes under noise; its actions are random
REHEARSAL = 0.05  # share of steps at the end of a training that refits the observer; no learning or exploration then
FILE = "agent.safetensors"
_OF_THE_RUN = ("n_envs", "n_timesteps", "normalize", "noise_type", "noise_std")  # settings that no algorithm takes
_OF_RL_ZOO3 = ("env_kwargs", "env_wrapper")  # settings from which rl-zoo3 makes a system's task


def algorithm_for(task: Task, information: Information, actions: gym.Space[Any]) -> str:
    """Return the default: ppo_lstm if recurrent, PREFERRED's for a system, sac for environments of sac.yml, or ppo."""
    if information == "recurrent":
        return RECURRENT
    if task.system is not None:
        return PREFERRED.get(task.name, "ppo")
    return "sac" if isinstance(actions, spaces.Box) and task.env_id in settings_of("sac") else "ppo"


@cache
def settings_of(algorithm: str) -> dict[str, dict[str, Any]]:
    """Return the settings in hyperparameters/ALGORITHM.yml, by environment; rl-zoo3 reads these files too."""
    if algorithm not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {algorithm!r}; there are {', '.join(ALGORITHMS)}")
    text = files("training.agents").joinpath("hyperparameters", f"{algorithm}.yml").read_text()
    return dict(yaml.safe_load(text))


def hyperparameters(algorithm: str, task: Task, timesteps: int | None = None) -> dict[str, Any]:
    """Return the settings of an algorithm for a task."""
    known = settings_of(algorithm)
    other = OWN_ID if task.system is not None and OWN_ID in known else "default"
    settings = deepcopy(known.get(task.env_id, known[other]))
    for key in _OF_RL_ZOO3:
        settings.pop(key, None)
    if timesteps is not None:
        if timesteps < 1:
            raise ValueError(f"timesteps must be positive, got {timesteps}")
        settings["n_timesteps"] = timesteps
    return settings


def learn(
    task: Task,
    information: Information,
    folder: Path,
    *,
    algorithm: str | None = None,
    timesteps: int | None = None,
    seed: int = 0,
    observer: str | None = None,
    observer_steps: int | None = None,
    aggregate: int = 0,
    resume: bool = False,
    show: Callable[..., VectorEnv] = make,
    progress: ProgressBars | None = None,
) -> Agent:
    """Train one agent; write checkpoints, agent.safetensors, curve.csv and, if learned or refitted, the observer.

    If no observer is given to an agent that sees x_hat in an environment without a system, one is learned from the
    first ``observer_steps`` steps. Without noise the agent also learns in these steps: it sees the true hidden signals,
    and afterwards their estimates. Under noise the estimates are less accurate, and a policy for true signals does not
    suit them. By default the first steps are then fewer. Their actions are random, and only the observer learns.

    If the agent sees z under noise and ``observer_steps`` is given, z learns to predict outputs from so many steps with
    random actions (:meth:`kkl_gym.KKLMemory.learn_weights`). All first steps count as steps of the training. Refits of
    the observer use the agent's own steps: ``aggregate`` refits and, if this is not 0, one more at the end.

    A resumed training starts new episodes, so its agent differs from that of an uninterrupted training.
    ``Agent.training`` then holds the number of resumptions.
    """
    with closing(vector(task.without_noise, 1)) as env:
        actions, size = env.single_action_space, gym.spaces.flatdim(env.single_observation_space)
    name = algorithm or algorithm_for(task, information, actions)
    settings = hyperparameters(name, task, timesteps)
    steps, rows = settings["n_timesteps"], settings.get("n_envs", 1)
    _check_actions(name, actions, task.env_id)
    if information == "recurrent" and name != RECURRENT:
        raise ValueError(f"recurrent agents learn by {RECURRENT} only, got {name!r}")
    if aggregate and (task.system is not None or information not in ESTIMATED):
        raise ValueError(f"aggregate needs x_hat or x_hat_std, and no system; got {information!r} of {task.env_id}")
    if task.system is not None and information in OBSERVED and observer is None and show is make:
        observer = observer_of(get_system(task.system))
    rehearsal = round(REHEARSAL * steps) if aggregate else 0
    # Whether an observer is learned during the training.
    fits = task.system is None and information in ESTIMATED and observer is None
    if fits and information != "x_hat":
        raise ValueError(f"{information} needs a trained observer with error bars: pass its file (--observer FILE)")
    if fits and not estimated_entries(task, size):
        raise ValueError(f"all entries of {task.env_id} are measured without noise: nothing is left to estimate")
    noisy_z = information == "z" and observer is None and task.measurement_noise and task.weights is None
    if observer_steps is not None and not (fits or noisy_z):
        raise ValueError("observer_steps is only for environments without an observer: for x_hat, or for z under noise")
    weighs = noisy_z and observer_steps is not None
    first = _first_steps(task, steps, rehearsal, observer_steps) if fits or weighs else 0
    how = {"algorithm": name, **settings, "seed": seed, "observer_steps": first, "aggregate": aggregate}
    observed = None if observer is None else [observer, fingerprint(observer)]
    identity = json.dumps([asdict(task), information, observed, rules(task), how], sort_keys=True)
    checkpoint = Checkpoint(folder / f"agent{CHECKPOINT}", hashlib.sha256(identity.encode()).hexdigest(), resume=resume)
    resumes = checkpoint.saved is not None
    if resumes and (folder / FILE).exists():
        return Agent.read(folder / FILE)
    if weighs:
        checkpoint.spent = first
        task = replace(task, weights=checkpoint.weights) if resumes else weighted(task, first, seed=seed)
        checkpoint.weights = task.weights
    with progress_bars(progress) as bars:
        fit = partial(learn_observer, task, folder=folder, seed=seed, progress=bars)
        privileged = None
        if fits and task.measurement_noise:
            checkpoint.spent = first
            if not resumes:
                fit(wander(task, first, seed=seed, progress=bars))
        elif fits:
            privileged = Privileged(task, rows, checkpoint.saved_records(_like(task)) if resumes else ())
            checkpoint.privileged = not resumes or checkpoint.saved["privileged"]  # type: ignore[index]
        if fits:
            observer = str(folder / OBSERVER)
        left = steps - rehearsal - checkpoint.spent

        def make_envs() -> VectorEnv:
            if privileged is not None and checkpoint.privileged:
                return privileged.make()
            return show(task, information, rows, observer=observer)

        keys = ("y", "u", "x", "sample", CLEAN_Y) if aggregate else ()
        description = f"{task.name} {information} {seed}"
        with closing(Learner(name, settings, seed, task, make_envs(), keys)) as learner:
            learner.begin(checkpoint, left)
            if privileged is not None and checkpoint.privileged:
                checkpoint.records = privileged.records
                with bars.phase(f"{description}, on true hidden signals", first) as report:
                    learner.learn(left, [_Bar(report), checkpoint], until=first)
                if learner.steps >= left:
                    raise ValueError(f"all {left} steps come before the first estimate: pass more (--timesteps)")
                fit(privileged.records())
                checkpoint.privileged = False
                checkpoint.restarts += 1
                learner.move(make_envs(), checkpoint.restarts)
            callbacks: list[BaseCallback] = [checkpoint]
            if aggregate:
                # Refits leave out the steps with random actions.
                before = [] if privileged is None else privileged.records()
                checkpoint.records = lambda: before
                every = max(1, (left - (first - checkpoint.spent)) // (aggregate + 1))
                callbacks.append(refitting := refits(task, every, rehearsal, folder / OBSERVER, before))
            else:
                checkpoint.records = list
            with bars.phase(description, left) as report:
                learner.learn(left, [_Bar(report), *callbacks])
    model = learner.model
    if aggregate:
        refitting.artifact.save(folder / OBSERVER)  # a given observer stays in use if no refit was possible
        observer = str(folder / OBSERVER)
    resumed = {"resumed": checkpoint.resumed} if checkpoint.resumed else {}
    training = {**how, "timesteps": model.num_timesteps + checkpoint.spent, **resumed}
    agent = agent_of(model, task, information, observer=observer, training=training)
    agent.save(folder / FILE)
    return agent


def _first_steps(task: Task, steps: int, rehearsal: int, given: int | None) -> int:
    """Return the number of first steps, from which an observer or z's predictions of outputs are learned."""
    first = round((WANDERED if task.measurement_noise else PRIVILEGED) * steps) if given is None else given
    if 0 < first < steps - rehearsal:
        return first
    if given is None:
        raise ValueError(f"{steps} steps are too few for an observer and an agent: pass more (--timesteps)")
    raise ValueError(f"observer_steps must be from 1 to {steps - rehearsal - 1}, got {given}")


def _like(task: Task) -> Any:
    """Return a record of one step, which has the fields that all records of the task share."""
    alone = Privileged(task, 1)
    with closing(alone.make()) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
        return alone.records()[0]


def _check_actions(algorithm: str, space: gym.Space[Any], env_id: str) -> None:
    """Raise ValueError if the algorithm cannot learn with these actions."""
    if isinstance(space, spaces.Discrete):
        fits, others = algorithm not in CONTINUOUS, "ppo, a2c or dqn"
    elif isinstance(space, spaces.Box) and len(space.shape) == 1:
        fits, others = algorithm != "dqn", "ppo, a2c, sac, td3 or tqc"
        if algorithm in CONTINUOUS and not space.is_bounded():
            fits, others = False, "ppo or a2c, as the actions are unbounded"
    else:
        raise ValueError(f"agents need Discrete actions or a vector of numbers; the actions of {env_id} are {space}")
    if not fits:
        raise ValueError(f"{algorithm} cannot learn in {env_id}, whose actions are {space}: take {others}")


class Learner:
    """An algorithm and its environments; settings have the same meaning as in rl-zoo3."""

    def __init__(
        self,
        algorithm: str,
        settings: Mapping[str, Any],
        seed: int,
        task: Task,
        env: VectorEnv,
        info_keys: Sequence[str],
    ) -> None:
        given = deepcopy({key: value for key, value in settings.items() if key not in _OF_THE_RUN})
        pays = task.system is not None and not get_system(task.system).states_task
        self._seed, self._pays, self._keys = seed, task if pays else None, info_keys
        vec_env = self._monitored(env)
        for key in ("learning_rate", "clip_range"):
            if isinstance(given.get(key), str):
                given[key] = linear(float(given[key].removeprefix("lin_")))
        if isinstance(given.get("policy_kwargs"), str):
            given["policy_kwargs"] = _keywords(given["policy_kwargs"])
        if settings.get("noise_type") == "normal":
            size = np.full(vec_env.action_space.shape or (), settings["noise_std"])
            given["action_noise"] = NormalActionNoise(np.zeros_like(size), size)
        if settings.get("normalize"):
            vec_env = VecNormalize(vec_env, gamma=given.get("gamma", 0.99))
        try:
            self.model = ALGORITHMS[algorithm](env=vec_env, seed=seed, device="cpu", **given)
        except BaseException:
            vec_env.close()
            raise

    @property
    def steps(self) -> int:
        """Number of steps that the model has made."""
        return self.model.num_timesteps

    def begin(self, checkpoint: Checkpoint, steps: int) -> None:
        """Seed the episodes, and resume from a checkpoint if there is one."""
        checkpoint.restore(self.model, steps)
        vec_env: Any = self.model.get_env()
        first = agent_training_seed(self._seed, checkpoint.restarts, vec_env.num_envs)
        if checkpoint.restarts:
            self.model.set_random_seed(first)
        # This seed replaces the model's own, with which the model has seeded the environments.
        vec_env.seed(first)

    def learn(self, steps: int, callbacks: list[BaseCallback], *, until: int | None = None) -> None:
        """Learn until the model has made ``steps`` steps.

        If ``until`` is given, learning stops before the first rollout that would begin after ``until`` steps, and at
        the latest before the last rollout.
        """
        stop = [] if until is None else [_Until(until, steps)]
        self.model.learn(steps - self.steps, callback=[*callbacks, *stop], reset_num_timesteps=False)

    def move(self, env: VectorEnv, restarts: int) -> None:
        """Continue in other environments with the same observation space; close the previous ones."""
        vec_env, before = self._monitored(env), self.model.get_env()
        if isinstance(before, VecNormalize):
            moments = before.obs_rms, before.ret_rms
            vec_env = VecNormalize(vec_env, gamma=before.gamma)
            vec_env.obs_rms, vec_env.ret_rms = moments
        vec_env.seed(agent_training_seed(self._seed, restarts, vec_env.num_envs))
        self.close()
        self.model.set_env(vec_env)

    def close(self) -> None:
        """Close the environments."""
        env = self.model.get_env()
        assert env is not None
        env.close()

    def _monitored(self, env: VectorEnv) -> VecEnv:
        return VecMonitor(SB3VecEnv(env if self._pays is None else Cost(env, self._pays), self._keys))


class _Until(BaseCallback):
    """Stops before the first rollout after ``steps`` of ``total`` steps, at the latest before the last rollout."""

    def __init__(self, steps: int, total: int) -> None:
        super().__init__()
        self._steps, self._total, self._over = steps, total, False

    def _on_training_start(self) -> None:
        self._begun = self.num_timesteps

    def _on_rollout_start(self) -> None:
        # The next rollout is expected to be as long as the previous one. Stopping takes one more step of all rows.
        rollout = self.num_timesteps - self._begun
        self._begun = self.num_timesteps
        stopping = self.training_env.num_envs
        self._over = self.num_timesteps >= min(self._steps, max(1, self._total - stopping - rollout))

    def _on_step(self) -> bool:
        return not self._over


class _Bar(BaseCallback):
    """Reports the number of steps."""

    def __init__(self, report: Callable[[float], object]) -> None:
        super().__init__()
        self._report = report

    def _on_step(self) -> bool:
        self._report(self.num_timesteps)
        return True


def _keywords(call: str) -> dict[str, Any]:
    """Return the arguments in a text ``dict(...)``, in which rl-zoo3's files name classes of torch.nn."""
    tree: Any = ast.parse(call, mode="eval")
    return {
        k.arg: getattr(nn, k.value.attr) if isinstance(k.value, ast.Attribute) else ast.literal_eval(k.value)
        for k in tree.body.keywords
    }


def agent_of(
    model: BaseAlgorithm,
    task: Task,
    information: Information,
    *,
    observer: str | None = None,
    training: Mapping[str, Any] | None = None,
) -> Agent:
    """Return a trained model's deterministic policy as an :class:`Agent`."""
    scaling = model.get_vec_normalize_env()
    moments: Any = None if scaling is None else scaling.obs_rms
    name = next(name for name, algorithm in ALGORITHMS.items() if type(model) is algorithm)
    return Agent(
        perceptron(model),
        head_of(name, discrete=isinstance(model.action_space, spaces.Discrete)),
        task,
        information,
        mean=None if moments is None else moments.mean.copy(),
        scale=None if moments is None else np.sqrt(moments.var + scaling.epsilon),  # type: ignore[union-attr]
        lstm=lstm_in(model.policy.state_dict()),
        observer=observer,
        fingerprint=None if observer is None else fingerprint(observer),
        rules=rules(task),
        training=training or {},
    )
