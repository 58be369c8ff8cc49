import pytest
from small_agents import make_small


@pytest.fixture
def small(monkeypatch):
    """Tiny settings for agents in any environment and for their observers."""
    make_small(monkeypatch)
