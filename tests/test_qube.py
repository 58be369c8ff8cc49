"""examples/qube.py on simulated runs, and on the measured runs where these are available."""

import os
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from kkl_gym.simulate import simulate

EXAMPLES = Path(__file__).parent.parent / "examples"
sys.path.insert(0, str(EXAMPLES))  # as with `python examples/qube.py`
QUBE = runpy.run_path(str(EXAMPLES / "qube.py"))
sys.path.remove(str(EXAMPLES))


def energy(model, x):
    alpha, arm, pendulum = x.T[1:4]
    half = model.pendulum_length / 2
    tip = model.arm_length * arm - half * np.cos(alpha) * pendulum  # velocity of the pendulum's middle along the circle
    around = half * np.sin(alpha) * arm
    up = half * np.sin(alpha) * pendulum
    own = model.pendulum_mass * model.pendulum_length**2 / 12 * (pendulum**2 + (np.sin(alpha) * arm) ** 2)
    moving = model.pendulum_mass * (tip**2 + around**2 + up**2) + own + model.arm_inertia * arm**2
    return moving / 2 + model.pendulum_mass * model.gravity * half * np.cos(alpha)


def test_the_model_keeps_its_energy_and_hangs():
    model = QUBE["Qube"](arm_damping=0.0, pendulum_damping=0.0)
    x = simulate(model, np.array([[0.1, 1.0, 2.0, 3.0], [0.0, 3.0, -1.0, 9.0]]), 200, 0.004)
    for run in np.moveaxis(x, 1, 0):
        np.testing.assert_allclose(energy(model, run), energy(model, run)[0], rtol=1e-5)
    hanging = simulate(QUBE["Qube"](), np.array([[0.1, 2.0, 0.0, 0.0]]), 2500, 0.004)[-1, 0]
    assert hanging[1] == pytest.approx(np.pi, abs=0.05)


MODEL = QUBE["BothAngles"](
    **{**QUBE["GUESSES"], "arm_damping": 0.0004, "arm_friction": 2e-4, "pendulum_friction": 3e-5}
)


def write_runs(folder, model):
    """Write simulated runs of a model as files in the format of the measured runs."""
    rng = np.random.default_rng(0)
    runs = range(1, 13)
    x0 = np.stack([np.zeros(12), rng.uniform(1, 5, 12), rng.uniform(-2, 2, 12), rng.uniform(-5, 5, 12)], -1)
    x = simulate(model, x0, 700, 0.004)
    for i, run in enumerate(runs):
        alpha = np.angle(np.exp(1j * x[:, i, 1]))
        velocities = [QUBE["recorded_velocity"](x[:, i, column]) for column in (1, 0)]
        t = 3.0 + 0.004 * (np.arange(701) + rng.uniform(-0.05, 0.05, 701))
        columns = np.column_stack([alpha, x[:, i, 0], *velocities, t])
        header = "alpha,theta,alpha_dot,theta_dot,time"
        np.savetxt(folder / f"run{run:02d}.csv", columns, delimiter=",", header=header, comments="")


def test_dry_friction_holds_the_arm_and_the_spring_turns_it():
    at_rest = np.array([[0.02, np.pi, 0.0, 0.0]])
    held = simulate(QUBE["Qube"](arm_friction=2e-4, arm_spring=5e-4), at_rest, 250, 0.004)[-1, 0]
    assert held[0] == pytest.approx(0.02, abs=0.006)  # the smoothed friction lets the arm creep
    turned = simulate(QUBE["Qube"](arm_spring=5e-4), at_rest, 250, 0.004)[-1, 0]
    assert turned[0] < 0.01


def test_an_arm_sticks_until_it_is_pushed_while_the_pendulum_swings():
    stuck, turned = simulate(
        QUBE["Pushed"](**{**QUBE["GUESSES"], "arm_friction": 2e-4}),
        np.array([[0.05, np.pi + 0.01, 0.0, 0.0, 0.0], [0.05, np.pi + 0.01, 0.0, 0.0, 6.0]]),
        250,
        0.004,
    ).transpose(1, 0, 2)
    assert np.abs(stuck[:, 0] - 0.05).max() < QUBE["ENCODER"] / 2
    assert np.ptp(stuck[:, 1]) > 0.015
    assert turned[-1, 0] > 0.05 + 3 * QUBE["ENCODER"]


STICKS = QUBE["Sticking"](**{name: getattr(MODEL, name) for name in QUBE["GUESSES"]})


