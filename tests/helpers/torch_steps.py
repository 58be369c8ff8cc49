"""Observers as modules of Torch, along records."""

import numpy as np
import torch

from training import TorchObserver

DTYPES = {"float": torch.float32, "double": torch.float64}


def module_of(exported):
    levels = exported.measurement_noise, exported.process_noise
    dtype = DTYPES[exported.precision]
    return TorchObserver(exported.artifact, levels[0], process_noise=levels[1], dtype=dtype)


def along(module, y, u, **levels):
    """Estimates along a record of several rows."""
    levels = {name: torch.tensor(values, dtype=torch.float64) for name, values in levels.items()}
    with torch.no_grad():
        state, x_hat = module.start(y.shape[1]), []
        for k in range(len(y)):
            state, found = module(state, torch.tensor(y[k]), torch.tensor(u[k - 1]), **levels)
            x_hat.append(found.numpy())
    return np.array(x_hat)
