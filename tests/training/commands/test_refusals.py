"""Options that make no sense are refused by name, before any work is done."""

import pytest

from training.cli import main
from training.jobs import locked
from training.progress import ProgressBars


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("evaluate lorenz --duration inf", "duration must be finite"),
        ("evaluate lorenz --duration 0.001", "at least one sample"),
        ("evaluate lorenz --csv .", "name a file"),
        ("evaluate lorenz --measurement-noise", "at least one level"),
        ("faults lorenz --duration nan", "duration|within which"),
        ("faults lorenz --duration 0.1", "within which it is to be noticed"),
        ("certify lorenz lorenz", "names must differ"),
        ("certify lorenz --measurement-noise inf", "measurement_noise"),
        ("demo --duration nan", "duration must be finite"),
        ("demo --seed -1", "seed must not be negative"),
        ("speed --turns 0", "turns must be positive"),
        ("agent train lorenz --threads 0", "threads must be at least 1"),
        ("agent train lorenz --seed 99999", "seed must lie between 0 and 99998"),
        ("agent train lorenz --information y --observer lorenz", "no use for the observer"),
    ],
)
def test_refused(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=message):
        main(arguments.split())


@pytest.mark.parametrize(
    "arguments",
    [
        "evaluate lorenz --csv file/errors.csv",
        "certify lorenz-static --out file",
        "faults lorenz --out file",
        "demo --out file",
        "tune lorenz --out file/tuned",
        "agent evaluate van_der_pol --out file",
        "errorbars lorenz-static --out file/bars.safetensors",
        "tracking lorenz-static --out file/tracking.safetensors",
        "observability lorenz --out file",
    ],
)
def test_a_place_that_cannot_be_written_to_is_refused_before_long_work(arguments, tmp_path, monkeypatch):
    def work(self, description, **options):
        raise AssertionError(f"{description} has begun")

    (tmp_path / "file").write_text("not a folder")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ProgressBars, "add_task", work)
    with pytest.raises(SystemExit, match=r"file.*: Not a directory"):
        main(arguments.split())


def test_two_agents_do_not_share_a_folder(tmp_path):
    with locked(tmp_path), pytest.raises(SystemExit, match="another process is at work"):
        main(["agent", "train", "lorenz", "--timesteps", "1", "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"quiet": 0.1, "noise_free_share": 0.3}', "two names of one setting"),
        (b"\xff", "c.json is no JSON"),
        (b'{"policy": "evil.py:act"}', "it has .'policy'."),
    ],
)
def test_files_of_settings(content, message, tmp_path):
    (tmp_path / "c.json").write_bytes(content)
    with pytest.raises(SystemExit, match=message):
        main(["train", "lorenz", "--config", str(tmp_path / "c.json"), "--out", str(tmp_path / "run")])
