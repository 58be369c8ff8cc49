"""``kkl-gym train NAME --data FILE...``: an observer from recorded states."""

import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from training.commands.data import DataOptions
from training.progress import LOG, duration, progress_bars
from training.recorded.config import RecordedConfig, recorded_config
from training.recorded.preparing import described

if TYPE_CHECKING:
    import torch

NAME = r"[\w][\w.-]*"  # of an observer, and so of a file


def train_from_data(
    name: str,
    data: DataOptions,
    settings: Mapping[str, Any],
    *,
    out: Path | None,
    resume: bool,
    device: "torch.device | None",
    console: Console,
) -> Path:
    """Learn an observer from recorded states, and write it and its report."""
    from training.recorded.fit import train_recorded
    from training.recorded.report import write_recorded_report

    began = time.monotonic()
    if not re.fullmatch(NAME, name):
        raise ValueError(f"with --data, SYSTEM is a name of your choice, of letters, digits, _, - and .; got {name!r}")
    known = RecordedConfig.__dataclass_fields__
    unknown = [f"--{setting.replace('_', '-')}" for setting in settings if setting not in known]
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: of no use with --data, where nothing is simulated")
    folder = out or Path("runs") / name
    path = folder / f"{name}.safetensors"
    with progress_bars(console, folder / LOG) as progress:
        records = data.read(progress)
        config = recorded_config(records, settings)
        for line in described(records, config, name):
            progress.say(line)
        result = train_recorded(records, config, folder, name=name, resume=resume, device=device, console=progress)
        result.artifact.save(path)  # before anything else may fail
        with progress.phase("drawing the report"):
            write_recorded_report(folder / "report.png", result)
        if result.held_out:
            progress.say(f"rms error over standard deviation on what was held out: {result.errors}")
        size, took = path.stat().st_size / 1e6, duration(time.monotonic() - began)
        progress.say(f"wrote {path} ({size:.2f} MB), report.png and {LOG} beside it, in {took}")
    return path
