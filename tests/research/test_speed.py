"""python -m examples.research speed."""

import re
import sys

import linear_system
import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
from rich.console import Console

import kkl_gym
import observers
from examples.research.benchmark.protocol import run
from examples.research.speed.observers import limit, observer_tasks, table_rows
from examples.research.speed.speed import Speed, timed, timed_vector
from kkl_gym import get_system
from kkl_gym.simulate import simulate
from training.commands import speed, speed_observers
from training.kalman import ExtendedKalmanFilter
from training.progress import progress_bars


class Clock:
    """Time that passes only where it is told to."""

    def __init__(self):
        self.now = 100.0

    def process_time(self):
        return self.now


class Env:
    """A reset takes a second, a step a quarter; episodes have three steps."""

    def __init__(self, clock):
        self.clock, self.taken = clock, []

    def reset(self, seed=None):
        self.clock.now += 1.0

    def step(self, action):
        self.clock.now += 0.25
        self.taken.append(action)
        return None, 0.0, len(self.taken) == 3, len(self.taken) == 6, {}


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(speed, "time", clock)
    return clock


def test_steps_and_resets_of_ended_episodes_are_timed_but_not_the_first_reset(clock):
    env, actions = Env(clock), list(range(7))
    assert timed(env, actions) == 7 * 0.25 + 2 * 1.0
    assert env.taken == actions


def test_vector_environments_reset_by_themselves(clock):
    assert timed_vector(Env(clock), list(range(7))) == 7 * 0.25


def test_environments_take_turns_and_the_first_turn_does_not_count():
    order = []

    def task(name, seconds):
        return lambda: (order.append(name), next(seconds))[1]

    seconds = Speed(turns=2)._in_turns({"a": task("a", iter([9.0, 1.0, 2.0])), "b": task("b", iter([8.0, 4.0, 4.0]))})
    assert order == ["a", "b"] * 3
    assert seconds == {"a": [1.0, 2.0], "b": [4.0, 4.0]}
    # On a machine that slows down, the ratio in each turn counts: 1/4, 2/4.
    assert speed._ratios(seconds, "a") == {"a": 1.0, "b": np.median([0.25, 0.5])}


def test_speed_measures_every_environment(capsys):
    """The printed times, of a single turn, are those that the ratios are made of."""
    ratios = Speed(steps=20, turns=1, num_envs=8, vector_steps=5).run(Console(width=200))
    parts = {"": "", "x_hat": ", x_hat", "bars": ", x_hat, error bars", "z": ", z"}
    parts |= {kind: f", x_hat, {kind}" for kind in ("small", "static")}
    names = {what: {f"{env}{part}" for env in kkl_gym.ENV_IDS.values()} for what, part in parts.items()}
    single = {"Pendulum-v1"} | names[""] | names["x_hat"] | names["bars"] | names["small"] | names["static"]
    batched = {"CartPole-v1"} | (single - {"Pendulum-v1"}) | names["z"]
    assert set(ratios) == single | {f"{name}, 8 rows" for name in batched}
    assert (ratios["Pendulum-v1"], ratios["CartPole-v1, 8 rows"]) == (1.0, 1.0)
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if "│" in line]
    for length, reference, rows, last in ((3, "Pendulum-v1", "", 0.1), (5, "CartPole-v1", ", 8 rows", 1.0)):
        table = {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines if len(cells) == length}
        assert {name + rows for name in table} <= set(ratios)
        own = float(table[reference][0])
        for name, (us, *parts, printed) in table.items():
            assert float(printed) == pytest.approx(ratios[name + rows], abs=0.006)
            ratio = ratios[name + rows]  # nothing but the rounding of both times lies between them
            assert own == pytest.approx(ratio * float(us), abs=0.51 * last * (1 + ratio))
            if rows:
                simulated, network = ("%" in part for part in parts)
                assert simulated == (name != reference)
                assert network == (name in names["static"])  # those that track ask none
    alone = [[cell.strip() for cell in cells] for cells in lines if len(cells) == 6]
    assert len(alone) == 4 * (6 + 6 + 6)
    for name, one, many, *speeds in alone:
        assert float(one) > 0
        assert bool(many) == (not name.endswith("NumPy"))
        if any(speeds):
            reached, most, share = (float(speed.rstrip(" %")) for speed in speeds)
            assert name.endswith("KKL")
            assert 100 * (reached - 0.51) / (most + 0.51) - 0.51 <= share
            assert share * (most - 0.51) <= 100 * (reached + 0.51) + 0.51 * (most - 0.51)
    assert sum(any(speeds) for _, _, _, *speeds in alone) == 4 * 3


