"""Standard deviations of the estimate in observations of single and vector environments."""

import gymnasium as gym
import numpy as np
import pytest
from error_bars import with_error_bars
from gymnasium.utils.env_checker import check_env
from random_artifacts import random_artifact
from random_tracking import tracking

from kkl_gym import KKLObservation, KKLVectorObservation
from observers import ArtifactError


@pytest.fixture(scope="module", params=[random_artifact, tracking], ids=["static", "tracking"])
def path(request, tmp_path_factory):
    file = tmp_path_factory.mktemp("maps") / "map.safetensors"
    with_error_bars(request.param(system="van_der_pol", free_inverse=True, process=True)).save(file)
    return str(file)


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_single(path):
    env = KKLObservation(gym.make("KKLVanDerPol-v0"), path, uncertainty=True)
    check_env(env, skip_render_check=True)
    assert env.spec.additional_wrappers[-1].kwargs["uncertainty"] is True
    assert env.observation_space.shape == (4,)
    assert (env.observation_space.low[2:] == 0).all()
    obs, info = env.reset(seed=0)
    for _ in range(5):
        obs, _, _, _, info = env.step([0.3])
    space = env.observation_space
    shown = np.concatenate([info["x_hat"], np.sqrt(np.diag(info["x_cov"]))])
    np.testing.assert_allclose(obs, np.clip(shown, space.low, space.high), rtol=1e-6)
    np.testing.assert_array_equal(info["x_cov"], env.observer.covariance)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_vector_is_single(path, mode):
    envs = gym.make_vec("KKLVanDerPol-v0", num_envs=3, autoreset_mode=mode, max_episode_steps=4)
    envs = KKLVectorObservation(envs, path, uncertainty=True)
    singles = [KKLObservation(gym.make("KKLVanDerPol-v0"), path, uncertainty=True) for _ in range(3)]
    assert envs.observation_space.shape == (3, 4)
    obs, info = envs.reset(seed=0)
    alone = [single.reset(seed=i) for i, single in enumerate(singles)]
    for k in range(5):
        for i, (expected, *_, its) in enumerate(alone):
            np.testing.assert_allclose(obs[i], expected, rtol=1e-3, atol=1e-4)
            np.testing.assert_allclose(info["x_cov"][i], its["x_cov"], rtol=1e-3, atol=1e-6)
        if k < 4:
            obs, _, _, _, info = envs.step(np.full((3, 1), 0.2))
            alone = [single.step([0.2]) for single in singles]
            if mode == "SameStep" and k == 3:
                np.testing.assert_allclose(info["x_cov"], envs.observer.covariance, rtol=1e-6)
                info, obs = info["final_info"], np.stack(info["final_obs"])


def test_errors_of_observers_without_covariances(path, saved):
    plain = saved(system="van_der_pol", dt=0.01)
    env = gym.make("KKLVanDerPol-v0")
    with pytest.raises(ArtifactError, match="no covariance"):
        KKLObservation(env, plain, uncertainty=True)
    with pytest.raises(ValueError, match="estimate='x'"):
        KKLObservation(env, path, uncertainty=True, estimate="z")
    with pytest.raises(ArtifactError, match="no covariance"):
        KKLObservation(env, path, uncertainty=True).replace_observer(plain)
    assert "x_cov" not in KKLObservation(env, path).reset(seed=0)[1]
