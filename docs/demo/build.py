"""Build the demo in the browser: ``python docs/demo/build.py OUT`` writes a folder for any file server.

The folder holds the page, and for each system's default map a file that ``kkl_observer.js`` reads.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
from step_file import write_step

import kkl_gym
from training.export.exported import Exported

HERE = Path(__file__).parent
PAGE = ("index.html", "style.css", "main.js", "world.js", "systems.js", "drawing.js", "kkl_observer.js")


def build(out: Path) -> None:
    """Write the whole page to a folder.

    Parameters
    ----------
    out : Path
        The folder, which is created if missing.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in PAGE:
        if (out / name).resolve() != (HERE / name).resolve():  # mkdocs may have copied the page already
            shutil.copyfile(HERE / name, out / name)
    described = []
    for name, cls in kkl_gym.SYSTEMS.items():
        exported, system = Exported.read(name), cls()
        write_step(out / f"{name}_step.safetensors", exported)
        described.append(
            {
                "name": name,
                "parameters": system.parameters,
                "dt": exported.artifact.filter.dt,
                "measured": int(np.argmax(exported.artifact.C)),  # each output is a state
                "portrait": [i % system.nx for i in system.portrait],
                "measurement_noise": system.measurement_noise,
                "measurement_noise_max": exported.artifact.inverse.measurement_noise_max,
                "process_noise": system.process_noise,
                "process_noise_max": exported.artifact.process_noise_max,
                **{key: getattr(system, key) for key in ("X", "bounds", "u_max", "G", "scale", "target")},
            }
        )
    (out / "systems.json").write_text(json.dumps(described), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/demo/build.py OUT")
    build(Path(sys.argv[1]))
