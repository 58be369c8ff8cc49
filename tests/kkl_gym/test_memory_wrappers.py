"""The memory around Gymnasium's own environments, single and in vectors."""

import copy
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from alike_vectors import compare
from discrete_systems import Henon
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from kkl_gym import OWN_ID, KKLMemory, KKLVectorEnv, KKLVectorMemory

modes = pytest.mark.parametrize("mode", list(AutoresetMode))
# What bare environments draw from the checkers, too: unbounded observations, actions that are not in [-1, 1].
pytestmark = [
    pytest.mark.filterwarnings(f"ignore:{message}")
    for message in (
        ".*A Box observation space (max|min)imum value is -?infinity",
        ".*we recommend using a symmetric and normalized space",
        "We recommend you to use a symmetric and normalized Box action space",
        ".*is different from the unwrapped version",
        "builtin type (Swig|swig).* has no __module__ attribute:DeprecationWarning",
    )
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the folder in which it runs."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("env_id", "package"),
    [
        ("CartPole-v1", "gymnasium"),
        ("Pendulum-v1", "gymnasium"),
        ("Blackjack-v1", "gymnasium"),
        ("BipedalWalker-v3", "Box2D"),
        ("Reacher-v5", "mujoco"),
    ],
)
def test_checkers_are_content(env_id, package):
    pytest.importorskip(package)
    check_env(KKLMemory(gym.make(env_id)), skip_render_check=True)
    if env_id != "BipedalWalker-v3":  # whose reward is no float, bare either
        pytest.importorskip("stable_baselines3.common.env_checker").check_env(KKLMemory(gym.make(env_id)))


@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [
        ("Blackjack-v1", {"measured": [0], "time_constants": [1, 3], "input_time_constants": np.array([2.0])}),
        ("Pendulum-v1", {"angles": [0], "period": 2}),
        ("Pendulum-v1", {"angles": [[0, 1], 2], "period": 360}),
        ("Pendulum-v1", {"angles": np.array([[0, 1]])}),
    ],
    ids=str,
)
def test_specs_copies_and_pickles_go_on_alike(env_id, arguments):
    env = KKLMemory(gym.make(env_id), **arguments)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, KKLMemory)
    assert again.spec.to_json() == env.spec.to_json()
    assert again.observation_space == env.observation_space
    env.action_space.seed(0)
    action = env.action_space.sample()
    first = [one.reset(seed=3)[0] for one in (env, again)]
    steps = [one.step(action)[0] for one in (env, again)]
    for twins in (first, steps):
        assert np.array_equal(*twins)
    assert not np.array_equal(first[0], steps[0])
    if env_id == "Pendulum-v1":  # in the midst of an episode
        for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
            assert np.array_equal(twin.step(action)[0], copy.deepcopy(env).step(action)[0])


class Walk(gym.Env):
    """A walk in a Dict of all kinds, of random length, that says so in its observation."""

    observation_space = spaces.Dict(
        place=spaces.Box(-np.inf, np.inf, (2,)),
        mark=spaces.Discrete(3),
        image=spaces.Box(0, 255, (2, 2), np.uint8),
        way=spaces.Box(-np.inf, np.inf, (1,)),
    )
    action_space = spaces.Tuple([spaces.Box(-2.0, 2.0, (1,)), spaces.Discrete(2)])
    poison: float | None = None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.left = self.np_random.normal(size=2).astype(np.float32), int(self.np_random.integers(2, 9))
        return self._seen(), {}

    def _seen(self):
        place = self.place.copy()
        return {"place": place, "mark": self.left % 3, "image": np.zeros((2, 2), np.uint8), "way": place[1:]}

    def step(self, action):
        self.left -= 1
        self.place += self.np_random.normal(size=2).astype(np.float32) + action[0]
        if self.poison is not None:
            self.place[1] = self.poison
        return self._seen(), 0.0, self.left == 0, False, {"left": self.left}


