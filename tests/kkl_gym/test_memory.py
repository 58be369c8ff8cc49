"""The memory around any environment: its filters against integration, and Gymnasium's own environments."""

import copy
import importlib.util
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from bad_values import ATOMS
from discrete_systems import Henon
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation, MaxAndSkipObservation, RecordEpisodeStatistics, TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_lyapunov

import kkl_gym
import kkl_gym.memory
from kkl_gym import ENV_IDS, ActionRepeat, KKLEnv, KKLMemory, KKLVectorEnv, KKLVectorMemory
from kkl_gym.memory import Memory
from kkl_gym.signals import Inputs, Outputs
from kkl_gym.turning import TurningMemory

modes = pytest.mark.parametrize("mode", list(AutoresetMode))
BANKS = [((1.0, 2.0, 4.0, 8.0), (1.0, 4.0)), ((0.5, 3.0, 500.0), ()), ((7.0,), (0.5, 30.0, 9000.0))]
banks = pytest.mark.parametrize(("outputs", "inputs"), BANKS)


def memory(ny, nu, outputs=(1, 2, 4, 8), inputs=(1, 4)):
    return Memory(ny, nu, time_constants=outputs, input_time_constants=inputs)


def signals(steps, *shape, seed=0):
    return np.random.default_rng(seed).normal(size=(steps, *shape))


def run(filters, y, u):
    return np.array([filters.reset(y[0]), *(filters.advance(one, held) for one, held in zip(y[1:], u))])


# The filters


@banks
def test_the_filters_are_those_that_integration_finds(outputs, inputs):
    y, u = signals(12, 2), signals(11, 1, seed=1)
    shown = run(memory(2, 1, outputs, inputs), y, u)
    found = memory(2, 1, outputs, inputs)
    tau, tau_u = np.array(outputs)[:, None], np.array(inputs)

    def rate(t, state, k):
        z, v = state[: tau.size * 2].reshape(-1, 2), state[tau.size * 2 :]
        return np.concatenate([((y[k] + (y[k + 1] - y[k]) * t - z) / tau).ravel(), (u[k] - v) / tau_u])

    state = np.concatenate([np.tile(y[0], tau.size), np.zeros(tau_u.size)])
    for k in range(11):
        state = solve_ivp(rate, (0, 1), state, method="DOP853", rtol=1e-11, atol=1e-12, args=(k,)).y[:, -1]
        kept = np.exp(-1 / tau) ** (k + 1)
        w = (y[k + 1] - state[: tau.size * 2].reshape(-1, 2)) * (1 - kept * np.exp(-64 / tau)) / (1 - kept)
        expected = np.concatenate([y[k + 1], (found.mixing @ w).ravel(), state[tau.size * 2 :]])
        assert np.allclose(shown[k + 1], expected, rtol=1e-5, atol=1e-5)


@banks
def test_a_steady_motion_looks_from_the_first_step_on_as_after_sixty_four_more(outputs, inputs):
    """That is what the past before the first output is taken for."""
    y = np.arange(40.0)[:, None] * [[0.3, -2.0]] + 5.0
    shown = run(memory(2, 1, outputs, inputs), y, np.zeros((39, 1)))[:, 2:]
    tau = np.array(outputs)[:, None]
    for k in (1, 2, 20, 39):
        w = tau * (1 - np.exp(-(k + 64) / tau)) * [[0.3, -2.0]]  # a low-pass lags behind a ramp by tau, in the end
        expected = (memory(2, 1, outputs, inputs).mixing @ w).ravel()
        assert np.allclose(shown[k, : expected.size], expected, rtol=1e-5, atol=1e-5)


def test_in_the_end_nothing_is_left_of_the_beginning():
    y, u = signals(400, 2), signals(399, 1, seed=1)
    late = run(memory(2, 1), y[200:], u[200:])
    assert np.allclose(run(memory(2, 1), y, u)[-1], late[-1], rtol=1e-6, atol=1e-6)
    assert not np.allclose(run(memory(2, 1), y, u)[205], late[5], rtol=0.1, atol=0.1)


@banks
def test_coordinates_are_uncorrelated_and_of_unit_size_for_wandering_signals(outputs, inputs):
    found = memory(1, 1, outputs, inputs)
    m, covariance = len(outputs), 0.0
    for correlation in np.geomspace(2 * outputs[0], 8 * outputs[-1], 6):
        stays = np.exp(-1 / correlation)  # y_k+1 = stays y_k + noise, and w as the docstring says
        transition = np.block(
            [[stays, np.zeros((1, m))], [found.rise[:, None] * (stays - 1), np.diag(found.decay)]],
        )
        drive = np.concatenate([[1.0], found.rise])[:, None] * np.sqrt(1 - stays**2)
        covariance = covariance + solve_discrete_lyapunov(transition, drive @ drive.T)[1:, 1:] / 6
    assert np.allclose(found.mixing @ covariance @ found.mixing.T, np.eye(m), atol=1e-6)
    assert np.array_equal(abs(found.mixing) > 1e-9, np.tri(m, dtype=bool)[:, ::-1])  # the slowest alone, one more each
    assert (found.mixing[range(m), range(m - 1, -1, -1)] > 0).all()


def test_the_coordinates_serve_a_real_motion():
    """Of a pendulum that is pushed about: nearly collinear filters become features of one size."""
    env = KKLMemory(gym.make("Pendulum-v1"), measured=[0, 1])
    rng, shown = np.random.default_rng(0), []
    for seed in range(10):
        env.reset(seed=seed)
        for _ in range(10):
            action = rng.uniform(-2, 2, 1).astype(np.float32)
            shown += [env.step(action)[0] for _ in range(20)]
    coordinates = np.array(shown)[:, 2:10:2]  # of the cosine
    filters = coordinates @ np.linalg.inv(memory(2, 1).mixing).T
    assert np.linalg.cond(np.cov(coordinates.T)) < 0.01 * np.linalg.cond(np.cov(filters.T))
    assert (coordinates.std(0) > 0.3).all()
    assert (coordinates.std(0) < 1.0).all()


