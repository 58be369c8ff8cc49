"""What the training of T_inv minimises."""

import numpy as np
import torch
from small_runs import CPU, open_loop

from training.maps.inverse import InverseProblem
from training.maps.networks import Network


def trained(penalty):
    """A network after a few steps of gradient descent, and the problem."""
    sampler, _, _ = open_loop()
    torch.manual_seed(0)
    network = Network(len(sampler.coordinates.noise_gain) + 2, 2, width=16, depth=2, activation="tanh")
    problem = InverseProblem(network, sampler, CPU, lipschitz_penalty=penalty)
    optimiser, generator = torch.optim.Adam(network.parameters(), lr=1e-2), torch.Generator().manual_seed(0)
    for _ in range(60):
        optimiser.zero_grad()
        problem.loss(generator)["loss"].backward()
        optimiser.step()
    return problem


def norms(problem):
    """Product of the layers' exact norms."""
    whiten = torch.as_tensor(problem.sampler.coordinates.whiten, dtype=torch.float32)
    first, *others = (layer.weight.detach() for layer in problem.network.linear_layers())
    slopes = [first[:, : len(whiten)] @ whiten, *others]
    return np.prod([float(torch.linalg.matrix_norm(slope, 2)) for slope in slopes])


def test_penalty_lowers_the_bound_of_the_lipschitz_constant_that_it_follows():
    free, held = trained(1e-9), trained(3.0)
    assert norms(held) < 0.3 * norms(free)
    exact, generator = norms(free), torch.Generator().manual_seed(0)
    for _ in range(100):
        found = free.loss(generator)["log_lipschitz"]
    np.testing.assert_allclose(float(found.exp()), exact, rtol=1e-2)
