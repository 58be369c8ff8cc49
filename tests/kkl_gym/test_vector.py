"""Vector environments and wrappers against Gymnasium's own vectors of single environments."""

import copy
import pickle
from functools import partial
from itertools import count

import gymnasium as gym
import numpy as np
import pytest
from alike_vectors import NETWORK, assert_same, compare
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import kkl_gym
from kkl_gym import (
    ENV_IDS,
    ActionRepeat,
    KKLObservation,
    KKLVectorEnv,
    KKLVectorObservation,
    Lorenz,
    VectorActionRepeat,
)
from kkl_gym.plant import NOISE_BLOCK
from kkl_gym.simulate import advance_batch

modes = pytest.mark.parametrize("mode", list(AutoresetMode))
N, MANY_ROWS = 4, 128
ESCAPING = [-44.0, -17.0, 212.0]  # for Rossler; escapes within a few steps


def actions(steps, n=N, seed=0):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (steps, n, 1)).astype(np.float32)


def vector(name, mode, steps=23, n=N, **options):
    return gym.make_vec(
        ENV_IDS[name],
        num_envs=n,
        vectorization_mode="vector_entry_point",
        max_episode_steps=steps,
        autoreset_mode=mode,
        **options,
    )


def single(name, steps=23, observer=None, repeat=None, estimate="x", known_start=False, **options):
    env = gym.make("kkl_gym:" + ENV_IDS[name], max_episode_steps=steps, **options)
    if observer is not None:
        env = KKLObservation(env, observer, estimate=estimate, known_start=known_start)
    return env if repeat is None else ActionRepeat(env, repeat)


def sync(name, mode, n=N, **options):
    return SyncVectorEnv([partial(single, name, **options)] * n, autoreset_mode=mode)


@modes
@pytest.mark.parametrize(("name", "observe"), [("lorenz", "state"), ("van_der_pol", "output")])
def test_rows_are_single_environments(name, mode, observe):
    ends = compare(vector(name, mode, observe=observe), sync(name, mode, observe=observe), actions(60), mode)
    assert len({k for k, _ in ends}) > 2  # episodes end at different times
    assert {row for _, row in ends} == set(range(N))


@pytest.mark.parametrize("estimate", ["x", "z"])
@modes
def test_many_rows_equal_few_rows(estimate, mode, saved):
    """With a compiled filter, compiled observations and a shipped map that tracks."""
    path = None if estimate == "x" else saved(system="lorenz")
    many, few = (KKLVectorObservation(vector("lorenz", mode, n=n), path, estimate=estimate) for n in (MANY_ROWS, N))
    results = [many.reset(seed=7), few.reset(seed=7)]
    waits, halves = count(), count()
    for action in actions(60, MANY_ROWS):
        (obs, *_, info), (obs_few, *_, info_few) = results
        assert np.allclose(obs[:N], obs_few, rtol=NETWORK, atol=NETWORK)
        for key in info_few.keys() - {"final_obs", "final_info"}:
            tolerance = NETWORK if key == "x_hat" else 1e-9
            assert np.allclose(info[key][:N], info_few[key], rtol=tolerance, atol=tolerance), key
        ended = results[1][2] | results[1][3] if len(results[1]) == 5 else np.zeros(N, dtype=bool)
        if mode is AutoresetMode.DISABLED and ended.any() and next(waits) % 3 == 2:  # reset a few steps after the end
            mask = np.arange(MANY_ROWS) % 2 == next(halves) % 2
            masks = mask, mask[:N]
            results = [env.reset(options={"reset_mask": mask}) for env, mask in zip((many, few), masks, strict=True)]
        else:
            results = [many.step(action), few.step(action[:N])]


def test_rows_are_single_environments_without_numba(monkeypatch):
    monkeypatch.setattr(kkl_gym.vector, "batch_step", lambda system: partial(advance_batch, system))
    mode = AutoresetMode.SAME_STEP
    assert compare(vector("van_der_pol", mode), sync("van_der_pol", mode), actions(60), mode)


@modes
@pytest.mark.parametrize("repeat", [None, 4])
def test_escapes_in_some_rows(mode, repeat):
    x0 = [ESCAPING, [1.0, 1.0, 1.0]]
    ours = vector("rossler", mode if repeat is None else "Disabled", 400, 2)
    ours = ours if repeat is None else VectorActionRepeat(ours, repeat, mode)
    theirs = sync("rossler", mode, 2, steps=400, repeat=repeat)
    ours.reset(seed=3, options={"x0": x0})
    theirs.reset(seed=3)
    for row, env in enumerate(theirs.envs):
        env.reset(seed=3 + row, options={"x0": x0[row]})

    def step():
        results = [env.step(np.zeros((2, 1))) for env in (ours, theirs)]
        assert_same(*results)
        return results[0]

    for _ in range(300):
        obs, _, terminated, truncated, info = step()
        assert np.isfinite(obs).all()
        if terminated.any():
            break
    assert terminated.tolist() == [True, False]
    assert not truncated.any()
    info = info["final_info"] if mode is AutoresetMode.SAME_STEP else info
    assert info["escaped"].tolist() == [True, False]
    if mode is AutoresetMode.DISABLED:
        for env in (ours, theirs):
            env.reset(options={"reset_mask": terminated})
    step()


