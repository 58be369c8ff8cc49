"""Agents of stable-baselines3 learn in any environment of which they see a part."""

import csv
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from copy import deepcopy
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import spaces
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from observers.storage import replacing
from training.agents.agent import fingerprint
from training.agents.any_environment.information import Shown, show
from training.agents.any_environment.observing import KEPT, KKL, OBSERVER, Estimation, Told, wander
from training.agents.any_environment.player import Head, Player
from training.agents.any_environment.task import HiddenTask
from training.agents.policy import linear, perceptron
from training.agents.seeds import agent_training_seed
from training.progress import ProgressBars, progress_bars
from training.records import Record

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": PPO,
    "a2c": A2C,
    "dqn": DQN,
    "sac": SAC,
    "td3": TD3,
    "tqc": TQC,
    "ppo_lstm": RecurrentPPO,
}
RECURRENT = "ppo_lstm"
CONTINUOUS = ("sac", "td3", "tqc")  # whose actions are bounded numbers
# Of the steps of a training, the first ones, in which there are no estimates yet.
TOLD = 0.9  # without noise: estimates come so near to the truth that what is right with the one is right with the other
WANDERED = 0.1  # under noise
REHEARSAL = 0.05  # of the steps, the last ones, in which it acts without exploration and learns no more
CURVE = "curve.csv"
_OF_THE_RUN = ("n_envs", "n_timesteps", "normalize", "noise_type", "noise_std")  # and not of the algorithm


def algorithm_for(action_space: gym.Space[Any], env_id: str, information: Shown) -> str:
    """Choose who learns: recurrent PPO where that is what is shown, SAC where it has settings, else PPO."""
    if information == "recurrent":
        return RECURRENT
    return "sac" if isinstance(action_space, spaces.Box) and env_id in settings_of("sac") else "ppo"


@cache
def settings_of(algorithm: str) -> dict[str, dict[str, Any]]:
    """What hyperparameters/ALGORITHM.yml says, by environment; rl-zoo3 reads these files too."""
    if algorithm not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {algorithm!r}; there are {', '.join(ALGORITHMS)}")
    folder = files("training.agents.any_environment").joinpath("hyperparameters")
    return dict(yaml.safe_load(folder.joinpath(f"{algorithm}.yml").read_text()))


def hyperparameters(algorithm: str, env_id: str, timesteps: int | None = None) -> dict[str, Any]:
    """Find the settings of an algorithm for an environment."""
    known = settings_of(algorithm)
    found = deepcopy(known.get(env_id, known["default"]))
    if timesteps is not None:
        if timesteps < 1:
            raise ValueError(f"timesteps must be positive, got {timesteps}")
        found["n_timesteps"] = timesteps
    return found


