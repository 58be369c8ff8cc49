"""Checkpoints: damaged files raise errors, and no code in them runs."""

import pickle
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from training import run

STATE = {
    "module": {"weight": torch.arange(600.0).reshape(20, 30), "bias": torch.ones(20, dtype=torch.float64)},
    "step": 7,
    "history": [(100, 0.5), (200, 0.25)],
}


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "inverse.checkpoint.pt"
    run.save_checkpoint(found, STATE, fingerprint="mine")
    return found


def same(found):
    return (
        found.keys() == STATE.keys()
        and all(torch.equal(found["module"][name], tensor) for name, tensor in STATE["module"].items())
        and (found["step"], [tuple(pair) for pair in found["history"]]) == (STATE["step"], STATE["history"])
    )


def test_round_trip_of_checkpoints(path):
    assert same(run.load_checkpoint(path, fingerprint="mine"))
    assert same(run.load_checkpoint(path))
    with pytest.raises(ValueError, match="belongs to another configuration"):
        run.load_checkpoint(path, fingerprint="other")


def damaged(path):
    """Expect an error with a message of one line that names the file."""
    return pytest.raises(ValueError, match=rf"\Athe checkpoint {re.escape(str(path))} is damaged or of another.*: .+\Z")


def test_a_flipped_bit_is_noticed_or_changes_nothing(path):
    """The zip format has checksums of its parts; bytes between the parts have no meaning."""
    whole, rng, messages = path.read_bytes(), np.random.default_rng(0), []
    with zipfile.ZipFile(path) as file:
        (weights,) = (part for part in file.infolist() if part.file_size == 2400)
    begin = whole.index(np.arange(600.0, dtype=np.float32).tobytes())
    places = [*rng.integers(8 * len(whole), size=300), *rng.integers(8 * begin, 8 * (begin + weights.file_size), 100)]
    for i, place in enumerate(places):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            assert same(run.load_checkpoint(path, fingerprint="mine"))
            assert i < 300
        except ValueError as error:
            messages.append(str(error))
    assert len(messages) > 200
    assert all(str(path) in message and "\n" not in message for message in messages)


def test_truncated_and_empty_files(path):
    whole = path.read_bytes()
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with damaged(path):
            run.load_checkpoint(path)


class Evil:
    def __reduce__(self):
        return Path.touch, (Path("ran"),)


def test_nothing_in_a_checkpoint_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"fingerprint": "mine", "module": Evil()}, path)
    with damaged(path):
        run.load_checkpoint(path)
    path.write_bytes(pickle.dumps(Evil()))
    with damaged(path):
        run.load_checkpoint(path)
    assert not Path("ran").exists()


def test_states_that_do_not_fit(path):
    with damaged(path), run.restoring(path):
        raise RuntimeError("size mismatch\n\tof weights")
