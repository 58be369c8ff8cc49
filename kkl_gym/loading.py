"""Load a user's class or function from ``module:Name`` or ``script.py:Name``."""

import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from kkl_gym.user_lines import user_line

Class = TypeVar("Class")


def load_class(name: str, base: type[Class]) -> type[Class]:
    """Load a subclass of ``base``; ``name`` may lack the class if the module or script defines only one."""
    where, _, class_name = name.rpartition(":") if ":" in name else (name, "", "")
    failure = f"cannot load the {base.__name__.lower()} {name!r}"
    module = _imported(where, failure)
    named = {value: key for key, value in vars(module).items() if _is_own(value, base, module.__name__)}
    own = list(named.values())
    if not class_name and len(own) == 1:
        (class_name,) = own
    found = getattr(module, class_name, None)
    if found is None:
        one = f"does not define exactly one class: name one, as in {where}:Class"
        lacks = f"defines no {class_name}" if class_name else one
        raise ValueError(f"{failure}: {where} {lacks}; it defines {', '.join(own) or 'none'}")
    if not (inspect.isclass(found) and issubclass(found, base) and found is not base):
        package = base.__module__.rpartition(".")[0]
        raise ValueError(f"{name!r} is {found!r}, not a subclass of {package}.{base.__name__}")
    return found


def load_function(name: str) -> Callable[..., Any]:
    """Load a function from ``module:name`` or ``script.py:name``."""
    where, _, called = name.rpartition(":")
    failure = f"cannot load the function {name!r}"
    function = getattr(_imported(where, failure), called, None)
    if not callable(function):
        raise ValueError(f"{failure}: {where} defines no function {called}")
    return function


def _is_own(value: Any, base: type, module: str) -> bool:
    """Whether a value is a subclass of ``base`` that a module or one of its submodules defines."""
    return (
        inspect.isclass(value)
        and issubclass(value, base)
        and value is not base
        and f"{value.__module__}.".startswith(f"{module}.")
    )


def _imported(where: str, failure: str) -> Any:
    """Import a module or script; if this fails, the message of the ValueError begins with ``failure``."""
    try:
        return _module(where)
    except Exception as error:  # a user's script may raise anything
        line = user_line(error)
        raise ValueError(f"{failure}: {f'{line}: {type(error).__name__}: ' if line else ''}{error}") from error


def _module(where: str) -> Any:
    if not where.endswith(".py"):
        if not where or where.startswith("."):
            raise ImportError(f"{where!r} is not an absolute module name")
        with _importing_from(Path.cwd()):
            found = importlib.import_module(where)
        # System.__reduce__ reads this attribute, by which worker processes load the same module.
        vars(found).setdefault("__kkl_gym_script__", where)
        return found
    path = Path(where).resolve()
    key = f"_kkl_gym_script_{hashlib.sha256(str(path).encode()).hexdigest()[:16]}"
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, path)
        if spec is None or spec.loader is None or not path.is_file():
            raise ImportError(f"no file {where}")
        module = importlib.util.module_from_spec(spec)
        module.__dict__["__kkl_gym_script__"] = str(path)
        sys.modules[key] = module
        try:
            with _importing_from(path.parent):
                spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[key]
            raise
    return sys.modules[key]


@contextlib.contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Put a folder first on the import path: for a script its own folder, for a module the current folder."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # the script may have removed it
            sys.path.remove(str(folder))
