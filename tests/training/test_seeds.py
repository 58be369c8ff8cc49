"""Streams of random numbers."""

from itertools import product

import pytest

from training.agents.seeds import agent_evaluation_seed, agent_training_seed
from training.seeds import Stream, generator


def test_no_two_streams_meet():
    purposes = [(stream, seed, *part) for stream, seed in product(Stream, range(10)) for part in ((), (1,), (2,), (3,))]
    drawn = {generator(*purpose).bytes(16) for purpose in purposes}
    assert len(drawn) == len(purposes) == len(Stream) * 10 * 4
    assert generator(Stream.TUNING, 3).bytes(16) in drawn


@pytest.mark.parametrize("seed", [(-1,), (2**32,), (2**32 + 5,), (0, -1), (0, 2**32)])
def test_seeds_that_would_collide_are_refused(seed):
    """NumPy converts [1, 2**32 + 5] to the words [1, 5, 1], which belong to part 1 of seed 5."""
    with pytest.raises(ValueError, match=rf"seed = {seed[-1]} must be a whole number from 0 to 2\*\*32 - 1"):
        generator(Stream.TRAINING, *seed)


@pytest.mark.parametrize("rows", [1, 16, 256, 9_999])
def test_no_resumed_agent_learns_from_episodes_of_another(rows):
    assert agent_training_seed(3, 0, rows) == agent_training_seed(3) == 40_000
    firsts = [agent_training_seed(3, resumed, rows) for resumed in range(200)]
    assert all(40_000 <= first <= 50_000 - rows for first in firsts)
    if rows == 256:
        assert len(set(firsts)) == 200


def test_no_agent_learns_from_episodes_of_the_evaluation():
    last = agent_training_seed(99_998)
    assert last < agent_evaluation_seed(0, 1)
    with pytest.raises(ValueError, match="99999"):
        agent_training_seed(99_999)