@pytest.mark.parametrize("ratio", [1.5, 2.0, 10.0])
@pytest.mark.parametrize("shortest", [0.5, 1.0, 50.0])
def test_noise_is_amplified_at_most_threefold(shortest, ratio):
    most = 1 + int(np.log(9_999 / shortest) / np.log(ratio))
    for m in {1, 2, min(4, most), most}:
        found = memory(1, 0, shortest * ratio ** np.arange(m), ())
        later = ((found.decay - 1) * found.rise)[:, None]  # when a pulse of y has come and gone
        of_filters = found.rise[:, None] * found.rise + solve_discrete_lyapunov(np.diag(found.decay), later @ later.T)
        assert 0.5 < np.sqrt((found.mixing @ of_filters @ found.mixing.T).diagonal().max()) < 3.0


def test_noise_is_amplified_more_at_first():
    pulses = np.eye(6)[:, :, None]  # each row of the batch has one at another step
    shown = run(memory(1, 0, inputs=()), pulses, np.zeros((5, 6, 0)))[:, :, 1:]
    first, fifth = (np.sqrt((shown[k] ** 2).sum(0)).max() for k in (1, 5))
    assert 21 < first < 22.5
    assert 4 < fifth < 4.5


def test_an_output_at_rest_leaves_no_trace():
    filters = memory(2, 1)
    rest, away = np.array([1e4, -3.0]), np.array([1e4 + 1.0, -3.0])
    shown = filters.reset(rest)
    assert np.array_equal(shown[2:], np.zeros(10, np.float32))
    assert np.abs(filters.advance(away, np.ones(1))[2:]).max() > 0.3
    for _ in range(400):
        shown = filters.advance(away, np.zeros(1))
    assert np.abs(shown[2:]).max() < 1e-9


@pytest.mark.parametrize(("outputs", "inputs"), [*BANKS, ((20.0, 150.0, 600.0), ())])  # the worst age of the last: 456
def test_bounds_hold_and_are_reached_by_the_worst_signals(outputs, inputs):
    """Of each age and coordinate the output that drives it furthest, by the response to pulses, and the worst input."""
    filters = memory(1, 1, outputs, inputs)
    low, high = filters.bounds(np.array([-1.0]), np.array([3.0]), np.array([-1.0]), np.array([0.5]))
    reached = np.zeros(len(outputs))
    for age in (1, 2, 3, 4, 5, 10, 20, 31, 40, 52, 53, 54, 63, 64, 150, 400, 456):
        pulses = run(filters, np.eye(age + 1)[:, :, None], np.zeros((age, age + 1, 1)))[-1, :, 1 : 1 + len(outputs)]
        worst = np.where(pulses > 0, 3.0, -1.0)[:, :, None]
        for y, u in ((worst, 0.5), (2.0 - worst, -1.0)):
            shown = run(filters, y, np.full((age, len(outputs), 1), u))
            assert (low <= shown).all()
            assert (shown <= high).all()
            reached = np.maximum(
                reached, shown[-1, :, 1 : 1 + len(outputs)].diagonal() / (high if u > 0 else low)[1 : 1 + len(outputs)]
            )
    assert (reached > 0.98).all(), reached
    assert high[1 + len(outputs) :].tolist() == [0.5] * len(inputs)
    assert low[1 + len(outputs) :].tolist() == [-1.0] * len(inputs)


def test_signals_without_bounds_have_memories_without_bounds():
    infinite = np.array([np.inf])
    low, high = memory(1, 1).bounds(-infinite, infinite, np.array([2.0]), infinite)
    assert high.tolist() == [np.inf] * 7
    assert low.tolist() == [-np.inf] * 5 + [0.0] * 2  # where an input's filter begins


def test_one_row_a_batch_and_a_wide_row_agree(monkeypatch):
    y, u = signals(30, 5, 3), signals(29, 5, 2, seed=1)
    batch = run(memory(3, 2), y, u)
    rows = [run(memory(3, 2), y[:, i], u[:, i]) for i in range(5)]
    monkeypatch.setattr(kkl_gym.memory, "SMALL", 0)
    wide = [run(memory(3, 2), y[:, i], u[:, i]) for i in range(5)]
    assert np.allclose(batch, np.stack(rows, 1), rtol=1e-6, atol=1e-6)
    assert np.array_equal(batch, np.stack(wide, 1))
    assert batch.dtype == rows[0].dtype == np.float32


def test_one_row_and_a_batch_agree_at_ages_beyond_the_table(monkeypatch):
    monkeypatch.setattr(kkl_gym.memory, "TABLE", 5)
    y, u = signals(12, 3, 2), signals(11, 3, 1, seed=1)
    batch = run(memory(2, 1), y, u)
    rows = [run(memory(2, 1), y[:, i], u[:, i]) for i in range(3)]
    monkeypatch.undo()
    assert np.allclose(batch, np.stack(rows, 1), rtol=1e-6, atol=1e-6)
    assert np.allclose(batch, run(memory(2, 1), y, u), rtol=1e-6, atol=1e-6)


def test_nothing_underflows_while_a_memory_fills():
    y = signals(800, 2)
    with np.errstate(all="raise"):
        run(memory(2, 1, (0.5, 50.0)), y, signals(799, 1, seed=1))


def test_rows_that_rest_and_rows_that_restart():
    y, u = signals(4, 3, 2), signals(3, 3, 1, seed=1)
    filters = memory(2, 1)
    before = run(filters, y[:3], u[:2])[-1]
    some = np.array([True, False, True])
    after = filters.advance(y[3], u[2], some)
    assert np.array_equal(after[1], before[1])
    assert np.array_equal(after[some], run(memory(2, 1), y, u)[-1][some])
    first = filters.restart(y[0, :1], np.array([False, True, False]))
    assert np.array_equal(filters.shown()[[0, 2]], after[some])
    assert np.array_equal(filters.shown()[1:2], first)
    assert np.array_equal(first[0], memory(2, 1).reset(y[0, 0]))


