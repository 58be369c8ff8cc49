"""Estimates by a network on stacked observations: what an observer's filter is worth is the difference to them."""

import os
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformObservation

from observers import MLP, storage
from observers.checks import integer

FORMAT = 1
KEY = "kkl-gym-window"


@dataclass(frozen=True)
class WindowEstimator:
    """A network from the last outputs, each with the input before it, to hidden signals.

    Parameters
    ----------
    network : MLP
        From a stack, the latest last, to the signals.
    frames : int
        How many outputs are in a stack.

    Raises
    ------
    ValueError
        If the network cannot take as many.
    """

    network: MLP
    frames: int

    def __post_init__(self) -> None:
        if self.network.inputs % integer("frames", self.frames, 1):
            raise ValueError(f"a network of {self.network.inputs} inputs cannot take {self.frames} outputs")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to one safetensors file, whole or not at all.

        Parameters
        ----------
        path : str or PathLike
            The file, whose name should end in ``.safetensors``; its folder is made.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        tensors: dict[str, np.ndarray] = {}
        storage.put_mlp(tensors, "", self.network)
        described = {"format": FORMAT, "activation": self.network.activation, "frames": self.frames}
        storage.save(path, tensors, key=KEY, described=described)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "WindowEstimator":
        """Read what :meth:`save` wrote.

        Parameters
        ----------
        path : str or PathLike
            The file.

        Returns
        -------
        WindowEstimator
            What it holds.

        Raises
        ------
        ValueError
            If the file is missing, not readable, damaged, foreign or of a newer format.
        """
        tensors, described = storage.read(path, key=KEY, error=ValueError, what="an estimator on stacked observations")
        with storage.explained(path, ValueError):
            if described["format"] != FORMAT:
                raise ValueError(f"it has another format than {FORMAT}, which this version of kkl-gym reads")
            return cls(storage.get_mlp(tensors, "", described["activation"]), described["frames"])


def estimating(
    env: gym.Env[np.ndarray, Any], estimator: WindowEstimator, space: gym.spaces.Box, outputs: int
) -> gym.Env[np.ndarray, Any]:
    """Show what an estimator says of stacked observations in their place.

    Parameters
    ----------
    env : gymnasium.Env
        Whose observations are stacks.
    estimator : WindowEstimator
        What estimates.
    space : gymnasium.spaces.Box
        Of what is to be shown; it is cut at these bounds.
    outputs : int
        How many of it are outputs, the first of the latest in the stack. The others are estimates.

    Returns
    -------
    gymnasium.Env
        The environment.

    Raises
    ------
    ValueError
        If the estimator was made for stacks, or for signals, of another number.
    """
    network, stacked = estimator.network, gym.spaces.flatdim(env.observation_space)
    wanted = stacked, gym.spaces.flatdim(space) - outputs
    if (network.inputs, network.outputs) != wanted:
        raise ValueError(
            f"the estimator makes {network.outputs} numbers of {network.inputs}, and {wanted[1]} of {wanted[0]} are "
            "needed: it was made for another task"
        )
    latest = stacked - stacked // estimator.frames
    shown = slice(latest, latest + outputs)
    return TransformObservation(env, partial(_estimated, network, shown, space.low, space.high), space)


def _estimated(network: MLP, shown: slice, low: np.ndarray, high: np.ndarray, stack: np.ndarray) -> np.ndarray:
    return np.clip(np.concatenate([stack[shown], network(stack)]), low, high, dtype=np.float32)


__all__ = ["WindowEstimator", "estimating"]
