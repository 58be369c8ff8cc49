"""Motions under a policy, and errors of policies."""

from dataclasses import replace

import numpy as np
import pytest
from linear_system import Autonomous
from unstable_system import Falling

from kkl_gym.simulate import simulate
from training.presets import controller, named_policy
from training.trajectories.motions import POLICYS_OWN, Motions, under_policy

SYSTEM = Falling()


def exact(x):
    """The inputs of the policy at the true states."""
    return controller(SYSTEM, SYSTEM.dt)(x[:-1].reshape(-1, 2)).reshape(len(x) - 1, -1, 1) * SYSTEM.u_max


def test_inputs_are_the_policys_on_a_wrong_state_or_its_own():
    rng, own = np.random.default_rng(0), np.arange(40) % 3 == 1
    x0 = SYSTEM.draw_starts(rng, 40)
    x, u = under_policy(SYSTEM, controller(SYSTEM, SYSTEM.dt), x0, steps=300, dt=SYSTEM.dt, rng=rng, own=own)
    apart = np.abs(u - exact(x)).max((0, 2))
    np.testing.assert_array_equal(apart == 0, own)
    assert np.median(apart[~own]) > 0.2
    assert np.abs(u).max() <= SYSTEM.u_max[0]
    np.testing.assert_array_equal(x, simulate(SYSTEM, x0, 300, SYSTEM.dt, u=u))


def test_actions_that_are_no_numbers_are_an_error():
    own, rng = np.ones(4, dtype=bool), np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"the policy gives the action \[nan\] at x = \["):
        under_policy(SYSTEM, lambda x: np.where(x[:, :1] > 0.31, np.nan, 0.0), np.full((4, 2), 0.3), steps=300,
                     dt=SYSTEM.dt, rng=rng, own=own)  # fmt: skip


def test_errors_of_a_policy_name_the_place(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("def hold(x):\n    return x[:, :1] if len(x) < 30 else x.gain if len(x) == 30 else x\n")
    policy = named_policy(SYSTEM, f"{script}:hold", SYSTEM.dt)
    for n, message in ((30, r"\(30, 2\): AttributeError: .*line 2 \(`return"), (40, r"shape \(40, 1\), got \(40, 2\)")):
        with pytest.raises(ValueError, match=message):
            policy(np.full((n, 2), 0.3))


def test_an_unstable_plant_is_held_by_a_policy_alone():
    free, rng = Motions(SYSTEM, SYSTEM.dt, 1000, ("steps",), process_noise_share=0.5), np.random.default_rng(0)
    with pytest.raises(ValueError, match="--policy"):
        free.drawn(120, rng)
    with pytest.raises(ValueError, match=r"stayed within bounds = .*; widen .* reduce u_max, or reduce dt$"):
        replace(free, policy=lambda x: np.ones((len(x), 1))).drawn(120, rng)
    x, u, level, _ = replace(free, policy=controller(SYSTEM, SYSTEM.dt)).drawn(30, rng)
    assert x.shape[1] == 30
    np.testing.assert_array_equal((u == exact(x)).all((0, 2)), np.arange(x.shape[1]) % POLICYS_OWN == 0)
    assert level.any()


def test_invalid_policies_are_refused(tmp_path):
    (tmp_path / "bad.py").write_text(
        "def loud(x):\n    return 3.0 * (x[:, :1] > 0)\n\ndef wrong(x):\n    return x.nothing\n"
    )
    for system, name, message in (
        (SYSTEM, f"{tmp_path}/bad.py:loud", r"\[-1, 1\]"),
        (SYSTEM, f"{tmp_path}/bad.py:wrong", "AttributeError"),
        (SYSTEM, "nothing", "nothing"),
        (SYSTEM, "nowhere.py:act", "act"),
        (SYSTEM, "math:pi", "pi"),
        (Autonomous(), "controller", "no inputs"),
        (Autonomous(), "numpy:zeros_like", "no inputs"),
    ):
        with pytest.raises(ValueError, match=message):
            named_policy(system, name, None)


def test_a_system_that_no_regulator_stabilises():
    sizes = {
        "X": ((-0.3, 0.3), (-0.5, 0.5), (-1, 1)),
        "bounds": ((-2, 2), (-5, 5), (-3, 3)),
        "G": ((0.0,), (1.0,), (0.0,)),
    }
    equations = {"name": "uncontrolled", "f": lambda self, x: (*Falling.f(self, x[:2]), x[2])}
    with pytest.raises(ValueError, match=r"reduce dt, or give a policy as script\.py:function"):
        named_policy(type("Uncontrolled", (Falling,), sizes | equations)(), "controller", None)