def test_a_memory_begins_with_a_reset():
    for filters, y in ((memory(2, 1), np.zeros(2)), (memory(100, 1), np.zeros(100)), (memory(2, 1), np.zeros((3, 2)))):
        with pytest.raises(RuntimeError, match="before its first step"):
            filters.advance(y, np.zeros((*y.shape[:-1], 1)))
    with pytest.raises(RuntimeError, match="reset all environments"):
        memory(2, 1).restart(np.zeros((1, 2)), np.array([True, False]))


# Angles

ANGLES = [(3, 1), (0, 4)]  # of five outputs, of which the third is none


def turning(steps, *shape, seed=0):
    """Five outputs of two angles that turn around more than once, and these angles, unwrapped."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-np.pi, np.pi, (*shape, 2)) + rng.uniform(-2.5, 2.5, (steps, *shape, 2)).cumsum(0)
    other = rng.normal(size=(steps, *shape, 1))
    (a, b), (cos, sin) = np.moveaxis(angles, -1, 0), (np.cos, np.sin)
    return np.stack([cos(b), sin(a), other[..., 0], cos(a), sin(b)], axis=-1), np.concatenate([other, angles], axis=-1)


def of_angles(**how):
    return TurningMemory(5, 2, ANGLES, **{"time_constants": (1, 3), "input_time_constants": (2,), **how})


@pytest.mark.parametrize("shape", [(), (4,)])
def test_of_angles_it_is_remembered_how_far_they_have_turned(shape):
    (y, unwrapped), u = turning(40, *shape), signals(39, *shape, 2, seed=1)
    assert np.ptp(unwrapped[..., 1:], axis=0).min() > 2 * np.pi
    seen, plain = run(of_angles(), y, u), run(memory(3, 2, (1, 3), (2,)), unwrapped, u)
    assert np.allclose(seen[..., :5], y)
    assert np.allclose(seen[..., 5:], plain[..., 3:], atol=1e-5)
    assert seen.dtype == np.float32


def test_a_rate_is_told_wherever_the_angle_is():
    angle = np.linspace(0, 40, 200)
    y = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = run(TurningMemory(2, 0, [(0, 1)], time_constants=(2, 5), input_time_constants=()), y, np.zeros((199, 0)))
    assert np.ptp(seen[1:, 2:], axis=0).max() < 1e-5
    assert seen[1, 2] > 0.1


def test_rows_with_angles_that_rest_and_that_restart():
    (y, _), u = turning(4, 3), signals(3, 3, 2, seed=1)
    filters = of_angles()
    before = run(filters, y[:3], u[:2])[-1]
    some = np.array([True, False, True])
    after = filters.advance(y[3], u[2], some)
    assert np.array_equal(after[1], before[1])
    assert np.allclose(after[some], run(of_angles(), y, u)[-1][some])
    first = filters.restart(y[0, :1], ~some)
    assert np.array_equal(filters.shown()[some], after[some])
    assert np.array_equal(filters.shown()[1:2], first)
    assert np.array_equal(first[0], of_angles().reset(y[0, 0]))
    again = filters.advance(y[1], u[0], ~some)[1]
    fresh = of_angles()
    fresh.reset(y[0, 0])
    assert np.allclose(again, fresh.advance(y[1, 1], u[0, 1]), atol=1e-6)


def test_where_cosine_and_sine_are_zero_an_angle_is_taken_to_rest():
    still = np.array([[np.cos(2), np.sin(2)]] * 5)
    still[2], still[3] = 0.0, -0.0
    seen = run(TurningMemory(2, 0, [(0, 1)], time_constants=(1, 3), input_time_constants=()), still, np.zeros((4, 0)))
    assert np.abs(seen[:, 2:]).max() < 1e-6


@banks
def test_memories_of_angles_have_bounds_that_the_worst_turns_reach(outputs, inputs):
    filters = TurningMemory(2, 0, [(0, 1)], time_constants=outputs, input_time_constants=())
    nothing, plain = np.zeros(0), memory(1, 0, outputs, ())
    low, high = filters.bounds(np.array([-1.0, -1.0]), np.array([1.0, 1.0]), nothing, nothing)[:, 2:]
    assert np.array_equal(low, -high)
    reached = np.zeros(len(outputs))
    for age in (1, 2, 5, 40, 2000):
        # What one change of the angle leaves at this age tells the worst direction of each.
        weights = plain.rise * plain.decay ** np.arange(age)[::-1, None]
        for j, row in enumerate(plain.mixing @ (weights * kkl_gym.memory._with_past(plain.decay, age)).T):
            angle = np.append(0, np.where(row >= 0, 1, -1).cumsum()) * 0.999 * np.pi
            y = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            seen = run(filters, y, np.zeros((age, 0)))[:, 2:]
            assert (np.abs(seen) <= high).all()
            reached[j] = max(reached[j], seen[-1, j] / high[j])
    assert reached.min() > 0.9


def test_a_memory_of_angles_begins_with_a_reset():
    with pytest.raises(RuntimeError, match="before its first step"):
        of_angles().advance(np.zeros(5), np.zeros(2))
    with pytest.raises(RuntimeError, match="before its first step"):
        of_angles().shown()
    with pytest.raises(RuntimeError, match="reset all environments"):
        of_angles().restart(np.zeros((1, 5)), np.array([True, False]))


class Hand(gym.Env):
    """A hand that turns as far as its action says, and shows its angle in rad, or where it is."""

    action_space = spaces.Box(-3.0, 3.0, (1,))

    def __init__(self, *, radians=False, most=7):
        self.radians, self.most = radians, most
        self.observation_space = spaces.Box(-np.inf, np.inf, (1 if radians else 2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.angle, self.steps = self.np_random.uniform(-3, 3), 0
        return self._seen(), {}

    def _seen(self):
        seen = [self.angle] if self.radians else [np.cos(self.angle), np.sin(self.angle)]
        return np.array(seen, dtype=np.float32)

    def step(self, action):
        self.angle += float(action[0])
        self.steps += 1
        return self._seen(), 0.0, self.steps == self.most, False, {}


@modes
def test_angles_in_vectors_that_reset(mode):
    arguments = {"angles": [(0, 1)], "time_constants": [1, 5]}
    ours = KKLVectorMemory(
        SyncVectorEnv([partial(Hand, most=3 + i) for i in range(3)], autoreset_mode=mode), **arguments
    )
    theirs = SyncVectorEnv(
        [lambda i=i: KKLMemory(Hand(most=3 + i), **arguments) for i in range(3)], autoreset_mode=mode
    )
    radians = KKLVectorMemory(
        SyncVectorEnv([partial(Hand, most=3 + i, radians=True) for i in range(3)], autoreset_mode=mode),
        angles=[0],
        time_constants=[1, 5],
    )
    every = (ours, theirs, radians)
    first, *others = (envs.reset(seed=1) for envs in every)
    for other in others:
        assert_alike(first, other)
    ours.action_space.seed(0)
    for _ in range(20):
        actions = ours.action_space.sample()
        first, *others = (envs.step(actions) for envs in every)
        for other in others:
            assert_alike(first, other)
        ended = first[2] | first[3]
        if mode is AutoresetMode.DISABLED and ended.any():
            first, *others = (envs.reset(options={"reset_mask": ended.copy()}) for envs in every)
            for other in others:
                assert_alike(first, other)
    assert np.abs(first[0]).max() > 1


# What is read of observations and actions

SPACES = [
    spaces.Box(-2.0, 3.0, (4,)),
    spaces.Box(-1.0, 1.0, (2, 3), np.float64),
    spaces.Box(0, 255, (5,), np.uint8),
    spaces.Discrete(4, start=-1),
    spaces.MultiDiscrete([2, 3], start=[1, -5]),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary(3),
    spaces.MultiBinary((2, 2)),
    spaces.Dict(b=spaces.Discrete(2), a=spaces.Box(-1, 1, (2,)), c=spaces.Tuple([spaces.MultiBinary(2)])),
    spaces.Tuple([spaces.Discrete(3), spaces.Dict(x=spaces.Box(-np.inf, np.inf, ()))]),
]


def stacked(space, values):
    return gym.vector.utils.concatenate(
        space, values, gym.vector.utils.create_empty_array(space, len(values), fn=np.zeros)
    )


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_observations_are_read_as_gymnasium_flattens_them(space):
    space.seed(0)
    values = [space.sample() for _ in range(6)]
    read = Outputs(space, None, (), source="X-v0")
    expected = np.array([spaces.flatten(space, value) for value in values])
    assert np.array_equal([read(value) for value in values], expected)
    assert np.array_equal(read(stacked(space, values), (6,)), expected)
    assert np.array_equal(read.low, spaces.flatten_space(space).low)
    assert np.array_equal(read.high, spaces.flatten_space(space).high)
    entry = len(read.low) - 1
    assert np.array_equal(Outputs(space, [entry], (), source="")(values[0]), expected[0, [entry]])


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_actions_are_scaled_where_they_are_bounded_boxes(space):
    space.seed(0)
    values = [space.sample() for _ in range(6)]
    read = Inputs(space, source="X-v0")
    flat = spaces.flatten_space(space)
    expected = np.array([spaces.flatten(space, value) for value in values], float)
    if isinstance(space, spaces.Box):
        expected = 2 * (expected - flat.low) / (flat.high.astype(float) - flat.low) - 1
        assert (read.low == -1).all()
    assert np.allclose([read(value) for value in values], expected)
    assert np.allclose(read(stacked(space, values), (6,)), expected)


def test_actions_beyond_the_bounds_count_as_the_bounds_and_half_a_bound_is_none():
    bounds = np.array([[-2.0, 0.0, 1.0], [2.0, np.inf, 1.0]], np.float32)
    read = Inputs(spaces.Box(*bounds), source="X-v0")
    assert read([9.0, 7.0, 1.0]).tolist() == [1.0, 7.0, 0.0]
    assert [read.low.tolist(), read.high.tolist()] == [[-1.0, 0.0, -1.0], [1.0, np.inf, 1.0]]


def test_bounds_that_are_the_largest_floats_are_none():
    for dtype in (np.float32, np.float64):
        largest = np.finfo(dtype).max
        read = Inputs(spaces.Box(-largest, largest, (2,), dtype), source="X-v0")
        assert read(np.array([3.0, -0.5])).tolist() == [3.0, -0.5]


@pytest.mark.parametrize("space", [spaces.MultiBinary(2), spaces.Box(0, 1, (2,), np.bool_)], ids=str)
def test_flags_are_numbers_where_the_space_has_them(space):
    for flags in (np.array([True, False]), [True, False], np.array([1, 0], np.int8)):
        assert Outputs(space, None, (), source="X-v0")(flags).tolist() == [1.0, 0.0]
    assert Inputs(space, source="X-v0")(np.array([[True, False]] * 3), (3,)).shape == (3, 2)
    with pytest.raises(ValueError, match=r"must be of .*, got"):
        Outputs(space, None, (), source="X-v0")(np.ma.array([True, False], mask=[True, False]))


def test_what_is_measured_and_angles():
    space = spaces.Box(-10.0, 10.0, (4,))
    values = np.array([0.1, 2.0, -3.0, 9.0])
    assert Outputs(space, [2, 0], (), source="")(values).tolist() == [-3.0, 0.1]
    read = Outputs(space, (3, 1, 2), np.array([1, 3]), source="")
    expected = [np.cos(9.0), np.sin(9.0), np.cos(2.0), np.sin(2.0), -3.0]
    assert np.allclose(read(values), expected)
    assert np.allclose(read(np.array([values] * 2), (2,)), [expected] * 2)
    assert values.tolist() == [0.1, 2.0, -3.0, 9.0]
    assert read.low.tolist() == [-1.0] * 4 + [-10.0]
    parts = spaces.Dict(
        camera=spaces.Box(0, 255, (8, 8, 3), np.uint8), place=spaces.Box(-1, 1, (2,)), way=spaces.Box(-4, 4, (1,))
    )
    read = Outputs(parts, ["way", "place"], ["way"], source="")
    assert np.allclose(read({"place": values[:2], "way": values[1:2]}), [0.1, 2.0, np.cos(2.0), np.sin(2.0)])
    assert read.turning == [(2, 3)]


def test_pairs_are_cosines_and_sines_that_are_measured():
    space = spaces.Box(-10.0, 10.0, (5,))
    values = np.arange(5.0)
    read = Outputs(space, [4, 3, 0, 1], [(0, 4), [1, 3]], source="")
    assert read(values).tolist() == [4.0, 3.0, 0.0, 1.0]
    assert read.turning == [(2, 0), (3, 1)]
    assert read.angles == ((0, 4), (1, 3))
    read = Outputs(space, None, [1, (4, 2)], source="")
    assert np.allclose(read(values), [0, np.cos(1), np.sin(1), 2, 3, 4])
    assert read.turning == [(1, 2), (5, 3)]
    assert Outputs(space, None, np.array([[0, 1], [2, 3]]), source="").turning == [(0, 1), (2, 3)]
    joints = spaces.Dict(cos=spaces.Box(-1, 1, (2,)), other=spaces.Box(-1, 1, (1,)), sin=spaces.Box(-1, 1, (2,)))
    assert Outputs(joints, None, [("cos", "sin")], source="").turning == [(0, 3), (1, 4)]


IMAGE = spaces.Box(0, 255, (8, 8, 3), np.uint8)
UNEVEN = spaces.Dict(a=spaces.Box(-1, 1, (1,)), b=spaces.Box(-1, 1, (2,)))
MIXED = spaces.Dict(camera=IMAGE, place=spaces.Box(-1, 1, (2,)), word=spaces.Text(5))


@pytest.mark.parametrize(
    ("space", "measured", "angles", "match"),
    [
        (spaces.Box(-1, 1, (3,)), [3], (), r"measured names entry 3, but .* entries 0 to 2"),
        (spaces.Box(-1, 1, (3,)), [-1], (), "an entry of measured must be an integer, not negative, got -1"),
        (spaces.Box(-1, 1, (3,)), [0, 0], (), r"measured must name each entry once, got \[0, 0\]"),
        (spaces.Box(-1, 1, (3,)), [], (), "at least one entry"),
        (spaces.Box(-1, 1, (3,)), [True, False, True], (), "must be an integer"),
        (spaces.Box(-1, 1, (3,)), ["x"], (), "names 'x', but what is observed has no keys: name indices"),
        (spaces.Box(-1, 1, (3,)), "0", (), "measured must be a sequence of indices or of keys"),
        (spaces.Box(-1, 1, (3,)), 0, (), "measured must be a sequence of indices or of keys"),
        (spaces.Box(-1, 1, (3,)), [0, 1], [2], r"angles must be among what is measured, \(0, 1\), got \(2,\)"),
        (spaces.Box(-1, 1, (3,)), [0, 1], [(0, 2)], r"angles must be among what is measured, \(0, 1\), got"),
        (spaces.Box(-1, 1, (3,)), None, [(0, 3)], "angles names entry 3, but .* entries 0 to 2"),
        (spaces.Box(-1, 1, (3,)), None, [(0, 1), 1], r"angles must name each entry once, got \[0, 1, 1\]"),
        (spaces.Box(-1, 1, (3,)), None, [(0, 1, 2)], r"a cosine and a sine, such as \(0, 1\), got \(0, 1, 2\)"),
        (spaces.Box(-1, 1, (3,)), None, 1, r"angles must be .* pairs of them, such as \[2\] or \[\(0, 1\)\], got 1"),
        (spaces.Box(-1, 1, (3,)), None, [(0, "x")], "indices or keys, not both"),
        (MIXED, ["place"], [(0, 1)], "angles must be keys, as measured is"),
        (UNEVEN, None, [("a", "b")], r"equally many, got \('a', 'b'\), which are 1 and 2 entries"),
        (spaces.Box(-1, 1, (3,)), [0, "x"], (), "indices or keys, not both"),
        (IMAGE, None, (), r"X-v0 is an image, .*: let an encoder .*TransformObservation"),
        (MIXED, None, (), "X-v0, 'camera', is an image"),
        (MIXED, [1], (), "X-v0, 'camera', is an image"),
        (MIXED, ["word"], (), r"holds Text.*convert it by a wrapper inside, or leave its key out"),
        (MIXED, ["speed"], (), "names 'speed', but what is observed has keys 'camera', 'place', 'word'"),
        (MIXED, ["place"], ["camera"], "angles names 'camera', but what is observed has keys 'place'"),
        (MIXED, ["place"], [1], "angles must be keys, as measured is"),
        (spaces.Sequence(spaces.Discrete(2)), None, (), "only Box, Discrete"),
        (spaces.Box(-1, 1, (0,)), None, (), "X-v0 holds no numbers: there is nothing to remember"),
        (spaces.Dict(), None, (), "X-v0 holds no numbers"),
        (spaces.Dict(a=spaces.Box(-1, 1, (0,)), b=spaces.Discrete(2)), ["a"], (), "X-v0 holds no numbers"),
    ],
)
def test_what_cannot_be_measured_says_what_to_do(space, measured, angles, match):
    with pytest.raises(ValueError, match=match):
        Outputs(space, measured, angles, source="X-v0")


@pytest.mark.parametrize(
    ("space", "wrong"),
    [
        (spaces.Box(-1, 1, (2,)), [0.0, np.nan]),
        (spaces.Box(-np.inf, np.inf, (2,)), [0.0, -np.inf]),
        (spaces.Box(-1, 1, (2,)), [0.0]),
        (spaces.Box(-1, 1, (2,)), ["0", "1"]),
        (spaces.Discrete(3), 3),
        (spaces.Discrete(3, start=1), 0),
        (spaces.Discrete(3), 0.5),
        (spaces.MultiDiscrete([2, 2]), [0, 2]),
        (spaces.Tuple([spaces.Discrete(2)] * 2), (0,)),
        (spaces.Dict(a=spaces.Discrete(2)), {}),
    ],
    ids=str,
)
def test_wrong_actions_are_refused(space, wrong):
    with pytest.raises(ValueError, match="the action of X-v0 must"):
        Inputs(space, source="X-v0")(wrong)
    if not isinstance(wrong, tuple | dict):
        with pytest.raises(ValueError, match="the action of X-v0 must"):
            Inputs(space, source="X-v0")(np.array([wrong, wrong]), (2,))


# Around environments


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the folder in which it runs."""
    monkeypatch.chdir(tmp_path)


