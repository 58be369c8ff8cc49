"""``kkl-gym export``."""

import pytest

from training.cli import main


def export(kind, *options):
    main(["export", "lorenz-spinn", "--format", kind, "--out", ".", *options])


def test_c(tmp_path, capsys):
    export("c", "--measurement-noise", "0.3")
    assert {path.name for path in tmp_path.iterdir()} == {"lorenz_spinn.c", "lorenz_spinn.h", "lorenz_spinn_main.c"}
    assert "standard deviation 0.3" in (tmp_path / "lorenz_spinn.h").read_text()
    assert capsys.readouterr().out.startswith("wrote lorenz_spinn.h (")


def test_onnx(tmp_path, capsys):
    onnx = pytest.importorskip("onnx", reason="needs the extra onnx")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    export("onnx", "--precision", "double")
    (path,) = tmp_path.iterdir()
    assert capsys.readouterr().out == f"wrote {path.name} ({path.stat().st_size / 1e3:.0f} kB)\n"
    onnx.checker.check_model(onnx.load(path))