@modes
@pytest.mark.parametrize(
    ("make", "estimate", "known_start"),
    [(vector, "x", False), (vector, "z", False), (vector, "x", True), (sync, "x", False), (sync, "z", True)],
)
def test_the_observer_is_reset_row_by_row(make, mode, estimate, known_start, saved):
    options = {"estimate": estimate, "known_start": known_start}
    path = saved(system="lorenz", forward=True)
    ours = KKLVectorObservation(make("lorenz", mode), path, **options)
    theirs = sync("lorenz", mode, observer=path, **options)
    if known_start:
        T, (_, info) = ours.observer.artifact.forward, ours.reset(seed=0)
        assert np.allclose(info["z"][:, : T.mlp.outputs], T(info["x"]), rtol=1e-6)
    assert len(compare(ours, theirs, actions(60), mode, z=NETWORK if known_start else 1e-9)) >= 2 * N


def test_the_observer_inside_gymnasiums_async_vector(saved):
    path, mode = saved(), AutoresetMode.SAME_STEP
    inner = AsyncVectorEnv([partial(single, "van_der_pol")] * 2, autoreset_mode=mode, context="spawn")
    theirs = sync("van_der_pol", mode, n=2, observer=path)
    assert len(compare(KKLVectorObservation(inner, path), theirs, actions(60, 2), mode)) >= 4


@modes
@pytest.mark.parametrize(("steps", "estimate"), [(20, None), (23, "x")])  # 23: ends within a repeat
def test_action_repeat(mode, steps, estimate, saved):
    path = None if estimate is None else saved()
    inner = vector("van_der_pol", "Disabled", steps)
    if path is not None:
        inner = KKLVectorObservation(inner, path)
    ours = VectorActionRepeat(inner, 4, mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert inner.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    theirs = sync("van_der_pol", mode, steps=steps, observer=path, repeat=4)
    assert len(compare(ours, theirs, actions(40), mode, (2,))) >= 3 * N


def test_rows_that_have_ended_stay_until_they_are_reset():
    env, first = vector("lorenz", "Disabled", 3), np.array([True, False, False, False])
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.ones((N, 1)))
    env.reset(options={"reset_mask": first})
    obs, *_ = env.step(np.ones((N, 1)))
    again, reward, terminated, truncated, info = env.step(np.ones((N, 1)))
    assert truncated.tolist() == [False, True, True, True]
    assert (obs == again).all(1).tolist() == [False, True, True, True]
    assert (reward > 0).tolist() == info["_u"].tolist() == first.tolist()
    assert info["sample"].tolist() == [2, 3, 3, 3]
    assert not terminated.any()


def test_seeds():
    env = vector("lorenz", "NextStep")
    whole, info = env.reset(seed=5)
    noisy = info["y"]
    assert env.unwrapped.np_random_seed == (5, 6, 7, 8)
    assert (gym.make("KKLLorenz-v0").reset(seed=6)[0] == whole[1]).all()
    for same in (np.int64(5), np.arange(5, 9), (5, 6, 7, 8), [5, 6, 7, 8], np.array(5)):
        assert (env.reset(seed=same)[1]["y"] == noisy).all()
        after = env.step(np.zeros((N, 1)))[4]["y"]
    mixed, _ = env.reset(seed=[8, None, 5, None])
    assert (mixed[[0, 2]] == whole[[3, 0]]).all()
    assert (mixed[[1, 3]] != whole[[1, 3]]).any(1).all()
    mask = np.array([False, True, False, True])
    _, info = env.reset(seed=5, options={"reset_mask": mask})
    assert (info["y"][mask] == noisy[mask]).all()
    assert (env.step(np.zeros((N, 1)))[4]["y"][mask] == after[mask]).all()
    env.reset(seed=5)
    env.reset(seed=[None, 77, None, None], options={"reset_mask": np.array([True, True, False, False])})
    assert env.unwrapped.np_random_seed == (5, 77, 7, 8)
    assert len(np.unique(vector("lorenz", "NextStep").reset()[0][:, 0])) == N


def test_starts():
    env = vector("lorenz", "NextStep", process_noise=0.0)
    start = [1.0, 2.0, 20.0]
    assert (env.reset(options={"x0": start})[0] == start).all()
    many = np.arange(3 * N).reshape(N, 3) * 1.0
    assert (env.reset(options={"x0": many})[0] == many).all()
    mask = np.array([False, True, False, False])
    obs, info = env.reset(options={"x0": start, "reset_mask": mask})
    assert (obs[1] == start).all()
    assert (obs[[0, 2, 3]] == many[[0, 2, 3]]).all()
    assert (info["_x"] == mask).all()
    obs, _ = env.reset(options={"x0": -many, "reset_mask": [False, False, True, True]})
    assert (obs == np.concatenate([many[:1], [start], -many[2:]])).all()


