"""RLlib, which pins Gymnasium: `make clients` runs this test in an environment of its own."""

import runpy
from importlib.metadata import version
from pathlib import Path

import pytest

pytestmark = pytest.mark.clients
EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "rllib_agent.py"


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_rllib(algorithm, row):
    pytest.importorskip("ray.rllib")
    row("RLlib", version("ray"), f"examples/rllib_agent.py --algorithm {algorithm}, two env runners of 4 rows", 4000)
    steps, reward = runpy.run_path(str(EXAMPLE))["main"](algorithm, steps=4000, num_envs=4)
    assert steps >= 4000
    assert 0 < reward <= 400 * 5
