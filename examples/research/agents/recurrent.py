"""A linear recurrent unit as a features extractor of stable-baselines3, for any of its algorithms."""

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn


class LinearRecurrence(BaseFeaturesExtractor):
    """The latest frame of a stack, and the state of a linear recurrent unit after all frames of the stack.

    h_k = lambda h_k-1 + (1 - |lambda|^2)^1/2 B x_k with complex lambda inside the unit circle; lambda and B are learned
    (Orvieto et al., arXiv:2303.06349). Because the unit is linear, h is one matrix times the stacked frames.
    """

    ages: torch.Tensor

    def __init__(self, observation_space: Any, frames: int, units: int = 32) -> None:
        self._width = int(np.prod(observation_space.shape)) // frames
        super().__init__(observation_space, self._width + 2 * units)
        decay, turn = torch.rand(units) * 0.49 + 0.5, torch.rand(units) * np.pi / 10
        self.log_rate, self.turn = nn.Parameter(torch.log(-torch.log(decay))), nn.Parameter(turn)
        self.B = nn.Parameter(torch.randn(self._width, units) / self._width**0.5)
        self.register_buffer("ages", torch.arange(frames - 1, -1, -1.0)[:, None])

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Shapes: ``observations`` (n, frames * width); returns (n, width + 2 units)."""
        rate = torch.exp(self.log_rate)
        scale = torch.sqrt(-torch.expm1(-2 * rate))  # keeps h as large as x
        size, angle = scale * torch.exp(-rate * self.ages), self.turn * self.ages
        kernel = torch.stack([size * torch.cos(angle), size * torch.sin(angle)], -1)  # (frames, units, 2)
        weights = torch.einsum("im,kmc->kimc", self.B, kernel).flatten(2).flatten(0, 1)
        return torch.cat([observations[:, -self._width :], observations @ weights], 1)
