"""Steps from twice the training boxes under bounded inputs: all returned arrays are finite and within their spaces."""

from collections import Counter
from itertools import count, product

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from kkl_gym import SYSTEMS, KKLVectorEnv, KKLVectorObservation

LEVELS = ({}, {"process_noise": 0.0, "measurement_noise": 0.0}, {"process_noise": 0.3, "measurement_noise": 2.0})
CASES = list(product(AutoresetMode, LEVELS, ("state", "output")))


def twice(name):
    """The box 2X, as a start box."""
    return np.transpose(SYSTEMS[name]().box(2))


def actions(rng, shape):
    """Random inputs, inputs at their bounds, and inputs beyond the bounds, which environments clip."""
    drawn = rng.uniform(-1, 1, shape).astype(np.float32)
    kind = rng.integers(3)
    return drawn if kind == 0 else np.sign(drawn) if kind == 1 else 3 * drawn


def check(env, obs, info):
    """Check the arrays that an environment returned for all rows."""
    space = getattr(env, "single_observation_space", env.observation_space)
    low, high = np.array(env.unwrapped.system.bounds).T
    assert obs.dtype == np.float32
    assert ((obs >= space.low) & (obs <= space.high)).all()  # false for NaN too
    assert ((info["x"] >= low) & (info["x"] <= high)).all()
    assert all(np.isfinite(info[key]).all() for key in info if not key.startswith(("_", "final")))


def run(envs, steps, seed):
    """Step every row; return the number of steps in which a row moved, and the number of episodes."""
    rng, counts, mode = np.random.default_rng(seed), Counter(), envs.metadata["autoreset_mode"]
    check(envs, *envs.reset(seed=seed))
    over = np.zeros(envs.num_envs, dtype=bool)
    for _ in range(steps):
        obs, reward, terminated, truncated, info = envs.step(actions(rng, envs.action_space.shape))
        check(envs, obs, info)
        assert ((reward > 0) & (reward <= 1) | over & (reward == 0)).all()
        ended = terminated | truncated
        moved = {"steps": ~over, "episodes": ended & ~over, "escapes": terminated & ~over}
        counts.update({kind: int(rows.sum()) for kind, rows in moved.items()})
        if mode is AutoresetMode.SAME_STEP and ended.any():
            final = {key: values[ended] for key, values in info["final_info"].items()}
            check(envs, np.stack(info["final_obs"][ended]), final)
        elif mode is AutoresetMode.DISABLED and ended.mean() > 0.1:
            check(envs, *envs.reset(options={"reset_mask": ended}))
            ended = np.zeros_like(ended)
        over = ended if mode is not AutoresetMode.SAME_STEP else over
    return counts


def campaign(total, rows, length):
    """Make at least `total` steps, divided among all systems and CASES; return counts by system."""
    found, seeds = {name: Counter() for name in SYSTEMS}, count()
    share = total / len(SYSTEMS) / len(CASES)
    for name, (mode, levels, observe) in product(SYSTEMS, CASES):
        envs = KKLVectorEnv(
            name, rows, **levels, observe=observe, start_box=twice(name), autoreset_mode=mode, max_episode_steps=length
        )
        counts = Counter()
        while counts["steps"] < share:  # again if rows waited for a reset: waiting counts no step
            counts += run(envs, int(np.ceil((share - counts["steps"]) / rows)), next(seeds))
        found[name] += counts
    return found


def long(*values):
    return pytest.param(*values, marks=pytest.mark.long)


@pytest.mark.parametrize(("total", "rows", "length"), [(100_000, 64, 12), long(100_000_000, 1024, 500)])
def test_steps_stay_finite_and_within_their_spaces(total, rows, length):
    found = campaign(total, rows, length)
    print(f"\nfrom 2X: {', '.join(f'{name} {dict(counts)}' for name, counts in found.items())}")
    assert sum(counts["steps"] for counts in found.values()) >= total
    assert all(counts["episodes"] > 0 for counts in found.values())


@pytest.mark.parametrize(
    ("name", "estimate", "rows", "steps", "length"),
    [
        ("lorenz", "x", 50, 40, 12),
        ("reverse_duffing", "z", 50, 40, 12),
        *(long(name, estimate, 1024, 170, 100) for name in SYSTEMS for estimate in ("x", "z")),
    ],
)
def test_estimates_stay_finite_and_within_their_spaces(name, estimate, rows, steps, length):
    for mode in AutoresetMode:
        envs = KKLVectorEnv(name, rows, start_box=twice(name), autoreset_mode=mode, max_episode_steps=length)
        run(KKLVectorObservation(envs, estimate=estimate), steps, seed=0)
