"""The methods of the benchmark, by name."""

from inspect import isabstract
from typing import Any

from examples.research.methods.ablation import INVERSE_METHODS, SPINN_METHODS
from examples.research.methods.base import Budget, Configuration, Data, Method, Task
from examples.research.methods.kalman import EKF, UKF
from examples.research.methods.kkl import SPINN, Default, Shipped, ShippedLarge, ShippedSPINN
from examples.research.methods.node import NODE, NODENoise
from examples.research.methods.sequences import GRU, LRU, Transformer
from kkl_gym.loading import load_class

Methods = dict[str, Method[Any]]


def _by_name(*methods: Method[Any]) -> Methods:
    return {method.name: method for method in methods}


default = Default()
METHODS = _by_name(default, SPINN(), NODE(), NODENoise(), GRU(), LRU(), Transformer(), EKF(), UKF())
# The ablation's two series, in the order of ``make ablation``; the second ends at the default.
ABLATION = _by_name(*SPINN_METHODS, *INVERSE_METHODS, default)
# These methods need a map that ships for the system, and run only if they are named.
AS_SHIPPED = _by_name(Shipped(), ShippedSPINN(), ShippedLarge())
SHIPPED = METHODS | ABLATION | AS_SHIPPED


def get_method(name: str) -> Method[Any]:
    """Return a method of the benchmark, or the user's own as module:Class or script.py:Class."""
    if name in SHIPPED:
        return SHIPPED[name]
    if ":" not in name:
        raise ValueError(
            f"unknown method {name!r}; there are {', '.join(SHIPPED)}; your own: 'module:Class' or 'script.py:Class'"
        )
    cls = load_class(name, Method)  # type: ignore[type-abstract]
    if isabstract(cls):
        raise ValueError(f"the method {name!r} must define {', '.join(sorted(cls.__abstractmethods__))}")
    if not isinstance(vars(cls).get("name"), str) or not isinstance(getattr(cls, "label", None), str):
        raise ValueError(f"the method {name!r} must set its own class variables name and label")
    if cls.name in SHIPPED and cls is not type(SHIPPED[cls.name]):
        raise ValueError(f"the method {name!r} has the name {cls.name!r} of another method; give it its own")
    return SHIPPED.get(cls.name) or cls()


__all__ = [
    "ABLATION",
    "AS_SHIPPED",
    "METHODS",
    "SHIPPED",
    "Budget",
    "Configuration",
    "Data",
    "Method",
    "Task",
    "get_method",
]