PACKAGES = {"classic_control": "gymnasium", "toy_text": "gymnasium", "box2d": "Box2D", "mujoco": "mujoco"}
IDS = {
    "classic_control": ["Acrobot-v1", "CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1"],
    "toy_text": ["Blackjack-v1", "FrozenLake-v1"],
    "box2d": ["BipedalWalker-v3", "LunarLander-v3", "LunarLanderContinuous-v3"],
    "mujoco": ["HalfCheetah-v5", "Hopper-v5", "InvertedDoublePendulum-v5", "Reacher-v5"],
}
everywhere = pytest.mark.parametrize(
    "env_id",
    [
        pytest.param(
            env_id,
            marks=pytest.mark.skipif(
                importlib.util.find_spec(PACKAGES[kind]) is None,
                reason=f"{PACKAGES[kind]} is not installed: it comes with the extra envs",
            ),
        )
        for kind, ids in IDS.items()
        for env_id in ids
    ],
)
# What bare environments draw from the checkers, too: unbounded observations, actions that are not in [-1, 1].
as_bare = [
    pytest.mark.filterwarnings(f"ignore:{message}")
    for message in (
        ".*A Box observation space (max|min)imum value is -?infinity",
        ".*we recommend using a symmetric and normalized space",
        "We recommend you to use a symmetric and normalized Box action space",
        ".*is different from the unwrapped version",
        "builtin type (Swig|swig).* has no __module__ attribute:DeprecationWarning",
    )
]


