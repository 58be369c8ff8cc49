"""Bad values where values come in: a clear error that changes nothing, or what the plain value would have done."""

import random
import re
import warnings
from collections import Counter

import numpy as np
import pytest
from entry_points import AREAS, ENTRIES

LONGEST = 1000  # characters of a clear error
REFUSED, RIGHT, OBSCURE, SILENT = OUTCOMES = ("clear error", "accepted and right", "obscure", "silent")


def same(one, other):
    """Whether two results are equal, bit for bit."""
    if isinstance(one, np.ndarray) and one.dtype != object:
        return one.dtype == other.dtype and one.shape == other.shape and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(value, other[key]) for key, value in one.items())
    if isinstance(one, list | tuple | np.ndarray):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


def finite(result):
    """Whether a result holds no NaN and no infinity."""
    if isinstance(result, dict):
        return finite(list(result.values()))
    if isinstance(result, list | tuple) or (isinstance(result, np.ndarray) and result.dtype == object):
        return all(map(finite, result))
    return not isinstance(result, float | np.ndarray) or bool(np.isfinite(result).all())


def quietly(function, *arguments, warning="error"):
    with warnings.catch_warnings():
        warnings.simplefilter(warning)
        return function(*arguments)


class Pair:
    """Two targets of an entry with the same past; one of them is tried with bad values."""

    def __init__(self, entry):
        self.entry, self.tried, self.other = entry, entry.make(), entry.make()

    def outcome(self, made):
        """Try the value that ``made()`` makes, twice as some are used up; returns one of OUTCOMES and what happened."""
        entry = self.entry
        try:
            right, clean = quietly(entry.means, made())
        except Exception:  # so strange that it cannot be right
            right = False
        try:
            result = quietly(entry.call, self.tried, made())
        except Exception as error:
            return self.judged(error)
        if not right:
            return SILENT, f"accepted: {str(result)[:200]}"
        if not same(result, entry.call(self.other, clean)):
            return SILENT, f"accepted, and is not the same as {clean!r}"
        if not (finite(result) and self.agree()):
            return SILENT, f"accepted, and led astray: {str(result)[:200]}"
        return RIGHT, ""

    def judged(self, error):
        text = f"{type(error).__name__}: {error}"
        if not self.agree():
            return SILENT, f"changed the state before {text}"
        named = re.search(rf"\b({self.entry.says})\b", str(error))
        return REFUSED if isinstance(error, ValueError) and named and len(text) <= LONGEST else OBSCURE, text

    def agree(self):
        return same(self.entry.later(self.tried), self.entry.later(self.other))


def value_of(entry, seed):
    """The value that a seed makes for an entry."""
    rng = random.Random(seed)
    while True:
        try:
            return quietly(entry.values, entry.good, rng, warning="ignore")
        except Exception:  # there is no such value
            continue


def campaign(area, cases):
    """Try that many values on the entries of an area in turn; returns counts by outcome, and what went wrong."""
    entries = [entry for entry in ENTRIES if entry.area == area]
    pairs, counts, wrong = {}, Counter(), []
    for seed in range(cases):
        entry = entries[seed % len(entries)]
        pair = pairs.get(entry.name) or Pair(entry)
        outcome, what = pair.outcome(lambda entry=entry, seed=seed: value_of(entry, seed))
        counts[outcome] += 1
        pairs[entry.name] = pair
        if outcome in (OBSCURE, SILENT):
            del pairs[entry.name]  # the two may differ now
            wrong.append(f"value_of({entry.name}, {seed}): {outcome}: {what}")
    return counts, wrong


@pytest.mark.parametrize("cases", [200, pytest.param(10_000, marks=pytest.mark.long)])
@pytest.mark.parametrize("area", AREAS)
def test_bad_values_are_refused_or_as_good_as_plain_ones(area, cases):
    counts, wrong = campaign(area, cases)
    print(f"\n{area}: {', '.join(f'{outcome} {counts[outcome]}' for outcome in OUTCOMES)}")
    assert not wrong, "\n".join(wrong)
    assert counts[REFUSED] > counts[RIGHT] > 0