def learn_to_play(
    task: HiddenTask,
    information: Shown,
    folder: Path,
    *,
    algorithm: str | None = None,
    timesteps: int | None = None,
    seed: int = 0,
    observer: str | None = None,
    observer_steps: int | None = None,
    aggregate: int = 0,
    estimation: Estimation = KKL,
    progress: ProgressBars | None = None,
) -> BaseAlgorithm:
    """Train one agent.

    Where an observer has to be learned, the agent's first steps are for both. As there are no estimates yet, the agent
    is told the truth in their place. The observer is learned from what happens, and the agent goes on with estimates.
    Under noise estimates are far from the truth; these steps are then fewer, and random actions, from which the
    observer alone is learned. They count too. With another ``estimation`` than that of KKL observers no agent is saved.
    """
    with show(task, "state") as env:
        actions, estimated = env.action_space, task.estimated(gym.spaces.flatdim(env.observation_space))
    name = algorithm or algorithm_for(actions, task.env_id, information)
    if (name == RECURRENT) != (information == "recurrent"):
        raise ValueError(f"{RECURRENT} is for information 'recurrent', and only that; got {name} and {information!r}")
    settings = hyperparameters(name, task.env_id, timesteps)
    _check_actions(name, actions, task.env_id)
    steps, began = settings["n_timesteps"], time.process_time()
    if observer is not None and information != "x_hat":
        raise ValueError(f"an agent that is shown {information!r} has no use for the observer {observer!r}")
    if information == "x_hat" and not estimated:
        raise ValueError(f"all entries of {task.env_id} are measured, without noise: nothing is left to estimate")
    if aggregate and information != "x_hat":
        raise ValueError(f"an agent that is shown {information!r} has no observer to fit again")
    rehearsal = round(REHEARSAL * steps) if aggregate else 0
    learns_observer, spent = information == "x_hat" and observer is None, 0
    if learns_observer:
        share = WANDERED if task.measurement_noise else TOLD
        spent = round(share * steps) if observer_steps is None else observer_steps
        if not 0 < spent < steps - rehearsal:
            if observer_steps is None:
                raise ValueError(f"{steps} steps are too few for an observer and an agent; give it more (--timesteps)")
            raise ValueError(
                f"observer_steps must be some, and fewer than all {steps - rehearsal} of learning; got {spent}"
            )
    elif observer_steps is not None:
        raise ValueError("observer_steps is for agents on x_hat that are given no observer")
    newest, description = folder / OBSERVER, f"{task.name} {information} {seed}"
    with progress_bars(progress) as bars:
        learned = partial(estimation.learn, task, folder=folder, seed=seed, progress=bars)
        curve, told, before = Curve(folder / CURVE, began=began), None, list[Record]()  # no random actions in refits
        if learns_observer and task.measurement_noise:  # what is right with the truth is not with estimates then
            observer = str(learned(wander(task, spent, seed=seed, progress=bars)))
            curve.spent = spent
        elif learns_observer:
            told = Told(task, settings.get("n_envs", 1))
        left = steps - rehearsal - curve.spent
        keep = KEPT // settings.get("n_envs", 1) if aggregate else None

        def make() -> gym.Env[Any, Any]:
            if told is not None and observer is None:
                return told.make()
            if information == "x_hat":
                return estimation.show(task, str(observer), keep)
            return show(task, information)

        with closing(_Learner(ALGORITHMS[name], settings, seed, make)) as learner:
            if told is not None:
                with bars.phase(f"{description}, told the truth", spent) as report:
                    learner.learn(left, [Bar(report), curve], until=spent)
                if learner.steps >= left:
                    raise ValueError(
                        f"the agent would never see an estimate: {name} collects {learner.steps} steps before it goes "
                        f"on; give it more than {steps} (--timesteps)"
                    )
                observer = str(learned(told.records()))
                before = told.oldest_first() if aggregate else []
                learner.move(make)
            callbacks: list[BaseCallback] = [curve]
            if aggregate:
                every = max(1, (left - learner.steps) // (aggregate + 1))
                callbacks.append(estimation.refits(task, learned, every, rehearsal, newest, before))
            with bars.phase(description, left) as report:
                learner.learn(left, [Bar(report), *callbacks])
    model = learner.model
    if name != RECURRENT and estimation is KKL:
        if learns_observer or aggregate:
            observer = str(newest)  # which is what the agent has seen last
        how = {"algorithm": name, **settings, "seed": seed, "observer_steps": spent, "aggregate": aggregate}
        player_of(model, task, information, observer=observer, training=how).save(folder / "agent.safetensors")
    return model


def _check_actions(algorithm: str, space: gym.Space[Any], env_id: str) -> None:
    """Raise ValueError unless an algorithm can act in a space."""
    if isinstance(space, spaces.Discrete):
        fits, others = algorithm not in CONTINUOUS, "ppo, a2c or dqn"
    elif isinstance(space, spaces.Box) and len(space.shape) == 1:
        fits, others = algorithm != "dqn", "ppo, a2c, sac, td3 or tqc"
        if algorithm in CONTINUOUS and not space.is_bounded():
            fits, others = False, "ppo or a2c, as there are no bounds"
    else:
        raise ValueError(f"agents learn where actions are Discrete or a row of numbers; those of {env_id} are {space}")
    if not fits:
        raise ValueError(f"{algorithm} cannot learn in {env_id}, whose actions are {space}: take {others}")


class _Learner:
    """An algorithm and its environments; what is given of rl-zoo3's settings means what it means there."""

    def __init__(
        self,
        algorithm: type[BaseAlgorithm],
        settings: Mapping[str, Any],
        seed: int,
        make: Callable[[], gym.Env[Any, Any]],
    ) -> None:
        given = deepcopy({key: value for key, value in settings.items() if key not in _OF_THE_RUN})
        self._rows, self._seed = settings.get("n_envs", 1), seed
        vec_env: VecEnv = make_vec_env(make, n_envs=self._rows)
        for key in ("learning_rate", "clip_range"):
            if isinstance(given.get(key), str):
                given[key] = linear(float(given[key].removeprefix("lin_")))
        if settings.get("noise_type") == "normal":
            size = np.full(vec_env.action_space.shape or (), settings["noise_std"])
            given["action_noise"] = NormalActionNoise(np.zeros_like(size), size)
        if settings.get("normalize"):
            vec_env = VecNormalize(vec_env, gamma=given.get("gamma", 0.99))
        try:
            self.model = algorithm(env=vec_env, seed=seed, device="cpu", **given)
        except BaseException:
            vec_env.close()
            raise
        vec_env.seed(agent_training_seed(seed))  # the model has seeded it with its own

    @property
    def steps(self) -> int:
        """How many steps it has learned from."""
        return self.model.num_timesteps

    def learn(self, steps: int, callbacks: list[BaseCallback], *, until: int | None = None) -> None:
        """Learn until there were so many steps.

        ``until`` stops before, where an algorithm begins to collect, and at the latest where it would collect for the
        last time.
        """
        done = self.steps
        stop = [] if until is None else [_Until(until, steps)]
        self.model.learn(steps - done, callback=[*callbacks, *stop], reset_num_timesteps=not done)

    def move(self, make: Callable[[], gym.Env[Any, Any]]) -> None:
        """Go on in other environments, which show what the ones before showed; these are closed."""
        vec_env: VecEnv = make_vec_env(make, n_envs=self._rows)
        before = self.model.get_env()
        if isinstance(before, VecNormalize):
            moments = before.obs_rms, before.ret_rms
            vec_env = VecNormalize(vec_env, gamma=before.gamma)
            vec_env.obs_rms, vec_env.ret_rms = moments
        vec_env.seed(agent_training_seed(self._seed, resumed=1, rows=self._rows))
        self.close()
        self.model.set_env(vec_env)

    def close(self) -> None:
        """Close the environments."""
        env = self.model.get_env()
        assert env is not None
        env.close()


class _Until(BaseCallback):
    """Stops a training once there were so many steps, where an algorithm collects anew, and before the last time."""

    def __init__(self, steps: int, last: int) -> None:
        super().__init__()
        self._steps, self._last = steps, last
        self._begun, self._over = 0, False

    def _on_rollout_start(self) -> None:
        collects = self.num_timesteps - self._begun  # as the time before
        self._begun = self.num_timesteps
        stopping = self.training_env.num_envs  # steps that it takes: a callback can stop nothing but a step
        self._over = self.num_timesteps >= min(self._steps, max(1, self._last - stopping - collects))

    def _on_step(self) -> bool:
        return not self._over


class Bar(BaseCallback):
    """Tells how many steps are done."""

    def __init__(self, report: Callable[[float], object]) -> None:
        super().__init__()
        self._report = report

    def _on_step(self) -> bool:
        self._report(self.num_timesteps)
        return True


class Curve(BaseCallback):
    """Writes the learning curve: steps, CPU seconds and return, at the end of each episode."""

    def __init__(self, path: Path, *, began: float) -> None:
        super().__init__()
        self._path, self._began, self.spent = path, began, 0
        self._rows = list[tuple[int, float, float]]()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:  # of the monitor that make_vec_env puts around
                seconds = round(time.process_time() - self._began, 2)
                self._rows.append((self.num_timesteps + self.spent, seconds, round(float(info["episode"]["r"]), 4)))
        return True

    def _on_training_end(self) -> None:
        with replacing(self._path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("steps", "seconds", "return"))
            writer.writerows(self._rows)


def player_of(
    model: BaseAlgorithm,
    task: HiddenTask,
    information: Shown,
    *,
    observer: str | None = None,
    training: Mapping[str, Any] | None = None,
) -> Player:
    """Take the deterministic policy out of a trained agent."""
    head: Head = "clip"
    if isinstance(model.action_space, spaces.Discrete):
        head = "argmax"
    elif isinstance(model, SAC | TQC | TD3):
        head = "tanh"
    normal = model.get_vec_normalize_env()
    scaling: dict[str, Any] = {}
    if normal is not None:
        moments: Any = normal.obs_rms
        scaling = {"mean": moments.mean.copy(), "scale": np.sqrt(moments.var + normal.epsilon)}
    return Player(
        perceptron(model),
        head,
        task,
        information,
        **scaling,
        observer=observer,
        fingerprint=None if observer is None else fingerprint(observer),
        training=training or {},
    )


__all__ = ["ALGORITHMS", "algorithm_for", "hyperparameters", "learn_to_play", "player_of"]
