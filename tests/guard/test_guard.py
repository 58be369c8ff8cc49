import guard
import pytest


@pytest.mark.parametrize("part", [*guard.QUICK, *(pytest.param(part, marks=pytest.mark.slow) for part in guard.SLOW)])
def test_nothing_changed(part):
    differences = guard.differences(part)
    assert not differences, "\n".join(differences)
