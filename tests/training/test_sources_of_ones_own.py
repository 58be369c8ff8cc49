"""A user-defined source: a mass on a spring in closed form."""

import numpy as np
import pytest
from small_runs import CPU
from tracking import exact_equations, linear_motion

from observers import KKLObserver
from training import Config, Run, learn_flow, learn_map, train
from training.maps.coordinates import settling_time
from training.sources import Increments, Pairs, Runs
from training.trajectories.motions import filter_states

DT, NOISE = 0.05, 0.1
PHI = np.array([[np.cos(DT), np.sin(DT)], [-np.sin(DT), np.cos(DT)]])


class Spring:
    """The position is measured; PHI is the transition of the state per sample."""

    name, nx, ny, nu, dt, pace, process_noise = "spring", 2, 1, 0, DT, 1.0, 0.0

    def __init__(self, known, **changes):
        self.known = known
        small = {"dt": DT, "inverse_steps": 400, "width": 16, "batch": 256, "flow_steps": 20}
        small |= {"pipeline": "input-aware", "eigenvalues": (-0.5, -1.0, -2.0, -4.0, -8.0)}
        self.config = Config(**small | changes)

    def motions(self, n, steps, seed):
        x = [np.random.default_rng(seed).uniform(-1, 1, (n, 2))]
        for _ in range(steps):
            x.append(x[-1] @ PHI.T)
        return np.array(x)

    def identity(self):
        return {"name": self.name}

    def facts(self):
        return {"system": self.name, "parameters": {}, "measurement_noise": NOISE, "C": np.array([[1.0, 0.0]])}

    def sampling(self, linear):
        return {"measurement_noise": NOISE}

    def pairs(self, linear, *, free=False, report):
        ages = np.arange(0, int(settling_time(linear) / DT), 5)
        x = self.motions(300, ages[-1], 0)
        z = filter_states(linear, x[..., :1], np.zeros((ages[-1], 300, 0)), ages)
        return Pairs(ages, x[ages], z, np.zeros(300))

    def runs(self, *, report):
        x = self.motions(200, 400, 1)
        return Runs(x, x[..., :1], np.zeros((400, 200, 0)), np.zeros(200), np.ones(200, dtype=bool))

    def equations(self):
        if not self.known:
            raise ValueError("no equations")
        return exact_equations()

    def increments(self, *, report):
        x = self.motions(500, 1, 2)
        parts = (slice(400), slice(400, None))
        learned, judged = (
            Increments(x[0, part], np.zeros((len(x[0, part]), 0)), (x[1] - x[0])[part]) for part in parts
        )
        return learned, judged

    def tracking(self):
        parts = vars(linear_motion())
        return {name: part for name, part in parts.items() if name not in ("equations", "flow")}

    def judged(self, artifact):
        return {"judged": artifact.system}


@pytest.mark.parametrize("known", [True, False])
def test_a_user_defined_source_suffices(known):
    source = Spring(known)
    artifact = train(source, device=CPU).artifact
    assert (artifact.motion.equations is not None, artifact.training["judged"]) == (known, "spring")
    x = source.motions(50, 300, 3)
    y = x[..., :1] + NOISE * np.random.default_rng(0).normal(size=(301, 50, 1))
    off = (KKLObserver(artifact, NOISE).estimate(y) - x)[100:]
    assert np.sqrt(np.mean(off**2)) < 0.05


def test_lessons_run_by_themselves():
    source = Spring(False)
    with Run.begin(source.config) as run:
        maps, motion = learn_map(source, run), learn_flow(source, run)
    assert maps.filter.dt == DT
    x = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    np.testing.assert_allclose(motion.step(x, np.zeros((50, 0)), DT), x @ PHI.T, atol=1e-5)


def test_the_papers_pipeline_needs_equations_to_simulate():
    source = Spring(True, pipeline="spinn", forward_steps=1)
    with Run.begin(source.config) as run, pytest.raises(ValueError, match="'spinn' needs the equations of a system"):
        learn_map(source, run)
