"""Gymnasium environments with hidden states, and learned KKL observers that estimate them."""

import gymnasium as gym

from kkl_gym.envs import KKLEnv
from kkl_gym.equation_errors import EquationError
from kkl_gym.sensor import Sensor
from kkl_gym.system import System
from kkl_gym.systems import SYSTEMS, Lorenz, ReverseDuffing, Rossler, VanDerPol, get_system
from kkl_gym.vector import KKLVectorEnv
from kkl_gym.wrappers.memory import KKLMemory, KKLVectorMemory
from kkl_gym.wrappers.single import ActionRepeat, KKLObservation
from kkl_gym.wrappers.vector import KKLVectorObservation, VectorActionRepeat

__version__ = "0.1.0"

# The id for a user's own system, which is passed as the argument ``system``.
OWN_ID = "kkl_gym/Own-v0"
ENV_IDS = {cls.name: f"KKL{cls.__name__}-v0" for cls in SYSTEMS.values()}

# Each threshold is about nine tenths of the return that the system's shipped agent reaches on the estimate x_hat.
# Under zero action, episodes return on average 2,000 to 2,700, depending on the system.
_REWARD_THRESHOLDS = {"reverse_duffing": 4100.0, "van_der_pol": 3900.0, "rossler": 4300.0, "lorenz": 4400.0}

# Registered ids are left alone, so that importlib.reload may run this module again.
for _name, _id in [*ENV_IDS.items(), (None, OWN_ID)]:
    if _id not in gym.registry:
        gym.register(
            _id,
            entry_point="kkl_gym.envs:KKLEnv",
            vector_entry_point="kkl_gym.vector:KKLVectorEnv",
            kwargs={} if _name is None else {"system": _name},
            reward_threshold=_REWARD_THRESHOLDS.get(_name or ""),
            max_episode_steps=5000,
        )

__all__ = [
    "ENV_IDS",
    "OWN_ID",
    "SYSTEMS",
    "ActionRepeat",
    "EquationError",
    "KKLEnv",
    "KKLMemory",
    "KKLObservation",
    "KKLVectorEnv",
    "KKLVectorMemory",
    "KKLVectorObservation",
    "Lorenz",
    "ReverseDuffing",
    "Rossler",
    "Sensor",
    "System",
    "VanDerPol",
    "VectorActionRepeat",
    "get_system",
]
