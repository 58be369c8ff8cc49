"""The identity of an environment: its id, its arguments and its sampling interval."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import gymnasium as gym

from kkl_gym.sensor import Sensor
from observers import Artifact, ArtifactError
from observers.checks import is_finite, shown

# Arguments that do not change the plant; the last three belong to vector environments.
APPEARANCE = ("render_mode", "max_episode_steps", "num_envs", "vectorization_mode", "autoreset_mode")
Env = gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]


def source_of(env: Any) -> str:
    """Return an environment's name for messages: its id, or else its class."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def check_autoreset(env: Any) -> None:
    """Raise ValueError for an Autoreset wrapper, whose step may start an episode; Async vectors are not searched."""
    base = env.unwrapped
    for one in base.envs if isinstance(base, gym.vector.SyncVectorEnv) else [env]:
        while isinstance(one, gym.Wrapper):
            if isinstance(one, gym.wrappers.Autoreset):
                raise ValueError("the wrapper Autoreset hides where episodes begin: remove it, or make it outermost")
            one = one.env


def identity(env: Env) -> dict[str, Any]:
    """Return an environment's id and arguments; ValueError if a vector environment's members differ in them."""
    base: Any = env.unwrapped
    specs = base.get_attr("spec") if _of_rows(base) else [env.spec]
    found = [_identity(spec, env) for spec in specs]
    for other in found[1:]:
        if other != found[0]:
            raise ValueError(f"the environments differ, {found[0]} and {other}: one observer cannot serve all")
    return found[0]


def _identity(spec: Any, env: Env) -> dict[str, Any]:
    if spec is None:
        raise ValueError(
            f"{shown(env)} has no specification, by which environments are identified: register it, and make it by "
            "gym.make(ID)"
        )
    kwargs = {name: value for name, value in spec.kwargs.items() if name not in APPEARANCE}
    if isinstance(sensor := kwargs.get("sensor"), Sensor):
        kwargs["sensor"] = asdict(sensor)
    try:
        return {"id": spec.id, "kwargs": json.loads(json.dumps(kwargs))}
    except TypeError as error:
        raise ValueError(
            f"the arguments of {spec.id} identify it, but a file cannot hold them ({error}): {shown(kwargs)}"
        ) from None


def sampling_interval(env: Env) -> float:
    """Return the seconds between samples of an environment: its attribute ``dt``, or 1 without a valid one."""
    base: Any = env.unwrapped
    if _of_rows(base):
        dt = base.get_attr("dt")[0] if all(base.call("has_wrapper_attr", "dt")) else None
    else:
        dt = getattr(base, "dt", None)
    return float(dt) if dt is not None and is_finite(dt) and dt > 0 else 1.0


def _of_rows(base: Any) -> bool:
    """Whether an environment is a Sync or Async vector, whose environments can be called one by one."""
    return isinstance(base, gym.vector.SyncVectorEnv | gym.vector.AsyncVectorEnv)


def check_identity(artifact: Artifact, env: Env) -> None:
    """Raise ArtifactError unless an observer was made for this environment."""
    made: Mapping[str, Any] = artifact.environment or {}
    found = identity(env)

    def differ(what: str, there: Any, here: Any) -> None:
        raise ArtifactError(
            f"the observer {artifact.system!r} was made for {what} {shown(there)}, but this is {shown(here)}; "
            f"{how_to_make_one(found['id'])}"
        )

    if made["id"] != found["id"]:
        differ("the environment", made["id"], found["id"])
    if made["kwargs"] != found["kwargs"]:
        differ(f"{made['id']} with arguments", made["kwargs"], found["kwargs"])
    dt = sampling_interval(env)
    if not math.isclose(artifact.filter.dt, dt, rel_tol=1e-6):
        differ("the sampling interval", artifact.filter.dt, dt)


def how_to_make_one(name: str) -> str:
    """Return a text for messages: the commands that make an observer for an environment."""
    return (
        f"an observer is learned by `kkl-gym record {name} --measured ... --hidden ...` and `kkl-gym train NAME --data "
        "minari:DATASET`; kkl_gym.KKLMemory needs no observer"
    )
