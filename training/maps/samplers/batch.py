"""What every batch consists of."""

from typing import NamedTuple

import torch


class Batch(NamedTuple):
    """Samples on which the inverse is fitted.

    Parameters
    ----------
    inputs : Tensor, shape (batch, inputs)
        What the network sees.
    x : Tensor, shape (batch, nx)
        Scaled states, which it is to give.
    weight : Tensor, shape (batch,)
        Of each sample in the loss.
    cell : Tensor of int, shape (batch,)
        Number of the cell of like samples that each belongs to.
    """

    inputs: torch.Tensor
    x: torch.Tensor
    weight: torch.Tensor
    cell: torch.Tensor
