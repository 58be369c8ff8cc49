"""``kkl-gym export``."""

import shutil

import pytest

from observers import storage
from training.cli import main


def test_c(tmp_path, capsys):
    main(["export", "lorenz-spinn", "--format", "c", "--measurement-noise", "0.3", "--out", str(tmp_path / "made")])
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == [
        "lorenz_spinn.c", "lorenz_spinn.h", "lorenz_spinn_main.c"
    ]  # fmt: skip
    assert "#define LORENZ_SPINN_MEASUREMENT_NOISE 0.3\n" in (tmp_path / "made" / "lorenz_spinn.c").read_text()
    wrote, size = capsys.readouterr().out.splitlines()
    assert wrote.startswith(f"wrote {tmp_path / 'made' / 'lorenz_spinn.h'}, ")
    assert size.startswith("flash 1" if shutil.which("cc") and shutil.which("size") else "there is no cc")


def test_without_a_compiler(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    main(["export", "lorenz-spinn", "--format", "c", "--out", str(tmp_path)])
    assert "there is no cc or no size here" in capsys.readouterr().out


def test_javascript(tmp_path, capsys):
    main(["export", "lorenz-spinn", "--format", "js", "--measurement-noise", "0.3", "--out", str(tmp_path)])
    constants, module = tmp_path / "lorenz_spinn_step.safetensors", tmp_path / "kkl_observer.js"
    assert "export class Observer" in module.read_text()
    assert capsys.readouterr().out == f"wrote {constants}, {constants.stat().st_size / 1e3:.0f} kB, and {module}\n"
    _, described = storage.read(constants, key="kkl_step", error=ValueError, what="a step")
    assert described["measurement_noise"] == [0.3]


def test_onnx(tmp_path, capsys):
    onnx = pytest.importorskip("onnx", reason="needs the extra onnx")
    main(["export", "lorenz-spinn", "--format", "onnx", "--precision", "double", "--out", str(tmp_path)])
    (path,) = tmp_path.iterdir()
    assert capsys.readouterr().out == f"wrote {path}, {path.stat().st_size / 1e3:.0f} kB\n"
    onnx.checker.check_model(onnx.load(path))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("lorenz --format onnx --measurement-noise 0.1", "levels of noise are inputs of an ONNX graph"),
        ("lorenz --format onnx --process-noise 0.1", "levels of noise are inputs of an ONNX graph"),
        ("lorenz --format c --measurement-noise 5", "beyond the map's range, 0 to 3.0"),
        ("lorenz --format c --measurement-noise 0.1,0.2", "must be one number, or one for each of 1 outputs"),
        ("none --format c", "unknown observer 'none'"),
    ],
)
def test_refused(arguments, message, tmp_path):
    with pytest.raises(SystemExit, match=message):
        main(["export", *arguments.split(), "--out", str(tmp_path / "nothing")])
    assert not (tmp_path / "nothing").exists()
