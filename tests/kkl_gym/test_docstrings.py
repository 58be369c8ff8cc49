"""The examples in the docstrings."""

import doctest

import pytest

import kkl_gym.envs
import kkl_gym.sensor
import kkl_gym.vector
import kkl_gym.wrappers.memory
import kkl_gym.wrappers.single
import kkl_gym.wrappers.vector


@pytest.mark.parametrize(
    ("module", "classes"),
    [
        (kkl_gym.envs, {"KKLEnv"}),
        (kkl_gym.sensor, {"Sensor"}),
        (kkl_gym.vector, {"KKLVectorEnv"}),
        (kkl_gym.wrappers.memory, {"KKLMemory", "KKLVectorMemory"}),
        (kkl_gym.wrappers.single, {"ActionRepeat", "KKLObservation"}),
        (kkl_gym.wrappers.vector, {"KKLVectorObservation", "VectorActionRepeat"}),
    ],
)
def test_examples(module, classes):
    examples = [found for found in doctest.DocTestFinder().find(module) if found.examples]
    assert {found.name.rpartition(".")[2] for found in examples} == classes
    assert not doctest.testmod(module).failed