def applied(marks):
    def decorate(test):
        for mark in marks:
            test = mark(test)
        return test

    return decorate


@everywhere
@applied(as_bare)
def test_checkers_are_content(env_id):
    check_env(KKLMemory(gym.make(env_id)), skip_render_check=True)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    if env_id != "BipedalWalker-v3":  # whose reward is no float, bare either
        sb3.check_env(KKLMemory(gym.make(env_id)))


@everywhere
@applied(as_bare)
def test_specs_copies_and_pickles_go_on_alike(env_id):
    env = KKLMemory(gym.make(env_id), measured=[0], time_constants=[1, 3], input_time_constants=np.array([2.0]))
    assert_alike_when_copied(env)


@pytest.mark.parametrize("angles", [[0], [(0, 1)], np.array([[0, 1]]), [[0, 1], 2]], ids=str)
def test_specs_copies_and_pickles_of_memories_of_angles(angles):
    assert_alike_when_copied(KKLMemory(gym.make("Pendulum-v1"), angles=angles))


def assert_alike_when_copied(env):
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, KKLMemory)
    assert again.spec.to_json() == env.spec.to_json()
    assert again.observation_space == env.observation_space
    envs = [env, again, copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    first = [one.reset(seed=3)[0] for one in envs]
    env.action_space.seed(0)
    for _ in range(5):
        action = env.action_space.sample()
        steps = [one.step(action) for one in envs]
        for one, *_ in steps:
            assert np.array_equal(one, steps[0][0])
        if steps[0][2]:
            break
    assert all(np.array_equal(one, first[0]) for one in first)
    assert not np.array_equal(steps[0][0], first[0])
    env.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_a_copy_mid_episode_continues_identically(copied):
    env = KKLMemory(gym.make("CartPole-v1"))
    env.reset(seed=0)
    env.step(1)
    twin = copied(env)
    for action in (0, 0, 1, 0):
        assert np.array_equal(env.step(action)[0], twin.step(action)[0])


@everywhere
@applied(as_bare)
@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_inside_and_outside_of_vectors_it_is_the_same(env_id, vectorization):
    make = partial(gym.make_vec, env_id, num_envs=2, vectorization_mode=vectorization)
    inside, outside = make(wrappers=[KKLMemory]), KKLVectorMemory(make())
    assert inside.single_observation_space == outside.single_observation_space
    assert inside.observation_space == outside.observation_space
    obs = inside.reset(seed=5)[0]
    assert np.array_equal(obs, outside.reset(seed=5)[0])
    assert obs in outside.observation_space
    inside.action_space.seed(0)
    for _ in range(12):
        actions = inside.action_space.sample()
        ours, theirs = outside.step(actions), inside.step(actions)
        for one, other in zip(ours[:4], theirs[:4]):
            assert np.allclose(one, other, rtol=1e-5, atol=1e-6)
    inside.close(), outside.close()


class Walk(gym.Env):
    """A walk in a Dict of all kinds, of random length, that says so in its observation."""

    observation_space = spaces.Dict(
        place=spaces.Box(-np.inf, np.inf, (2,)), mark=spaces.Discrete(3), image=spaces.Box(0, 255, (2, 2), np.uint8)
    )
    action_space = spaces.Tuple([spaces.Box(-2.0, 2.0, (1,)), spaces.Discrete(2)])
    poison: float | None = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.left = self.np_random.normal(size=2).astype(np.float32), int(self.np_random.integers(2, 9))
        return self._seen(), {}

    def _seen(self):
        return {"place": self.place.copy(), "mark": self.left % 3, "image": np.zeros((2, 2), np.uint8)}

    def step(self, action):
        self.left -= 1
        self.place += self.np_random.normal(size=2).astype(np.float32) + action[0]
        if self.poison is not None:
            self.place[1] = self.poison
        return self._seen(), 0.0, self.left == 0, False, {"left": self.left}


def assert_alike(ours, theirs):
    for one, other in zip(ours[:-1], theirs[:-1]):
        assert np.allclose(one, other, rtol=1e-5, atol=1e-5)
    assert set(ours[-1]) == set(theirs[-1])
    for row, final in enumerate(theirs[-1].get("final_obs", ())):
        mine = ours[-1]["final_obs"][row]
        assert (mine is None) == (final is None)
        assert final is None or np.allclose(mine, final, rtol=1e-5, atol=1e-5)


@modes
@pytest.mark.parametrize("kind", ["sync", "async"])
def test_rows_begin_anew_in_every_autoreset_mode(mode, kind):
    arguments = {"measured": ["place", "mark"], "time_constants": [1, 5]}
    vector = partial(SyncVectorEnv if kind == "sync" else AsyncVectorEnv, autoreset_mode=mode)
    ours = KKLVectorMemory(vector([Walk] * 3), **arguments)
    theirs = vector([lambda: KKLMemory(Walk(), **arguments)] * 3)
    assert ours.autoreset_mode is mode
    assert_alike(ours.reset(seed=1), theirs.reset(seed=1))
    ours.action_space.seed(0)
    ends = 0
    for _ in range(25):
        actions = ours.action_space.sample()
        step = ours.step(actions)
        assert_alike(step, theirs.step(actions))
        ended = step[2] | step[3]
        ends += ended.sum()
        if mode is AutoresetMode.DISABLED and ended.any():
            again = [envs.reset(options={"reset_mask": ended.copy()}) for envs in (ours, theirs)]
            assert_alike(*again)
            assert not again[0][0][ended, 5:].any()
    assert ends > 5
    ours.close(), theirs.close()


@modes
def test_native_vectors_that_wait_for_their_reset(mode):
    """In the package's own vectors rows that have ended stay as they are until they are reset."""
    options = {"observe": "output", "max_episode_steps": 5, "autoreset_mode": mode}
    ours = KKLVectorMemory(KKLVectorEnv(Henon(), 3, **options))
    single = KKLMemory(TimeLimit(KKLEnv(Henon(), observe="output"), 5))
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, 1)).astype(np.float32)
    ours.reset(seed=3)
    expected = [single.reset(seed=3)[0]] + [single.step(action)[0] for action in actions[:, 0]]
    for k in range(4):
        assert np.allclose(ours.step(actions[k])[0][0], expected[k + 1], rtol=1e-5, atol=1e-4)
    last, _, _, truncated, info = ours.step(actions[4])
    assert truncated.all()
    if mode is AutoresetMode.SAME_STEP:
        assert np.allclose(info["final_obs"][0], expected[5], rtol=1e-5, atol=1e-4)
    else:
        assert np.allclose(last[0], expected[5], rtol=1e-5, atol=1e-4)
        last = ours.step(actions[0])[0]
        if mode is AutoresetMode.DISABLED:
            assert np.allclose(last[0], expected[5], rtol=1e-5, atol=1e-4)
            last = ours.reset(options={"reset_mask": np.array([True, False, True])})[0]
            assert np.allclose(last[1, 1:], ours.step(actions[0])[0][1, 1:])
    assert not last[0, 1:].any()


