"""What every batch consists of."""

from typing import NamedTuple

import torch


class Batch(NamedTuple):
    """Samples on which the inverse is fitted.

    Shapes: ``inputs`` (batch, inputs), ``x`` (batch, nx), ``weight`` (batch,), ``cell`` (batch,).
    """

    inputs: torch.Tensor
    x: torch.Tensor
    weight: torch.Tensor
    cell: torch.Tensor
