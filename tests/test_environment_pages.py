"""The pages of the four environments show the boxes, bounds and parameters of the systems."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import kkl_gym

DOCS = Path(__file__).parent.parent / "docs"


@pytest.mark.parametrize("name", kkl_gym.ENV_IDS)
def test_the_page_of_an_environment(name):
    system, text = kkl_gym.get_system(name), (DOCS / "environments" / f"{name}.md").read_text()
    shared = (DOCS / "environments" / "index.md").read_text()
    cells = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", text + shared, re.MULTILINE))

    def of(start):
        (cell,) = (cell for title, cell in cells.items() if title.startswith(start))
        return [float(value) for value in re.findall(r"-?[\d.]+", cell.replace("−", "-"))]

    assert of("training box X") == np.ravel(system.X).tolist()
    assert of("declared bounds") == np.ravel(system.bounds).tolist()
    assert of("target")[-system.nx :] == pytest.approx(system.target, abs=5e-5)
    assert of("scale") == list(system.scale)
    assert of("input u")[-1:] == list(system.u_max)
    assert (of("sampling interval"), of("measurement noise v")) == ([system.dt], [system.measurement_noise])
    assert of("process noise")[0] == system.process_noise
    defaults = dict(re.findall(r"^\| `(\w+)` \| ([\d./]+) \|", text, re.MULTILINE))
    assert {key: eval(value) for key, value in defaults.items()} == system.parameters
    assert f'gym.make("{kkl_gym.ENV_IDS[name]}"' in text

    picture = DOCS / "figures" / f"{name}.gif"
    assert f"../figures/{name}.gif" in text
    assert picture.stat().st_size < 400_000
    with Image.open(picture) as frames:
        assert frames.n_frames > 100
