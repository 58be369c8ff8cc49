"""kkl-gym demo and kkl-gym maps."""

from training.cli import main


def test_demo_and_maps(tmp_path, capsys):
    main(["demo", "--out", str(tmp_path), "--duration", "1"])
    main(["maps"])
    out = capsys.readouterr().out
    assert "KKLLorenz-v0" in out
    assert "van_der_pol-spinn" in out
    assert (tmp_path / "estimates.png").stat().st_size > 10_000
