import functools

import pytest

import training.diagnosis.system
from kkl_gym.compiled import SamplingStep
from kkl_gym.simulate import advance_batch


@pytest.fixture(autouse=True, scope="package")
def _nothing_is_compiled():
    """Small systems take less time in NumPy than to be compiled."""
    in_numpy = functools.partial(functools.partial, advance_batch)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training.diagnosis.system, "batch_step", lambda system: SamplingStep(in_numpy(system)))
        yield