@pytest.mark.parametrize(
    ("mode", "kind", "angles"),
    [
        *((mode, SyncVectorEnv, angles) for mode in AutoresetMode for angles in ((), ["way"])),
        (AutoresetMode.SAME_STEP, AsyncVectorEnv, ["way"]),
    ],
)
def test_rows_begin_anew_in_every_autoreset_mode(mode, kind, angles):
    arguments = {"measured": ["place", "mark", "way"], "angles": angles, "time_constants": [1, 5]}
    ours = KKLVectorMemory(kind([Walk] * 3, autoreset_mode=mode), **arguments)
    theirs = kind([lambda: KKLMemory(Walk(), **arguments)] * 3, autoreset_mode=mode)
    ours.action_space.seed(0)
    assert ours.autoreset_mode is mode
    assert len(compare(ours, theirs, [ours.action_space.sample() for _ in range(25)], mode, ())) > 5


@modes
def test_native_vectors_that_wait_for_their_reset(mode):
    """In the package's own vectors rows that have ended stay as they are until they are reset."""
    options = {"observe": "output", "max_episode_steps": 5}
    envs = KKLVectorEnv(Henon(), 3, autoreset_mode=mode, **options)
    single = partial(gym.make, OWN_ID, system=Henon(), **options)
    rows = SyncVectorEnv([lambda: KKLMemory(single())] * 3, autoreset_mode=mode)
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 3, 1)).astype(np.float32)
    assert len(compare(KKLVectorMemory(envs), rows, actions, mode, (3,))) > 6


@pytest.mark.parametrize("poison", [np.nan, -1e20])
def test_what_would_poison_the_memory_is_an_error_that_names_it(poison):
    env = KKLMemory(Walk(), measured=["place"])
    env.reset(seed=0)
    env.unwrapped.poison = poison
    with pytest.raises(ValueError, match=r"the observation of Walk holds .* in entry 1 of 'place': .*TransformObserv"):
        env.step(env.action_space.sample())
    env.unwrapped.poison = None
    env.reset(seed=0)
    assert np.isfinite(env.step(env.action_space.sample())[0]["memory"]).all()
    envs = KKLVectorMemory(SyncVectorEnv([Walk] * 3), measured=["place"])
    envs.reset(seed=0)
    envs.unwrapped.envs[2].poison = poison
    with pytest.raises(ValueError, match="in entry 1 of 'place', row 2"):
        envs.step(envs.action_space.sample())


def test_wrong_environments_say_what_to_do():
    envs = gym.make_vec("CartPole-v1", num_envs=2)
    with pytest.raises(ValueError, match=r"KKLVectorMemory"):
        KKLMemory(envs)
    with pytest.raises(ValueError, match=r"KKLMemory\)"):
        KKLVectorMemory(gym.make("CartPole-v1"))
    envs.unwrapped.metadata = {}
    with pytest.raises(ValueError, match="does not declare its autoreset mode"):
        KKLVectorMemory(envs)


def dial(high=180.0, low=None, **arguments):
    """A memory of a dial that turns by 0.1 turns in each step, in other units than rad."""

    class Dial(gym.Env):
        observation_space = spaces.Box(-high if low is None else low, high, (1,))
        action_space = spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            self.turns = 0.0
            return self.step(0)[0], {}

        def step(self, action):
            self.turns += 0.1
            turn = 2 * high if low is None else 1 + high
            return np.float32([(self.turns + 0.5) % 1 * turn + (-high if low is None else 0)]), 0.0, False, False, {}

    return KKLMemory(Dial(), angles=[0], input_time_constants=(), **arguments)