def test_reset_is_required():
    env = KKLVectorEnv("lorenz", 2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 1)))
    with pytest.raises(gym.error.ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False])})


@modes
def test_results_are_copies(mode, saved):
    """Overwriting returned arrays does not change later results."""
    one, two = (KKLVectorObservation(vector("van_der_pol", mode, 3), saved()) for _ in range(2))

    def spoil(value):
        if isinstance(value, dict) or value.dtype == object:
            for part in value.values() if isinstance(value, dict) else value:
                if part is not None:
                    spoil(part)
        else:
            value[:] = 1

    returned, expected = one.reset(seed=0), two.reset(seed=0)
    for action in actions(8):
        assert_same(returned, expected)
        for value in returned:
            spoil(value)
        returned, expected = one.step(action), two.step(action)


def test_copies_go_on_identically(saved):
    env = KKLVectorObservation(vector("lorenz", "SameStep", 7), saved(system="lorenz"))
    env.reset(seed=0)
    for action in actions(5):
        env.step(action)
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        original = copy.deepcopy(env)
        for action in actions(10, seed=1):
            assert_same(twin.step(action)[0], original.step(action)[0])


def test_frames_are_those_of_single_environments(saved):
    pytest.importorskip("matplotlib")
    path, mode = saved(), AutoresetMode.SAME_STEP
    ours = KKLVectorObservation(vector("van_der_pol", mode, 4, n=2, render_mode="rgb_array"), path)
    theirs = sync("van_der_pol", mode, n=2, steps=4, observer=path, render_mode="rgb_array")
    both = (ours, theirs)
    for env in both:
        env.reset(seed=0)
    for k, action in enumerate(actions(6, 2)):
        mine, other = (env.render() for env in both)
        for one, two in zip(mine, other, strict=True):
            assert one.shape == (480, 480, 3)
            assert one.dtype == np.uint8
            assert np.abs(one.astype(int) - two).max() <= 1  # rounding of the estimates may shift a colour by one
        for env in both:
            if k == 2:  # so that episodes end at different times
                env.reset(options={"reset_mask": np.array([True, False])})
            env.step(action)


def test_a_repeat_inside_the_observer_is_noticed(saved):
    path = saved(system="lorenz")
    for env in (
        KKLObservation(ActionRepeat(single("lorenz"), 2), path),
        KKLVectorObservation(VectorActionRepeat(vector("lorenz", "Disabled"), 2), path),
    ):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"outside KKL(Vector)?Observation"):
            env.step(np.zeros(env.action_space.shape))


def test_wrappers_that_change_info_inside_the_observer_are_named(saved):
    inner = gym.wrappers.vector.DictInfoToList(KKLVectorEnv("van_der_pol", 2))
    with pytest.raises(ValueError, match=r"DictInfoToList.*changes info: put wrappers such as DictInfoToList"):
        KKLVectorObservation(inner, saved()).reset(seed=0)


def test_foreign_and_mixed_vectors(saved):
    with pytest.raises(ValueError, match="needs a vector of kkl_gym environments"):
        KKLVectorObservation(gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync"))
    mixed = SyncVectorEnv([partial(single, "lorenz", measurement_noise=noise) for noise in (0.1, 0.2)])
    with pytest.raises(ValueError, match="one observer cannot serve all"):
        KKLVectorObservation(mixed, saved(system="lorenz"))
    with pytest.raises(ValueError, match=r"rho.*on purpose, wrap .* set env\.unwrapped\.system"):
        KKLVectorObservation(vector("lorenz", "NextStep", parameters={"rho": 20.0}), saved(system="lorenz"))
    envs = SyncVectorEnv([partial(single, "lorenz")] * 2)
    observed = KKLVectorObservation(envs, saved(system="lorenz"))
    envs.set_attr("system", [Lorenz(rho=20.0), Lorenz(rho=24.0)])
    observed.reset(seed=0, options={"x0": [1.0, 1.0, 20.0]})
    x, y = observed.step(np.zeros((2, 1)))[4]["x"]
    assert x[1] != y[1]


def test_a_blind_map_under_action(saved):
    path = saved(inputs=False)
    env = KKLVectorObservation(vector("van_der_pol", "NextStep"), path)
    env.reset(seed=0)
    env.step(np.zeros((N, 1)))
    with pytest.raises(ValueError, match="takes no inputs"):
        env.step(np.ones((N, 1)))
    with pytest.raises(ValueError, match="reset after an error"):  # the observer has missed a sample
        env.step(np.zeros((N, 1)))


def test_noise_does_not_repeat_and_blocks_are_refilled_row_by_row():
    steps = 2 * NOISE_BLOCK + 10
    ours, theirs = vector("lorenz", "SameStep", 31), sync("lorenz", "SameStep", steps=31)
    assert compare(ours, theirs, actions(steps), None, (3, 4, 40))
