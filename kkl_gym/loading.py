"""Finding a user's class by where it is written."""

import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

Class = TypeVar("Class")


def load_class(name: str, base: type[Class]) -> type[Class]:
    """Find a subclass by where it is written.

    Parameters
    ----------
    name : str
        ``"package.module:Class"`` or ``"path/to/script.py:Class"``.
    base : type
        What it must be a subclass of.

    Returns
    -------
    type
        The class.

    Raises
    ------
    ValueError
        If it cannot be found or is not a subclass of ``base``.
    """
    where, _, class_name = name.rpartition(":")
    try:
        found = getattr(_module(where), class_name)
    except (ImportError, AttributeError, OSError, SyntaxError, TypeError, ValueError) as error:
        raise ValueError(f"cannot load the {base.__name__.lower()} {name!r}: {error}") from error
    if not (inspect.isclass(found) and issubclass(found, base) and found is not base):
        package = base.__module__.rpartition(".")[0]
        raise ValueError(f"{name!r} is {found!r}, not a subclass of {package}.{base.__name__}")
    return found


def _module(where: str) -> Any:
    if not where.endswith(".py"):
        if not where or where.startswith("."):
            raise ImportError(f"{where!r} is no absolute module name")
        with _importing_from(Path.cwd()):
            return importlib.import_module(where)
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
    """Let imports find modules beside the one imported, as python does for a script it runs."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