def test_the_period_of_angles_follows_from_the_bounds_or_is_given():
    shown = []
    for env in (dial(np.pi), dial(180.0), dial(4095.0, 0.0, period=4096)):
        env.reset()
        shown.append([env.step(0)[0][2:] for _ in range(30)])
    assert np.allclose(shown[0], shown[0][-1], atol=0.03)  # a steady turn
    for other in shown[1:]:
        assert np.allclose(shown[0], other, atol=1e-3)
    for low, high in [(0.0, 4095.0), (-0.5, 0.5), (-1.0, 1.0), (-45.0, 45.0), (-3600.0, 3600.0)]:  # counts, turns, ...
        with pytest.raises(ValueError, match=f"the period of the .* unknown: its bounds are {low:g} and {high:g}"):
            dial(high, low)
    with pytest.raises(ValueError, match="period must be the positive length of a turn, such as 360, got -1"):
        dial(period=-1)
    with pytest.raises(ValueError, match="period = 360 has no effect: angles names only pairs, or no entry"):
        KKLMemory(gym.make("Pendulum-v1"), angles=[(0, 1)], period=360)


@modes
def test_missing_values_are_held_within_an_episode(mode):
    class Losing(Walk):
        """Loses the second place in every third step, and never the first sample."""

        observation_space = spaces.Box(-np.inf, np.inf, (2,))

        def _seen(self):
            return np.where([False, self.left % 3 == 0], np.float32(np.nan), self.place)

        def reset(self, **arguments):
            super().reset(**arguments)
            return self.place.copy(), {}

    ours = KKLVectorMemory(SyncVectorEnv([Losing] * 3, autoreset_mode=mode), missing="hold")
    rows = SyncVectorEnv([lambda: KKLMemory(Losing(), missing="hold")] * 3, autoreset_mode=mode)
    ours.action_space.seed(0)
    assert len(compare(ours, rows, [ours.action_space.sample() for _ in range(25)], mode, ())) > 5
    env = KKLMemory(Losing(), missing="hold")
    before, held = env.reset(seed=0)[0], 0
    for _ in range(env.unwrapped.left):
        after = env.step(env.action_space.sample())[0]
        held += after[1] == before[1]
        assert np.isfinite(after).all()
        before = after
    assert held > 0
    with pytest.raises(ValueError, match="missing must be 'error' or 'hold', got 'coast'"):
        KKLMemory(Losing(), missing="coast")


def test_a_dict_stays_a_dict():
    """With images and other keys as they are, in memory of its own, and with cosine and sine where angles are none."""
    env = KKLMemory(Walk(), angles=["way"], input_time_constants=())
    first = env.reset(seed=0)[0]
    assert first in env.observation_space
    assert list(first) == ["place", "mark", "image", "way", "memory"]
    assert first["memory"].shape == (2 + (3 + 2 + 1) * 4,)
    place = first["place"].copy()
    second = env.step(env.action_space.sample())[0]
    assert np.array_equal(first["place"], place)
    assert np.allclose(second["memory"][:2], [np.cos(second["way"][0]), np.sin(second["way"][0])])
    flat = KKLMemory(gym.wrappers.FilterObservation(Walk(), ["place"]), measured=[0, 1])
    assert np.array_equal(flat.reset(seed=0)[0][:2], place)  # entries are shown flat
    with pytest.raises(ValueError, match="a key named memory"):
        KKLMemory(env)


class Reusing(Walk):
    """Writes each observation into the same arrays."""

    seen = None

    def _seen(self):
        new = super()._seen()
        self.seen = self.seen or new
        for key in ("place", "image", "way"):
            self.seen[key][...] = new[key]
        self.seen["mark"] = new["mark"]
        return self.seen


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_arrays_that_an_environment_uses_again_are_copied(mode):
    ours, theirs = (
        SyncVectorEnv([lambda: KKLMemory(kind())] * 2, autoreset_mode=mode)  # noqa: B023
        for kind in (Reusing, Walk)
    )
    ours.action_space.seed(0)
    assert len(compare(ours, theirs, [ours.action_space.sample() for _ in range(20)], mode, ())) > 3


@pytest.mark.parametrize("kind", [KKLMemory, KKLVectorMemory])
def test_autoreset_inside_is_refused(kind):
    env = gym.wrappers.Autoreset(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="Autoreset hides where episodes begin"):
        kind(env if kind is KKLMemory else SyncVectorEnv([lambda: env]))
