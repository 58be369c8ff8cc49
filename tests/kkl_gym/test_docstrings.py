"""The examples in the docstrings of the package."""

import doctest
import importlib
import pkgutil

import pytest

import kkl_gym

MODULES = [module.name for module in pkgutil.walk_packages(kkl_gym.__path__, "kkl_gym.")]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    assert not doctest.testmod(importlib.import_module(name)).failed
