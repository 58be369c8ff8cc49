"""What a system's equations read beside their arguments: machine code is made anew where any of it has changed."""

import builtins
import dis
import functools
import inspect
from collections import namedtuple
from types import FunctionType
from typing import Any

from kkl_gym.system import System


def made_of(system: System) -> tuple[Any, ...]:
    """All that a compiled step depends on, as far as it can be seen."""
    functions = tuple(getattr(type(system), name) for name in ("f", "g", "rate"))
    numbers = (repr((found.on_self, found.of_module)) for found in (Read(system, each) for each in functions))
    return type(system), *functions, repr((system.parameters, system.G, system.X, system.bounds, system.dt)), *numbers


class Read:
    """What a method reads beside its arguments."""

    def __init__(self, system: System, function: Any) -> None:
        self.on_self, self.of_module = dict[str, float](), dict[str, float]()
        self.others, self.attributes = dict[str, Any](), dict[str, Any]()
        if not isinstance(function, FunctionType) or function in (System.f, System.g, System.rate):
            return
        of_module, attributes = _names(function)
        for name in of_module:
            value: Any = function.__globals__.get(name, getattr(builtins, name, None))
            (self.of_module if _is_number(value) else self.others)[name] = value
        for name in attributes:
            value = inspect.getattr_static(system, name, None)
            if _is_number(value):
                self.on_self[name] = value
            else:
                self.attributes[name] = value

    def stand_in(self) -> Any:
        """What takes the place of self, in a type that Numba knows."""
        return namedtuple("numbers", self.on_self)(**self.on_self)


@functools.lru_cache(maxsize=256)
def _names(function: FunctionType) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names that a function looks up in its module, and on objects. Kept, as every reset asks."""
    of_module, attributes = dict[str, None](), dict[str, None]()
    for instruction in dis.get_instructions(function):
        if instruction.opname == "LOAD_GLOBAL":
            of_module[instruction.argval] = None
        elif instruction.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            attributes[instruction.argval] = None
    return tuple(of_module), tuple(attributes)


def _is_number(value: Any) -> bool:
    return type(value) in (float, int)