def test_what_a_memory_takes_is_the_difference_to_the_bare_environment(monkeypatch):
    """In the fastest turns, by row."""
    seconds = {"1, bare": [2, 1.5], "1, with memory": [4.5, 6], "4, bare": [1, 1], "4, with memory": [9, 9]}
    played = []

    def in_turns(self, tasks, report):
        played.extend(task() for task in tasks.values())
        return {name: [1e-6 * time for time in seconds[name]] for name in tasks}

    monkeypatch.setattr(Speed, "_in_turns", in_turns)
    console = Console(width=200, record=True)
    with progress_bars(console) as progress:
        Speed(steps=1, num_envs=4, vector_steps=1)._memory(progress)
    table = [re.findall(r"[\d.]+", line) for line in console.export_text().splitlines() if re.match(r"│ \d", line)]
    assert table == [["1", "1.5", "4.5", "3.00"], ["4", "1.0", "9.0", "2.00"]]
    assert len(played) == 4


def test_a_system_of_ones_own_alone(saved, capsys):
    own = f"{linear_system.__file__}:Oscillator"
    sizes = {"steps": 5, "turns": 1, "num_envs": 4, "vector_steps": 3}
    bare = Speed(own, **sizes).run(Console())
    assert set(bare) == {"Pendulum-v1", "oscillator", "CartPole-v1, 4 rows", "oscillator, 4 rows"}
    observed = Speed(own, saved(system=own), **sizes).run(Console())
    assert set(observed) - set(bare) == {
        "oscillator, x_hat",
        "oscillator, z, 4 rows",
        "oscillator, x_hat, 4 rows",
    }


def test_the_table_says_what_share_of_the_products_speed_a_network_reaches():
    seconds = {"KKL, NumPy": 20e-6, "KKL": 10e-6, "EKF": 400e-6}
    rows = table_rows(seconds, {"KKL": 2e-3, "EKF": 3e-3}, network=2e-3, products=1e-3, operations=1e8)
    assert rows == [
        ["KKL, NumPy", "20.0", "", "", "", ""],
        ["KKL", "10.0", "2,000", "50", "100", "50 %"],
        ["EKF", "400.0", "3,000", "", "", ""],
    ]


def test_products_are_those_of_the_network(saved):
    inverse = observers.load("lorenz").artifact.inverse
    task, operations = limit(inverse, 7)
    assert operations == 2 * 7 * (28 * 128 + 2 * 128 * 128 + 128 * 3)
    assert task() >= 0.0


def test_all_filters_follow_the_same_samples():
    """Those of filterpy, of which there is one for each row, have moved; none is timed without it."""
    artifact, system = observers.load("lorenz").artifact, get_system("lorenz")
    assert list(observer_tasks(artifact, system, rows=3, steps=4)) == [
        "KKL",
        "KKL, error bars",
        "EKF",
        "EKF of filterpy",
    ]
    tasks = observer_tasks(artifact, system, rows=None, steps=4)
    assert {task() >= 0.0 for task in tasks.values()} == {True}


def test_filterpys_filter_is_like_ours():
    system, dt = get_system("van_der_pol"), 0.01
    Q, R = 0.01 * np.eye(2), 0.01 * np.eye(1)
    one, ours = speed_observers._Filterpy(FilterpyEKF, system, dt, Q=Q, R=R), ExtendedKalmanFilter(system, dt, Q=Q, R=R)
    y = simulate(system, np.array([[1.0, 1.0]]), 300, dt)[..., :1]
    found = run(ours, y)
    for k in range(301):
        one.step(y[k, 0], np.zeros(1))
    assert np.allclose(one._filter.x, found[-1, 0], atol=0.05)


def test_without_filterpy(monkeypatch):
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    tasks = observer_tasks(observers.load("lorenz").artifact, get_system("lorenz"), rows=2, steps=2)
    assert list(tasks) == ["KKL", "KKL, error bars", "EKF"]
