"""The exported step in C99 against KKLObserver."""

from dataclasses import replace

import numpy as np
import pytest
from compiled_c import compiled, estimates, fed, needs_cc
from exported_steps import MAPS, apart, apart_at_all_levels, exported_of, in_doubles, mapped, noise, tracked
from random_artifacts import random_artifact
from rollout_observers import observer_of

from kkl_gym import get_system
from observers import shipped
from training.export.c_source import c_files
from training.export.exported import Exported, identifier

TOLERANCES = {"float": 1e-5, "double": 1e-9}


@needs_cc
@pytest.mark.parametrize(("index", "precision"), [*((i, "double") for i in range(len(MAPS))), (1, "float")])
def test_every_kind_of_map(index, precision, tmp_path):
    exported, y, u, expected = mapped(index)
    x_hat = estimates(compiled(replace(exported, precision=precision), tmp_path), y[:, 1], u[:, 1])
    assert apart(exported, x_hat, expected[:, 1]) < TOLERANCES[precision]


@needs_cc
@pytest.mark.parametrize(
    ("name", "precision", "steps"),
    [
        ("lorenz-spinn", "float", 6000),
        *(pytest.param(name, each, 100_000, marks=pytest.mark.slow) for name in shipped() for each in TOLERANCES),
    ],
)
def test_many_steps_of_shipped_maps(name, precision, steps, tmp_path):
    of_range, of_scale = apart_at_all_levels(
        name, precision, lambda exported, y, u: estimates(compiled(exported, tmp_path), y, u), steps, length=steps // 3
    )
    print(f"{name} {precision}: {of_range:.1e} of the range, {of_scale:.1e} of the scale")
    assert of_range < TOLERANCES[precision]


@needs_cc
@pytest.mark.parametrize("tracks", [False, True])
def test_other_levels_of_noise(tracks, tmp_path):
    exported, *record = tracked(5) if tracks else mapped(1)
    y, u, usual = (each[:200] if tracks else each[:, 1] for each in record)
    other = replace(exported, measurement_noise=(0.9, 2.0), process_noise=7.0)  # T_inv's training ends at 0.2
    x_hat = estimates(compiled(other, tmp_path), y, u)
    np.testing.assert_allclose(x_hat, in_doubles(other, y, u), rtol=0, atol=1e-9)
    assert abs(x_hat - usual).max() > 1e-3
    assert "process noise of level 7.0." in (tmp_path / "made.h").read_text()


@needs_cc
def test_names_of_signals_are_escaped_in_comments(tmp_path):
    names = ["*/ int x; /*", "a\\", "ends with ??/", "/*/"]
    artifact = replace(observer_of("Any-v0", names[:1], names[1:3], names[3:]), environment=None)
    exported = exported_of(artifact, tmp_path, name="2 weird-é names", precision="double")
    assert exported.name == "observer_2_weird_names"
    y, u = noise(artifact, 30)
    assert apart(exported, estimates(compiled(exported, tmp_path), y, u), in_doubles(exported, y, u)) < 1e-10


@needs_cc
def test_a_line_without_all_its_numbers_is_an_error(make_artifact, tmp_path):
    program = compiled(exported_of(make_artifact(), tmp_path), tmp_path)
    for text in ("1.0\n0.5\n", "1.0\n0.5 word\n", "word\n"):
        done = fed(program, text)
        assert done.returncode == 1
        assert done.stderr == "a line has too few numbers, or an invalid one\n"
    assert fed(program, "").returncode == 0


def test_identifiers():
    names = ["lorenz-spinn", "Pendulum-v1", "3d", "模", "_a b_"]
    assert [*map(identifier, names)] == ["lorenz_spinn", "Pendulum_v1", "observer_3d", "observer", "a_b"]


def test_names_of_signals(tmp_path):
    assert mapped(2)[0].signals["x_hat"][-1] == "mu"
    rollouts = exported_of(observer_of("Pendulum-v1", ["obs[0]", "obs[1]"], ["obs[2]"], ["action[0]"]), tmp_path)
    assert rollouts.signals == {"y": ["obs[0]", "obs[1]"], "u": ["action[0]"], "x_hat": ["obs[2]"]}
    artifact, system = random_artifact(system="lorenz"), get_system("van_der_pol")
    training = artifact.training | {"bias": 1.0}
    artifact = replace(artifact, system=system.name, parameters=system.parameters, training=training)
    assert (exported := exported_of(artifact, tmp_path)).signals["x_hat"] == ["x1", "x2", "y1_bias"]
    assert "_NX 3 /*" in c_files(exported)["made.h"]


def test_an_unknown_precision():
    with pytest.raises(ValueError, match="precision must be 'float' or 'double', got 'half'"):
        Exported.read("lorenz", precision="half")
