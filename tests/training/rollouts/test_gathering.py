"""Pieces of episodes for refits."""

import numpy as np
import pytest
from rollout_observers import observer_of

from observers import Artifact
from training.records import Record, Signals
from training.rollouts.callback import LONGEST, Gathering


def sample(k):
    return {"y": np.array([float(k)]), "u": np.array([0.1 * k]), "x": np.array([-float(k)]), "sample": k}


def test_episodes_are_cut_and_the_oldest_are_dropped(spy):
    gathering = Gathering(Artifact.read(spy), keep=2 * LONGEST, held_out=0.0)
    gathering.begin(0, {"y": np.zeros(1)})
    for k in range(1, 3 * LONGEST + 3):
        gathering.add(0, sample(k))
    records, held_out = gathering.records()
    assert (gathering.steps, held_out) == (3 * LONGEST + 2, [])
    assert [len(record.t) - 1 for record in records] == [LONGEST, 2]  # a third piece would exceed the limit
    assert records[0].y[0, 0] == 2 * LONGEST  # a piece begins with the last sample of the one before
    assert records[1].y[0, 0] == 3 * LONGEST == records[0].y[-1, 0]
    np.testing.assert_allclose(records[0].u[:-1, 0], 0.1 * records[0].y[1:, 0])
    gathering.add(0, sample(3 * LONGEST + 3))
    assert len(gathering.records()[0][-1].t) == 4


def test_an_unfinished_episode_is_not_dropped(spy):
    gathering = Gathering(Artifact.read(spy), keep=10, held_out=0.0)
    for row, steps in ((0, 5), (1, 10)):
        gathering.begin(row, sample(0))
        for k in range(1, steps + 1):
            gathering.add(row, sample(k))
    gathering.records()
    gathering.add(0, sample(6))
    assert [len(record.t) for record in gathering.records()[0]] == [7, 11]
    gathering.begin(0, {})
    gathering.add(0, sample(200))  # the first sample of a learning that begins within an episode
    gathering.begin(0, sample(0))  # the episode ends without a step
    gathering.add(0, sample(1))


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_pieces_have_their_role_for_good(spy, share):
    gathering = Gathering(Artifact.read(spy), keep=10_000, held_out=share)
    roles = {}
    for episode in range(20):
        gathering.begin(0, sample(0))
        gathering.add(0, sample(1))
        gathering.add(0, sample(2))
        for held, records in enumerate(gathering.records()):
            for record in records:
                assert roles.setdefault(record.name, held) == held
        assert len(roles) == episode + 1
    assert sum(roles.values()) == 20 * share
    assert roles["Spy-v0, piece 1"] == 1


def test_earlier_records_are_converted_for_the_observer(spy):
    artifact, count = Artifact.read(spy), np.arange(400.0)
    signals = Signals("seconds", ("obs[0]",), ("action[0]",), ("obs[1]",))
    column = count[:, None]
    before = Record("slow", 2.0 * count, column, 0 * column, column, signals, environment=artifact.environment)
    train, held_out = Gathering(artifact, keep=10**6, held_out=0.5, before=[before]).records()
    assert not held_out
    assert [len(piece.t) for piece in train] == [LONGEST + 1, LONGEST + 1, LONGEST + 1, 799 - 3 * LONGEST]
    np.testing.assert_allclose(np.concatenate([piece.y[:-1, 0] for piece in train]), np.arange(0, 399, 0.5))
    without = observer_of("Spy-v0", ["obs[0]"], ["obs[1]"], [])
    (piece, *_), _ = Gathering(without, keep=10**6, held_out=0.5, before=[before]).records()
    assert (piece.u, piece.signals.inputs) == (None, ())