def test_gymnasiums_native_vector():
    envs = KKLVectorMemory(CartPoleVectorEnv(4, max_episode_steps=9), measured=[0, 2])
    obs, _ = envs.reset(seed=0)
    assert obs.shape == (4, 14)
    ended, ends = np.zeros(4, dtype=bool), 0
    for _ in range(25):
        obs, _, terminated, truncated, _ = envs.step(np.ones(4, np.int64))
        assert obs in envs.observation_space
        assert np.array_equal(~obs[:, 2:].any(1), ended)  # the step after an end resets
        ended = terminated | truncated
        ends += ended.sum()
    assert ends > 4


def test_the_environment_is_left_as_it_was():
    bare, env = gym.make("Pendulum-v1"), KKLMemory(gym.make("Pendulum-v1"), measured=[1, 0])
    assert np.array_equal(bare.reset(seed=2)[0][[1, 0]], env.reset(seed=2)[0][:2])
    for action in np.random.default_rng(0).uniform(-3, 3, (20, 1)).astype(np.float32):
        theirs, ours = bare.step(action), env.step(action)
        assert np.array_equal(theirs[0][[1, 0]], ours[0][:2])
        assert theirs[1:] == ours[1:]
        assert ours[0] in env.observation_space


def test_under_and_over_the_wrappers_that_people_use():
    env = RecordEpisodeStatistics(TimeLimit(MaxAndSkipObservation(KKLMemory(gym.make("Pendulum-v1")), 4), 3))
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[3] for _ in range(3)]
    assert ends == [False, False, True]
    slow, fast = (KKLMemory(gym.make("Pendulum-v1")) for _ in range(2))
    slow = ActionRepeat(slow, 3)
    slow.reset(seed=0), fast.reset(seed=0)
    obs = slow.step(np.ones(1, np.float32))[0]
    assert np.array_equal(obs, [fast.step(np.ones(1, np.float32))[0] for _ in range(3)][-1])  # it sees every step
    stacked = KKLMemory(FrameStackObservation(gym.make("Pendulum-v1"), 2))
    assert stacked.reset(seed=0)[0].shape == (6 * 5 + 2,)
    assert KKLMemory(gym.make(ENV_IDS["lorenz"])).reset(seed=0)[0].shape == (3 * 5 + 2,)


