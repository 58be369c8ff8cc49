"""What is behind the id ``kkl_gym/Own-v0``: environments of a system that ``gym.make`` is told."""

from typing import Any

from kkl_gym.envs import KKLEnv
from kkl_gym.vector import KKLVectorEnv

OWN_ID = "kkl_gym/Own-v0"


def single(**options: Any) -> KKLEnv:
    """Make the environment of a system of the user's."""
    return KKLEnv(**_named(options))


def vector(**options: Any) -> KKLVectorEnv:
    """Make many environments of a system of the user's, as one batch."""
    return KKLVectorEnv(**_named(options))


def _named(options: dict[str, Any]) -> dict[str, Any]:
    if options.get("system") is None:
        raise ValueError(f'{OWN_ID} is for a system of yours: name it, as in system="script.py:Class"')
    return options
