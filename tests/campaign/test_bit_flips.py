"""Single bits flipped, and sectors zeroed, at random places of files that ship: all are noticed."""

import numpy as np
import pytest

from observers import Artifact, ArtifactError, shipped
from observers.names import resolve
from training.agents.agent import Agent, AgentError, find
from training.agents.tasks import TASKS

FILES = [(resolve(name), Artifact, ArtifactError) for name in shipped()]
FILES += [(find(name), Agent, AgentError) for name in TASKS]


def flip(content, rng):
    place = int(rng.integers(8 * len(content)))
    content[place // 8] ^= 1 << place % 8


def zero(content, rng):
    """What a disk that fails leaves of 512 bytes, of which some are no zeros."""
    start = 512 * int(rng.integers(len(content) // 512))
    while not any(content[start : start + 512]):
        start = 512 * int(rng.integers(len(content) // 512))
    content[start : start + 512] = bytes(512)


@pytest.mark.parametrize("times", [1, pytest.param(20, marks=pytest.mark.long)])
@pytest.mark.parametrize("damage", [flip, zero])
def test_damage_is_noticed(damage, times, tmp_path):
    n = 100 * times if damage is flip else 25 * times
    rng, copy, noticed = np.random.default_rng(n), tmp_path / "copy.safetensors", 0
    for i in range(n):
        file, kind, error = FILES[i % len(FILES)]
        content = bytearray(file.read_bytes())
        damage(content, rng)
        copy.write_bytes(content)
        try:
            kind.read(copy)
        except error as said:
            noticed += str(copy) in str(said)
    print(f"\n{damage.__name__}: {noticed} of {n} noticed, in {len(FILES)} files")
    assert noticed == n