def test_stable_baselines3_takes_it_as_it_is():
    env_util = pytest.importorskip("stable_baselines3.common.env_util")
    from stable_baselines3.common.vec_env import VecNormalize

    options = {"wrapper_class": KKLMemory, "wrapper_kwargs": {"measured": [0, 1]}}
    envs = VecNormalize(env_util.make_vec_env("Pendulum-v1", n_envs=2, seed=0, **options))
    assert envs.reset().shape == (2, 12)
    env = KKLMemory(gym.make("Pendulum-v1"), measured=[0, 1])
    expected = [env.reset(seed=0)[0]]
    plain = env_util.make_vec_env("Pendulum-v1", n_envs=2, seed=0, **options)
    seen = [plain.reset()[0]]
    for k in range(200):
        action = np.array([np.sin(k)], np.float32)
        expected.append(env.step(action)[0])
        obs, _, done, infos = plain.step(np.array([action] * 2))
        seen.append(infos[0]["terminal_observation"] if done[0] else obs[0])
    assert done.all()
    assert not obs[:, 2:].any()
    assert np.allclose(seen, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -1e20])
def test_what_would_poison_the_memory_is_an_error_that_names_it(poison):
    env = KKLMemory(Walk(), measured=["place"])
    env.reset(seed=0)
    env.unwrapped.poison = poison
    with pytest.raises(ValueError, match=r"the observation of Walk holds .* in entry 1 of 'place': .*TransformObserv"):
        env.step(env.action_space.sample())
    env.unwrapped.poison = None
    env.reset(seed=0)
    assert np.isfinite(env.step(env.action_space.sample())[0]).all()
    envs = KKLVectorMemory(SyncVectorEnv([Walk] * 3), measured=["place"])
    envs.reset(seed=0)
    envs.unwrapped.envs[2].poison = poison
    with pytest.raises(ValueError, match="in entry 1 of 'place', row 2"):
        envs.step(envs.action_space.sample())
    env = KKLMemory(gym.make("Pendulum-v1"))
    before = env.reset(seed=0)[0]
    with pytest.raises(ValueError, match=r"the action of Pendulum-v1 must hold numbers .* got array\(\[nan\]\)"):
        env.step(np.array([np.nan]))
    assert np.array_equal(env.step(np.zeros(1, np.float32))[0][3:], KKLMemory.step(twin(before), np.zeros(1))[0][3:])


