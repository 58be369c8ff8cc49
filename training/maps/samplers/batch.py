"""What every batch consists of."""

from typing import NamedTuple

import torch


class Batch(NamedTuple):
    """Samples on which the inverse is fitted, with the weight and the cell of each."""

    inputs: torch.Tensor
    x: torch.Tensor
    weight: torch.Tensor
    cell: torch.Tensor
