import numpy as np
import torch

from training.maps.networks import Network, averaged


def test_the_mean_of_networks_is_a_network():
    torch.manual_seed(0)
    networks = [Network(3, 2, width=5, depth=2, activation="tanh").export() for _ in range(3)]
    inputs = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    expected = np.mean([network(inputs) for network in networks], 0)
    np.testing.assert_allclose(averaged(networks)(inputs), expected, rtol=1e-4, atol=1e-6)
