"""Elementary functions for equations of motion that serve every number type.

Plain arithmetic already works on Python floats, NumPy arrays, torch tensors and sympy expressions alike;
``sin`` and its kind do not. A system whose equations need them takes them from here::

    from kkl_gym.elementary import sin
"""

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np


def _dispatching(name: str, array_name: str | None = None) -> Callable[[Any], Any]:
    on_floats, on_arrays = getattr(math, name), getattr(np, array_name or name)

    def function(x: Any) -> Any:
        if isinstance(x, float | int):
            try:
                return on_floats(x)
            except ValueError:  # sin(inf), sqrt(-1): not a number on arrays too
                return math.nan
        if isinstance(x, np.ndarray | np.generic):
            return on_arrays(x)
        for library in ("torch", "sympy"):  # only if the caller has imported it already
            module = sys.modules.get(library)
            if module is not None and isinstance(x, module.Tensor if library == "torch" else module.Basic):
                return getattr(module, name)(x)
        raise TypeError(f"{name} takes a float, an array, a torch tensor or a sympy expression, not {type(x)}")

    function.__name__ = name
    function.__doc__ = f"{name}(x) for floats, NumPy arrays, torch tensors and sympy expressions."
    return function


sin = _dispatching("sin")
cos = _dispatching("cos")
tan = _dispatching("tan")
exp = _dispatching("exp")
tanh = _dispatching("tanh")
sqrt = _dispatching("sqrt")
