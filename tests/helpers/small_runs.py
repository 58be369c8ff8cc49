"""Configurations and data of small sizes."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from kkl_gym import VanDerPol
from observers import Artifact, LinearFilter
from training import preset
from training.config import Config
from training.maps.inverse import TrajectorySampler
from training.maps.networks import Network
from training.spectrum import papers_spectrum
from training.trajectories.motions import KINDS, Motions, recording_ages

CPU = torch.device("cpu")
SIZES = {
    "trajectories": 20,
    "duration": 5.0,
    "samples": 40,
    "width": 16,
    "depth": 2,
    "batch": 128,
    "flow_steps": 300,
    "runs": 100,
}


def toy(system, pipeline="input-aware", **changes):
    """A configuration that trains within a second."""
    steps = {"inverse_steps": 200}
    if pipeline == "spinn":  # modes whose transient decays within the 20 s of such runs
        steps |= {"forward_steps": 200, "eigenvalues": papers_spectrum(system)}
    return replace(preset(system, pipeline, "fast"), **SIZES | steps | changes)


BATCHES = Config("input-aware", (-1.0,), measurement_noise_max=1.0, batch=4096)


@cache
def open_loop(process_noise_share=0.0):
    """Batches along trajectories of Van der Pol's oscillator, the trajectories, and the filter."""
    linear = LinearFilter(np.diag([-0.5, -2.0, -8.0]), np.ones((3, 1)), 0.01, 1)
    motions = Motions(VanDerPol(), 0.01, 500, KINDS, process_noise_share=process_noise_share)
    ages, rng = recording_ages(500, 40), np.random.default_rng(0)
    data = motions.beside(linear, ages, 50, rng)
    sampler = TrajectorySampler(
        data,
        linear,
        BATCHES,
        device=CPU,
        process_noise_max=VanDerPol().process_noise if process_noise_share else 0.0,
    )
    return sampler, data, linear


def untrained(sampler, linear):
    """A network with random weights, and an observer with this network."""
    torch.manual_seed(0)
    inputs = sampler(torch.Generator()).inputs.shape[1]
    network = Network(inputs, 2, width=8, depth=1, activation="tanh")
    return network, Artifact(linear, sampler.inverse_map(network.export()), "van_der_pol", {"mu": 3.0})
