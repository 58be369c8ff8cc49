"""Profiles of the shipped systems, their control tasks and scores, and the classical controllers."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from unstable_system import Falling

from kkl_gym import SYSTEMS, System, get_system
from training.agents.environments import vector
from training.agents.play import play
from training.agents.tasks import TASKS, TOLERANCE, control_task, get_task, scores, successes
from training.presets import Profile, controller, profile
from training.trajectories.equations import linearised
from training.trajectories.motions import INPUT_WEIGHT, linear_quadratic


def nothing(obs):
    return np.zeros((len(obs), 1))


def test_a_user_system_has_the_defaults_and_no_controller_without_input(script):
    own = get_system(f"{script}:Pendulum")
    assert profile(own) == Profile()
    with pytest.raises(ValueError, match="pendulum has no inputs"):
        controller(own, own.dt)


@pytest.mark.parametrize("name", SYSTEMS)
def test_linearisation_equals_finite_differences(name):
    system = get_system(name)
    x, eps = np.random.default_rng(0).uniform(*system.box()), 1e-6
    A, B, C = linearised(system, x)
    for j, step in enumerate(eps * np.eye(system.nx)):
        assert np.allclose(A[:, j], (np.array(system.f(x + step)) - system.f(x - step)) / (2 * eps), atol=1e-5)
        assert np.allclose(C[:, j], (np.array(system.h(x + step)) - system.h(x - step)) / (2 * eps), atol=1e-6)
    assert B.tolist() == [list(row) for row in system.G]


def gain(system, act):
    step = 1e-6 * np.eye(system.nx)
    return (act(np.array(system.target) - step) - act(np.array(system.target) + step)).T * system.u_max / 2e-6


class Diagonal(System):
    """x1' = 40 x1 + u1, x2' = -200 x2 + u2."""

    name, X, bounds, u_max = "diagonal", ((-1, 1), (-2, 2)), ((-9, 9), (-9, 9)), (10.0, 10.0)
    G = ((1.0, 0.0), (0.0, 1.0))

    def f(self, x):
        return 40.0 * x[0], -200.0 * x[1]

    def h(self, x):
        return (x[0],)


@pytest.mark.parametrize("dt", [0.001, 0.1])
def test_the_regulator_of_fast_modes_has_the_closed_loop_in_closed_form(dt):
    """A mode a with input gain b over dt and r = R / Q has the closed-loop z with z + 1 / z = a + (1 + b^2 / r) / a."""
    rates, ratio = np.array([40.0, -200.0]), INPUT_WEIGHT / 100.0 * np.array([1.0, 4.0])
    a = np.exp(rates * dt)
    b = (a - 1.0) / rates
    half = (a + (1.0 + b**2 / ratio) / a) / 2.0
    closed = np.diag(a) - np.diag(b) @ gain(Diagonal(), linear_quadratic(Diagonal(), dt))
    assert closed == pytest.approx(np.diag(1.0 / (half + np.sqrt(half**2 - 1.0))), abs=1e-7)


def test_the_regulator_of_a_double_integrator_is_that_of_scipy():
    class Double(Falling):
        name = "double"

        def f(self, x):
            return x[1], 0.0

    dt, system = 0.5, Double()
    A, B = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2], [dt]])
    Q, R = np.diag(1.0 / np.square(system.scale)), np.array([[INPUT_WEIGHT / 25.0]])
    P = solve_discrete_are(A, B, Q, R)
    expected = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    assert gain(system, linear_quadratic(system, dt)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("name", ["van_der_pol", "lorenz"])
def test_the_linear_quadratic_regulator_saturates_away_from_the_target(name):
    system = get_system(name)
    act = linear_quadratic(system, system.dt)
    assert act(np.array([system.target])).tolist() == [[0.0]]
    assert np.abs(act(np.random.default_rng(0).uniform(*system.box(), (50, system.nx)))).max() == 1.0


# Of the two other systems, one succeeds in only half of all episodes, and one is slow to simulate.
@pytest.mark.parametrize("name", ["reverse_duffing", "van_der_pol"])
def test_state_feedback_succeeds_where_zero_input_fails(name):
    task, n, system = TASKS[name], 20, get_system(name)
    episodes = play(vector(task, n), controller(system, task.repeat * task.env_kwargs["dt"]), seed=0)
    idle = play(vector(task, n), nothing, seed=0)
    assert (episodes.x[0] == idle.x[0]).all()
    assert episodes.x.shape == (task.steps + 1, n, system.nx)
    assert episodes.u.shape == (task.steps, n, 1)
    assert not (episodes.escaped | idle.escaped).any()
    assert successes(system, episodes.x).mean() >= 0.95
    assert successes(system, idle.x).mean() <= 0.1
    assert scores(system, episodes.x).mean() > scores(system, idle.x).mean() + 0.2


def test_the_task_acts_once_a_period_and_ends_in_time():
    task = control_task("van_der_pol", 0.1, period=0.05, duration=1.0, start_box=((1, 1), (0, 0)))
    assert (task.repeat, task.steps) == (5, 20)
    env = vector(task, 2)
    assert env.reset(seed=0)[0].tolist() == [[1.0, 0.0]] * 2
    for k in range(task.steps):
        obs, _, _, truncated, info = env.step(np.zeros((2, 1)))
        assert truncated.all() == (k == task.steps - 1)
    assert obs.shape == (2, 2)
    assert info["final_info"]["sample"].tolist() == [100, 100]


def test_scores_and_successes_by_hand():
    system = get_system("reverse_duffing")  # target 0, scale (2, 1.5)
    x = np.zeros((10, 2, 2))
    x[:, 1] = [2.0, 1.5]  # one scale off in both states: c = 1
    assert scores(system, x) == pytest.approx([0.0, np.exp(-4.0) - 1.0])
    x[:] = 0.0
    x[:8, 0] = 5.0  # only the last fifth counts
    x[9, 1] = [0.0, 1.01 * TOLERANCE * 1.5]
    assert successes(system, x).tolist() == [True, False]
    x[9, 1] = [0.0, 0.99 * TOLERANCE * 1.5]
    assert successes(system, x).tolist() == [True, True]


def test_invalid_tasks_and_names_are_refused():
    for wrong in ({"dt": True}, {"dt": np.nan}, {"period": 0.015}, {"duration": 19.97}, {"duration": 1e9}):
        with pytest.raises(ValueError, match=r"task needs|whole multiple|max_episode_steps must be"):
            control_task("lorenz", **wrong)
    with pytest.raises(ValueError, match="unknown system 'lorentz'"):
        get_task("lorentz")
    assert [get_task("lorenz", *level).measurement_noise for level in ((), (2.0,))] == [0.5, 2.0]


def test_the_law_of_reverse_duffing_follows_its_parameters():
    """On the manifold x2 = -cbrt(a x1), the input keeps the state on the manifold."""
    act = controller(get_system("reverse_duffing", {"a": 8.0, "b": 0.5}), 0.01)
    assert act(np.array([[1e-3, -0.2]])) == pytest.approx(0.5e-3)
    assert act(np.array([[-0.5, 0.3]])) == pytest.approx(np.clip(-0.25 - 2.0 * (0.3 - 4.0 ** (1 / 3)), -1, 1))
