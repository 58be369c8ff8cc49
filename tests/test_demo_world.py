"""The demo's world without a browser, in Node.js."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

DEMO = Path(__file__).parents[1] / "docs" / "demo"
pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="there is no Node.js, node")
LONG_RUN = """
import { World } from "./world.js";
const system = {
  measurement_noise: 0, process_noise: 0, measured: 0, dt: 0.01, seconds: 50, scale: [1], range: [[-1, 1]], u_max: [1],
  start: () => [0.5], advance: ([x]) => [0.999 * x], inside: () => true,
};
const world = new World(system, { tell() {}, reset() {}, step() {}, covariance: null }, 1);
for (let k = 0; k < 10000; k++) world.step();
process.stdout.write(JSON.stringify([world.start, world.history[0].x]));
"""


def test_a_start_is_remembered_for_longer_than_the_motion(tmp_path):
    """The button Restart begins there again."""
    for name in ("world.js", "systems.js"):
        shutil.copy(DEMO / name, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "run.js").write_text(LONG_RUN)
    found = subprocess.run(["node", tmp_path / "run.js"], capture_output=True, text=True, check=True)
    start, oldest = json.loads(found.stdout)
    assert start == [0.5]
    assert oldest != start
    assert "restarted(world.start)" in (DEMO / "main.js").read_text(encoding="utf-8")
