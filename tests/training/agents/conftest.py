import pytest
from small_agents import make_small


@pytest.fixture
def small(monkeypatch):
    """Agents in any environment, and their observers, are learned in no time."""
    make_small(monkeypatch)
