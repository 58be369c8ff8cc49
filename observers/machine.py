"""Compilation of functions by Numba, if it is installed."""

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
    """Whether Numba is installed and compiles, which NUMBA_DISABLE_JIT=1 prevents."""
    try:
        from numba import config
    except ImportError:
        return False
    return not config.DISABLE_JIT  # type: ignore[attr-defined]


def kernel(**options: Any) -> Callable[[_F], _F]:
    """Compile a function that Python calls, and store its machine code on disk for later processes."""

    def compiled(function: _F) -> _F:
        import numba

        named = _named(function, options)
        made: Any = numba.njit(named, **options)
        with suppress(RuntimeError):  # Numba raises it if no folder for the cache can be written
            made._cache = _forgiving()(named)
        return made

    return compiled


def pointer(function: Callable[..., Any], signature: Any, **options: Any) -> Any:
    """Compile a function that kernels call by its ``address``, which is valid while the returned object exists."""
    from numba.core.ccallback import CFunc

    named = _named(function, options)
    made: Any = CFunc(named, (signature.args, signature.return_type), locals={}, options=options)
    with suppress(RuntimeError):  # Numba raises it if no folder for the cache can be written
        made._cache = _forgiving()(named)
    made.compile()
    return made


@cache
def _announce() -> None:
    logger.info("Numba is compiling, which takes some seconds; later processes read the machine code from disk")


@cache
def _forgiving() -> Any:
    """Return a subclass of Numba's cache that compiles again if it cannot read a file, and ignores failed writes."""
    from numba.core.caching import FunctionCache

    class Forgiving(FunctionCache):
        def _index_key(self, sig: Any, codegen: Any) -> Any:  # __qualname__ contains a hash of the content
            return sig, codegen.magic_tuple(), self._py_func.__qualname__

        def load_overload(self, *arguments: Any) -> Any:
            try:
                loaded = super().load_overload(*arguments)  # type: ignore[no-untyped-call]
            except Exception:  # such as a truncated file
                loaded = None
                with suppress(Exception):
                    self.flush()  # type: ignore[no-untyped-call]
            if loaded is None:
                _announce()
            return loaded

        def save_overload(self, *arguments: Any) -> None:
            with suppress(Exception):  # such as a full disk
                super().save_overload(*arguments)  # type: ignore[no-untyped-call]

    return Forgiving


def part(**options: Any) -> Callable[[_F], _F]:
    """Register a plain function that kernels may call.

    A compiled function would differ between processes, so the cache on disk would be useless for kernels that call it.
    """

    def registered(function: _F) -> _F:
        from numba.extending import register_jitable

        made: _F = register_jitable(**options)(_named(function, options))
        return made

    return registered


def _named(function: _F, options: dict[str, Any]) -> _F:
    """Add to a function's name a hash of the function's content and of the functions that it calls.

    Numba links machine code of several processes by name, so different functions need different names. They then have
    different files, too, which matters because two processes may write at once.
    """
    code = function.__code__
    used = [cell.cell_contents for cell in function.__closure__ or ()]
    used += [function.__globals__[name] for name in code.co_names if name in function.__globals__]
    names = [getattr(each, "__qualname__", getattr(each, "__name__", each)) for each in used]
    how = [(name, sorted(value) if isinstance(value, set) else value) for name, value in sorted(options.items())]
    content = code.co_code, code.co_consts, code.co_names, names, how
    function.__qualname__ = f"{code.co_qualname}_{hashlib.sha256(repr(content).encode()).hexdigest()[:16]}"
    return function
