"""How functions become machine code, where Numba is installed."""

import hashlib
import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any, TypeVar

logger = logging.getLogger("observers")

_F = TypeVar("_F", bound=Callable[..., Any])


@cache
def available() -> bool:
    """Whether Numba is installed."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True


def kernel(**options: Any) -> Callable[[_F], _F]:
    """Compile a function that Python calls, and keep its machine code on disk for later processes."""

    def compiled(function: _F) -> _F:
        import numba

        named = _named(function, options)
        made: Any = numba.njit(named, **options)
        with suppress(RuntimeError):  # no folder can be written
            made._cache = _forgiving()(named)
        return made

    return compiled


def pointer(function: Callable[..., Any], signature: Any, **options: Any) -> Any:
    """Compile a function that kernels call by its ``address``; it lasts as long as the returned object."""
    from numba.core.ccallback import CFunc

    named = _named(function, options)
    made: Any = CFunc(named, (signature.args, signature.return_type), locals={}, options=options)
    with suppress(RuntimeError):  # no folder can be written
        made._cache = _forgiving()(named)
    made.compile()
    return made


@cache
def _announce() -> None:
    logger.info("Numba compiles, which takes some seconds; later processes read the machine code from disk")


@cache
def _forgiving() -> Any:
    """Numba's cache, except that files which cannot be read or written cost a compilation and raise nothing."""
    from numba.core.caching import FunctionCache

    class Forgiving(FunctionCache):
        def _index_key(self, sig: Any, codegen: Any) -> Any:  # by the name, which is that of the content
            return sig, codegen.magic_tuple(), self._py_func.__qualname__

        def load_overload(self, *arguments: Any) -> Any:
            try:
                loaded = super().load_overload(*arguments)  # type: ignore[no-untyped-call]
            except Exception:  # cut off by a power failure, say
                loaded = None
                with suppress(Exception):
                    self.flush()  # type: ignore[no-untyped-call]
            if loaded is None:
                _announce()
            return loaded

        def save_overload(self, *arguments: Any) -> None:
            with suppress(Exception):  # a full disk, say
                super().save_overload(*arguments)  # type: ignore[no-untyped-call]

    return Forgiving


def part(**options: Any) -> Callable[[_F], _F]:
    """Make a function one that kernels may call.

    It stays a plain function. Compiled ones differ between processes, and a kernel that calls one is not found on disk.
    """

    def known(function: _F) -> _F:
        from numba.extending import register_jitable

        made: _F = register_jitable(**options)(_named(function, options))
        return made

    return known


def _named(function: _F, options: dict[str, Any]) -> _F:
    """Name a function by its content, and that of the functions that it calls.

    Machine code of several processes is linked by name, so that functions that differ must not share one. Nor do they
    share a file, which two processes may write at once.
    """
    code = function.__code__
    used = [cell.cell_contents for cell in function.__closure__ or ()]
    used += [function.__globals__[name] for name in code.co_names if name in function.__globals__]
    names = [getattr(each, "__qualname__", getattr(each, "__name__", each)) for each in used]
    how = [(name, sorted(value) if isinstance(value, set) else value) for name, value in sorted(options.items())]
    content = code.co_code, code.co_consts, code.co_names, names, how
    function.__qualname__ = f"{code.co_qualname}_{hashlib.sha256(repr(content).encode()).hexdigest()[:16]}"
    return function
