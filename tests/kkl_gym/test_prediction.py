"""The memory under noise: learned weights of the filters, and how well the features determine a hidden rate."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TransformObservation

from kkl_gym import KKLMemory, KKLVectorMemory


class Noisy(gym.ObservationWrapper):
    """The pendulum's cosine and sine with noise; the rate is hidden."""

    def __init__(self, env, noise=0.1):
        super().__init__(env)
        self.noise = noise
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def observation(self, observation):
        self.hidden = observation
        return (observation[:2] + self.noise * self.np_random.normal(size=2)).astype(np.float32)


def pendulum(**arguments):
    return KKLMemory(Noisy(gym.make("Pendulum-v1")), angles=[(0, 1)], **arguments)


def steps(env, n, seed=1):
    """Observations with the memory, and noiseless observations, under random actions."""
    env.action_space.seed(seed)
    shown, hidden = [env.reset(seed=seed)[0]], [env.env.hidden]
    for _ in range(n):
        obs, _, _, truncated, _ = env.step(env.action_space.sample())
        if truncated:
            obs, _ = env.reset()
        shown.append(obs)
        hidden.append(env.env.hidden)
    return np.array(shown), np.array(hidden)


@pytest.fixture(scope="module")
def weights():
    return pendulum().learn_weights(4_000)


def residual(shown, hidden):
    """Rms error of a linear regression of `hidden` on `shown`, on the second half of the samples."""
    x, half = np.c_[shown, np.ones(len(shown))], len(shown) // 2
    fitted = np.linalg.lstsq(x[:half], hidden[:half], rcond=None)[0]
    return np.sqrt(((x[half:] @ fitted - hidden[half:]) ** 2).mean(0))


def test_four_features_determine_the_rate_under_noise(weights):
    """Two features besides cosine and sine are about as good as a filter that knows the noise."""
    shown, hidden = steps(pendulum(weights=weights), 4_000)
    assert shown.shape[1] == 4
    plain, same = steps(pendulum(), 4_000)
    assert np.array_equal(hidden, same)
    assert residual(shown, hidden[:, 2]) < 0.4 < 0.5 < residual(plain, hidden[:, 2])  # rad/s, out of about 3
    turn = np.arctan2(*hidden[:, 1::-1].T) - np.arctan2(*shown[:, 1::-1].T)
    assert np.sqrt((np.angle(np.exp(1j * (turn + 0.05 * hidden[:, 2]))) ** 2).mean()) < 0.09  # rad
    assert np.allclose(shown[100:, 2:].std(0), 1, atol=0.3)


def test_single_vector_and_specification_agree(weights):
    single = pendulum(weights=weights)
    envs = KKLVectorMemory(
        gym.vector.SyncVectorEnv([lambda: Noisy(gym.make("Pendulum-v1"))] * 2), angles=[(0, 1)], weights=weights
    )
    assert np.allclose(envs.reset(seed=[3, 4])[0][0], single.reset(seed=3)[0], atol=1e-5)
    for _ in range(20):
        shown = single.step(np.float32([1.0]))[0]
        assert np.allclose(envs.step(np.ones((2, 1), np.float32))[0][0], shown, atol=1e-4)
    assert shown in single.observation_space
    made = KKLMemory(gym.make("Pendulum-v1"), angles=[(0, 1)], input_time_constants=())
    made = KKLMemory(
        gym.make("Pendulum-v1"), angles=[(0, 1)], weights=made.learn_weights(3_000), input_time_constants=()
    )
    again = gym.make(EnvSpec.from_json(made.spec.to_json()))
    assert np.array_equal(made.reset(seed=1)[0], again.reset(seed=1)[0])


def test_mere_noise_and_signals_at_rest_leave_nothing_to_show():
    still = gym.make("Pendulum-v1")
    rng = np.random.default_rng(0)
    space = gym.spaces.Box(-np.inf, np.inf, (2,))
    env = KKLMemory(TransformObservation(still, lambda y: np.append(rng.normal(), 5.0).astype(np.float32), space))
    assert np.array(env.learn_weights(3_000)).shape[1] == 2


def test_wrong_weights_and_too_few_steps():
    with pytest.raises(ValueError, match=r"needs .* samples, each followed by 8 more of its episode, got "):
        pendulum().learn_weights(50)
    with pytest.raises(ValueError, match=r"weights must be 18 rows of 1 numbers or more, got the shape \(2, 1\)"):
        pendulum(weights=[[1.0], [2.0]])
    with pytest.raises(ValueError, match="steps must be"):
        pendulum().learn_weights(0)
