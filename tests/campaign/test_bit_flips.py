"""Single bits flipped at random places of files that ship: all are noticed."""

import numpy as np
import pytest

from observers import Artifact, ArtifactError, shipped
from observers.names import resolve
from training.agents.agent import Agent, AgentError
from training.commands.agent import find
from training.systems import PROFILES

FILES = [(resolve(name), Artifact, ArtifactError) for name in shipped()]
FILES += [(find(name), Agent, AgentError) for name in PROFILES]


@pytest.mark.parametrize("n", [100, pytest.param(2000, marks=pytest.mark.long)])
def test_flipped_bits(n, tmp_path):
    rng, copy, noticed = np.random.default_rng(n), tmp_path / "copy.safetensors", 0
    for i in range(n):
        file, kind, error = FILES[i % len(FILES)]
        content = bytearray(file.read_bytes())
        place = int(rng.integers(8 * len(content)))
        content[place // 8] ^= 1 << place % 8
        copy.write_bytes(content)
        try:
            kind.read(copy)
        except error as said:
            noticed += str(copy) in str(said)
    print(f"\n{n} bits flipped in {len(FILES)} files: {noticed} noticed")
    assert noticed == n


@pytest.mark.parametrize("n", [20, pytest.param(500, marks=pytest.mark.long)])
def test_zeroed_sectors(n, tmp_path):
    """What a disk that fails leaves of 512 bytes."""
    rng, copy, noticed, zeroed = np.random.default_rng(n), tmp_path / "copy.safetensors", 0, 0
    for i in range(n):
        file, kind, error = FILES[i % len(FILES)]
        content = bytearray(file.read_bytes())
        start = 512 * int(rng.integers(len(content) // 512))
        if not any(content[start : start + 512]):
            continue
        content[start : start + 512] = bytes(512)
        copy.write_bytes(content)
        zeroed += 1
        try:
            kind.read(copy)
        except error as said:
            noticed += str(copy) in str(said)
    print(f"\n{zeroed} sectors zeroed in {len(FILES)} files: {noticed} noticed")
    assert noticed == zeroed > 0.9 * n
