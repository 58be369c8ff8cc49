"""Comparison of a vector environment with Gymnasium's own vector of single environments."""

import numpy as np
from gymnasium.vector import AutoresetMode

# Tolerance for the float32 networks T_inv and T (known starts), whose values are about ten: their rounding depends on
# the size of the batch and on the processor.
NETWORK = 1e-4


def assert_same(ours, theirs, at="", z=1e-9):
    """Assert that ``ours`` holds all values of ``theirs`` to rounding, and z to the tolerance ``z``."""
    if isinstance(theirs, tuple):
        for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(one, other, f"{at}[{i}] ", z)
    elif isinstance(theirs, dict):
        for key, value in theirs.items():
            if not key.startswith("_"):
                rows = theirs.get(f"_{key}", ...)  # an observation has no mask: all rows
                assert rows is ... or (ours[f"_{key}"] == rows).all(), f"{at}_{key}"
                if key in ("final_obs", "final_info"):
                    assert_same(ours[key], value, f"{at}{key}.", z)
                else:
                    assert_same(np.asarray(ours[key])[rows], np.asarray(value)[rows], f"{at}{key}", z)
    elif np.asarray(theirs).dtype == object:
        for a, b in zip(ours, theirs, strict=True):
            assert (a is None) == (b is None)
            if b is not None:
                assert_same(a, b, at, NETWORK)
    else:
        ours, theirs = np.asarray(ours), np.asarray(theirs)
        assert ours.dtype == theirs.dtype, at
        network = ours.dtype == np.float32 or at.endswith("x_hat")
        tolerance = NETWORK if network else z if at.endswith("z") else 1e-9
        assert np.allclose(ours, theirs, rtol=tolerance, atol=tolerance), (at, np.abs(ours - theirs).max())


def compare(ours, theirs, actions, mode, mask_at=(5,), z=1e-9, infos=None):
    """Make the same calls to both and compare the results; resets of some rows make episodes end at different times.

    Of ``info`` the keys in ``infos`` are compared, or all. Returns the steps and rows in which episodes end.
    """

    def compared(*results, at=""):
        if infos is not None:
            results = [(*rest, {k: v for k, v in info.items() if k.lstrip("_") in infos}) for *rest, info in results]
        assert_same(*results, at, z)

    both = (ours, theirs)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    compared(*(env.reset(seed=7) for env in both))
    ended = np.zeros(ours.num_envs, dtype=bool)
    ends = set()
    for k, action in enumerate(actions):
        mask = ended.copy() if mode is AutoresetMode.DISABLED else np.zeros_like(ended)
        if k in mask_at:
            mask[::2] = True
        if mask.any():
            compared(*(env.reset(options={"reset_mask": mask.copy()}) for env in both), at=f"reset before {k} ")
        results = [env.step(action) for env in both]
        compared(*results, at=f"step {k} ")
        assert results[0][0] in ours.observation_space
        ended = results[0][2] | results[0][3]
        ends |= {(k + late, row) for late, flags in enumerate(results[0][2:4]) for row in np.flatnonzero(flags)}
    for env in both:
        env.close()
    return ends
