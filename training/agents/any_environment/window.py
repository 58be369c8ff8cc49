"""Estimates by a network on stacked observations: what an observer's filter is worth is the difference to them."""

import os
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

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


class WindowObservation(gym.ObservationWrapper[np.ndarray, Any, np.ndarray], RecordConstructorArgs):
    """Shows what an estimator says of stacked observations in their place.

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

    Raises
    ------
    ValueError
        If the estimator was made for stacks, or for signals, of another number.
    """

    def __init__(
        self, env: gym.Env[np.ndarray, Any], estimator: WindowEstimator, space: gym.spaces.Box, outputs: int
    ) -> None:
        RecordConstructorArgs.__init__(self, estimator=estimator, space=space, outputs=outputs)
        gym.ObservationWrapper.__init__(self, env)
        self.observation_space, self._low, self._high = space, space.low, space.high
        stacked = gym.spaces.flatdim(env.observation_space)
        latest = stacked - stacked // estimator.frames
        self._outputs = slice(latest, latest + outputs)
        self._wanted = stacked, gym.spaces.flatdim(space) - outputs
        self.replace_estimator(estimator)

    def replace_estimator(self, estimator: WindowEstimator) -> None:
        """Go on with another estimator of the same signals from as many observations; raises ValueError otherwise."""
        network, (inputs, outputs) = estimator.network, self._wanted
        if (network.inputs, network.outputs) != self._wanted:
            raise ValueError(
                f"the estimator makes {network.outputs} numbers of {network.inputs}, and {outputs} of {inputs} are "
                "needed: it was made for another task"
            )
        self._network = network

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """What is shown of a stack."""
        shown = np.concatenate([observation[self._outputs], self._network(observation)])
        return np.clip(shown, self._low, self._high, dtype=np.float32)


__all__ = ["WindowEstimator", "WindowObservation"]
