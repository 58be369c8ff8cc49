"""The memory as a PyTorch module, against the wrapper."""

import numpy as np
import pytest
import torch

from kkl_gym.memory import Memory
from training import TorchMemory

CONSTANTS = {"time_constants": (1.0, 2.5, 8.0), "input_time_constants": (1.0, 4.0)}


@pytest.mark.parametrize("angles", [[], [(2, 0)]])
def test_features_equal_those_of_the_wrapper(angles):
    rng, n, again = np.random.default_rng(0), 3, np.array([True, False, False])
    memory = Memory(4, 2, angles, **CONSTANTS)
    module = TorchMemory(4, 2, angles=angles, **CONSTANTS)
    state, y = module.start(n), rng.normal(size=(n, 4))
    for k in range(250):
        y, u = y + 0.3 * rng.normal(size=(n, 4)), rng.normal(size=(n, 2))
        if k == 50:
            y[1] = 0.0  # cosine and sine of zero give no angle
        expected = memory.advance(y, u) if k else memory.reset(y)
        if k == 120:
            state = state * ~torch.tensor(again)[:, None]
            memory.restart(y[again], again)
            expected = memory.shown()
        state, shown = module(state, torch.tensor(y), torch.tensor(u))
        np.testing.assert_allclose(shown, expected, rtol=1e-5, atol=1e-6)


def test_a_row_of_nan_can_begin_again():
    module, y = TorchMemory(1, 1), torch.ones(1, 1)
    fresh, shown = module(module.start(1), y)
    state, _ = module(fresh, y * torch.nan)
    torch.testing.assert_close(module(state * torch.zeros(1, 1, dtype=torch.bool), y)[1], shown)


def test_gradients_are_those_of_finite_differences():
    module = TorchMemory(3, 1, angles=[(0, 1)])
    y = torch.randn(4, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)

    def shown(y, u):
        state, found = module.start(2), []
        for k in range(len(y)):
            state, row = module(state, y[k], u[k])
            found.append(row)
        return torch.stack(found)

    assert torch.autograd.gradcheck(shown, (y, torch.ones(4, 2, 1, dtype=torch.float64, requires_grad=True)))


def test_angles_that_are_no_outputs_are_refused():
    for angles in ([(0, 3)], [(1, 1)], [(0, 1), (1, 2)], [(0, 0.5)], (0, 1), 3, 0.5):
        with pytest.raises(ValueError, match="angles must be pairs of different outputs, from 0 to 2"):
            TorchMemory(3, 1, angles=angles)
