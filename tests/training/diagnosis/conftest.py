import functools

import pytest

import training.diagnosis.system
from kkl_gym.compiled import SamplingStep
from kkl_gym.simulate import advance_batch


@pytest.fixture(autouse=True, scope="package")
def _without_compilation():
    """Simulate in NumPy: compiling small systems would take longer than simulating them."""
    in_numpy = functools.partial(functools.partial, advance_batch)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training.diagnosis.system, "batch_step", lambda system: SamplingStep(in_numpy(system)))
        yield