@pytest.mark.slow
@pytest.mark.parametrize(("model", "guess"), [(MODEL, ()), (STICKS, (QUBE["Sticking"](),))], ids=["slides", "sticks"])
def test_parameters_are_found_again(tmp_path, model, guess):
    write_runs(tmp_path, model)
    found = QUBE["fitted"](QUBE["read"](tmp_path, (1, 2, 4, 5)), *guess).parameters
    for name in ("arm_length", "arm_inertia", "pendulum_inertia", "arm_damping", "arm_friction", "pendulum_friction"):
        assert found[name] == pytest.approx(getattr(model, name), rel=0.03), name
    assert found.get("arm_slip") == getattr(model, "arm_slip", None)


@pytest.mark.slow
def test_the_guided_filter_restarts_after_a_wrong_start_and_ignores_small_offsets(tmp_path, monkeypatch):
    """The guiding estimates are opposite at first, which restarts the filter, and later off by 0.3 rad."""
    write_runs(tmp_path, STICKS)
    records = QUBE["read"](tmp_path, (1, 2, 3))
    truth = {record.name: record.x for record in records}
    wrong, blind = round(0.5 / 0.004), round(1.6 / 0.004)

    def guiding(zero, record):
        x = truth[record.name].copy()
        x[:wrong, :2] *= -1.0
        alpha = np.arctan2(x[:, 1], x[:, 0]) + zero
        alpha[blind:] += 0.3
        x[:, :2] = np.stack([np.cos(alpha), np.sin(alpha)], -1)
        x[blind:, 2:] = 0.0
        return x

    monkeypatch.setitem(QUBE["guided"].__globals__, "estimates", guiding)
    found = QUBE["guided"](0.0, STICKS, 0.0, records)
    for x_hat, record in zip(found, records, strict=True):
        assert x_hat.shape == record.x.shape
        late = np.abs(x_hat - record.x)[round(0.8 / 0.004) :]
        assert (late.max(0) < [0.05, 0.05, 0.8, 0.2]).all()
        np.testing.assert_allclose(x_hat[:, 3], QUBE["recorded_velocity"](record.y[:, 0]))
    beside = QUBE["guided"](0.01, STICKS, 0.01, records)
    angles = [np.arctan2(each[0][:, 1], each[0][:, 0]) for each in (beside, found)]
    np.testing.assert_allclose(np.angle(np.exp(1j * (angles[0] - angles[1]))), 0.01, atol=1e-9)


@pytest.mark.slow
def test_on_runs_of_its_own_model(tmp_path, capsys, monkeypatch):
    for setting, small in {"windows": 500, "samples": 10, "members": 1, "width": 16}.items():
        monkeypatch.setitem(QUBE["SETTINGS"], setting, small)
    fitted = lambda records, model=None: STICKS if model else MODEL  # noqa: E731
    monkeypatch.setitem(QUBE["fitted"].__globals__, "fitted", fitted)
    write_runs(tmp_path, QUBE["Qube"]())
    found = QUBE["main"](tmp_path, out=tmp_path / "out", inverse_steps=60)
    for name in (QUBE["ALONE"], QUBE["BOTH"], QUBE["GUIDED"]):
        assert np.isfinite(found[name]).all()
    assert not np.allclose(found[QUBE["ALONE"]], found[QUBE["BOTH"]])
    of_filters = [found[f"extended Kalman filter, {kind} model"] for kind in ("published", "fitted")]
    assert (of_filters[0] < 0.6).all()  # the model that simulated the runs
    assert np.isfinite(of_filters[1]).all()
    assert not np.allclose(*of_filters)
    assert found["finite differences"][3] < 0.01
    assert np.isnan(found["finite differences"][:3]).all()
    assert "| finite differences | - | - | - | 0.00" in (tmp_path / "out" / "table.md").read_text()
    assert (tmp_path / "out" / "estimates.png").stat().st_size > 10_000
    found = QUBE["main"](tmp_path, out=tmp_path / "out", inverse_steps=10, cross_validate=True)
    assert list(found) == [QUBE["ALONE"], QUBE["BOTH"], QUBE["GUIDED"]]
    assert "finite differences" in capsys.readouterr().out


def test_on_the_device(tmp_path):
    path = os.environ.get("KKL_GYM_QUBE")
    if path is None:
        pytest.skip("REAL DATA NOT TESTED: set KKL_GYM_QUBE to the folder of the Qube's runs, see examples/qube.py")
    found = QUBE["main"](Path(path), out=tmp_path)
    assert (found[QUBE["BOTH"]].round(2) <= 0.05).all()
    assert (found[QUBE["GUIDED"]] <= 0.04).all()
