"""``kkl-gym export``."""

import shutil

import pytest

from observers import storage
from training.cli import main


def export(kind, *options):
    main(["export", "lorenz-spinn", "--format", kind, "--out", ".", *options])


def test_c(tmp_path, capsys, monkeypatch):
    export("c", "--measurement-noise", "0.3")
    assert {path.name for path in tmp_path.iterdir()} == {"lorenz_spinn.c", "lorenz_spinn.h", "lorenz_spinn_main.c"}
    assert "standard deviation 0.3" in (tmp_path / "lorenz_spinn.h").read_text()
    wrote, size = capsys.readouterr().out.splitlines()
    assert wrote.startswith("wrote lorenz_spinn.h, ")
    assert size.startswith("flash 1" if shutil.which("cc") and shutil.which("size") else "there is no cc")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    export("c")
    assert "there is no cc or no size here" in capsys.readouterr().out


def test_javascript(tmp_path, capsys):
    export("js", "--measurement-noise", "0.3")
    constants, module = tmp_path / "lorenz_spinn_step.safetensors", tmp_path / "kkl_observer.js"
    assert "export class Observer" in module.read_text()
    kilobytes = f"{constants.stat().st_size / 1e3:.0f} kB"
    assert capsys.readouterr().out == f"wrote {constants.name}, {kilobytes}, and {module.name}\n"
    _, described = storage.read(constants, key="kkl_step", error=ValueError, what="a step")
    assert described["measurement_noise"] == [0.3]


def test_onnx(tmp_path, capsys):
    onnx = pytest.importorskip("onnx", reason="needs the extra onnx")
    export("onnx", "--precision", "double")
    (path,) = tmp_path.iterdir()
    assert capsys.readouterr().out == f"wrote {path.name}, {path.stat().st_size / 1e3:.0f} kB\n"
    onnx.checker.check_model(onnx.load(path))
