"""How functions become machine code, where Numba is installed."""

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar

_F = TypeVar("_F", bound=Callable[..., Any])

FAST = {"contract", "reassoc", "nsz", "arcp"}  # what may be done to sums; NaN and infinity keep their meaning


def kernel(**options: Any) -> Callable[[_F], _F]:
    """Compile a function that Python calls, and keep its machine code on disk for later processes."""

    def compiled(function: _F) -> _F:
        import numba

        named = _named(function)
        try:
            made: _F = numba.njit(named, cache=True, **options)
        except RuntimeError:  # no folder can be written
            made = numba.njit(named, **options)
        return made

    return compiled


def part(**options: Any) -> Callable[[_F], _F]:
    """Make a function one that kernels may call.

    It stays a plain function. Compiled ones differ between processes, and a kernel that calls one is not found on disk.
    """

    def known(function: _F) -> _F:
        from numba.extending import register_jitable

        made: _F = register_jitable(**options)(_named(function))
        return made

    return known


def _named(function: _F) -> _F:
    """Name a function by its content.

    Machine code of several processes is linked by name, so that functions that differ must not share one. Nor do they
    share a file, which two processes may write at once.
    """
    code, cells = function.__code__, [cell.cell_contents for cell in function.__closure__ or ()]
    content = code.co_code, code.co_consts, code.co_names, [getattr(each, "__qualname__", each) for each in cells]
    function.__qualname__ = f"{code.co_qualname}_{hashlib.sha256(repr(content).encode()).hexdigest()[:16]}"
    return function


fast_kernel = kernel(fastmath=FAST, error_model="numpy")
fast_part = part(fastmath=FAST, error_model="numpy")