def twin(before):
    env = KKLMemory(gym.make("Pendulum-v1"))
    assert np.array_equal(env.reset(seed=0)[0], before)
    return env


def test_float64_without_bounds():
    largest = np.finfo(float).max

    class Wide(Walk):
        observation_space = spaces.Box(-largest, largest, (2,), np.float64)

        def _seen(self):
            return self.place.astype(float)

    env = KKLMemory(Wide())
    assert np.isinf(env.observation_space.high[:10]).all()
    assert env.reset(seed=0)[0] in env.observation_space


def test_wrong_environments_say_what_to_do():
    envs = gym.make_vec("CartPole-v1", num_envs=2)
    with pytest.raises(ValueError, match=r"KKLMemory needs a gymnasium.Env \(for vectors there is KKLVectorMemory"):
        KKLMemory(envs)
    with pytest.raises(ValueError, match=r"KKLVectorMemory needs .* \(for one environment there is KKLMemory\)"):
        KKLVectorMemory(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="the observation of Camera is an image"):
        KKLMemory(Camera())
    envs.unwrapped.metadata = {}
    with pytest.raises(ValueError, match="does not say its autoreset mode"):
        KKLVectorMemory(envs)


class Camera(Walk):
    observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)


def test_other_actions_and_environments_that_take_no_seed():
    class Buttons(gym.Env):
        observation_space, action_space = spaces.Box(-1, 1, (2,)), spaces.MultiBinary(3)

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 0.0, False, False, {}

    env = KKLMemory(Buttons())
    assert env.reset()[0].shape == (2 * 5 + 3 * 2,)
    assert np.allclose(env.step(np.array([1, 0, 1], np.int8))[0][-6:-3], [1 - np.exp(-1), 0, 1 - np.exp(-1)])


@pytest.mark.parametrize(
    ("argument", "value", "match"),
    [
        ("time_constants", (), "time_constants must name at least one"),
        ("time_constants", 4.0, "must be a sequence of numbers of steps"),
        ("time_constants", (1, 1.2), r"each at least 1\.5 times the one before, got 1 and 1\.2"),
        ("time_constants", (4, 2), "must rise"),
        ("time_constants", (0.0,), r"from 0\.5 to 10,000 steps each, got 0$"),
        ("input_time_constants", (1e9,), r"input_time_constants must be from 0\.5 to 10,000 steps each"),
        ("input_time_constants", ("1",), r"input_time_constants must hold real numbers, got \('1',\)"),
    ],
)
def test_wrong_arguments(argument, value, match):
    with pytest.raises(ValueError, match=match):
        KKLMemory(gym.make("Pendulum-v1"), **{argument: value})


entry = st.one_of(st.integers(-2, 5), st.floats(), st.text(max_size=2), st.booleans())
bad = st.one_of(
    st.sampled_from(ATOMS).map(lambda make: make()),
    st.lists(st.one_of(entry, st.lists(entry, max_size=3)), max_size=4),
)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.sampled_from(["measured", "angles", "time_constants", "input_time_constants"]), bad))
def test_any_argument_is_taken_or_refused_by_a_ValueError(arguments):
    refused = None
    try:
        env = KKLMemory(gym.make("CartPole-v1"), **arguments)
    except ValueError as error:
        refused = str(error)
    if refused is not None:
        assert any(name in refused for name in arguments)
        return
    assert env.reset(seed=0)[0] in env.observation_space
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert np.array_equal(again.reset(seed=0)[0], env.reset(seed=0)[0])


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(["Pendulum-v1", "CartPole-v1"]), bad)
def test_any_action_is_taken_or_refused(env_id, action):
    env, bare = KKLMemory(gym.make(env_id)), gym.make(env_id)
    env.reset(seed=0), bare.reset(seed=0)
    refused = None
    try:
        obs = env.step(action)[0]
    except Exception as error:
        refused = error
    if refused is None:
        assert np.isfinite(obs).all()
    elif "the action of" in str(refused):
        assert type(refused) is ValueError
        sound = bare.action_space.sample()
        assert np.array_equal(env.step(sound)[0][:2], bare.step(sound)[0][:2])  # as if it had not been asked
    else:  # the environment's own
        with pytest.raises(type(refused)):
            bare.step(action)
