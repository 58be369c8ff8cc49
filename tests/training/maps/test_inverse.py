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
    return np.prod([float(torch.linalg.matrix_norm(weight.detach(), 2)) for weight in problem._slopes()])


def test_penalty_lowers_the_bound_of_the_lipschitz_constant():
    free, held = trained(1e-9), trained(3.0)
    assert norms(held) < 0.3 * norms(free)


def test_followed_directions_find_the_layers_norms():
    problem = trained(1e-9)
    for _ in range(100):
        found = problem._log_lipschitz().detach()
    np.testing.assert_allclose(float(found.exp()), norms(problem), rtol=1e-2)
    assert not any(name.startswith("direction") for name in trained(0.0).state_dict())
