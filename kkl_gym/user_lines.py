"""The lines of a user's code from which an exception comes."""

import linecache
import sys
from pathlib import Path
from types import CodeType, TracebackType

# Libraries that are recognised by name. Other installed packages are recognised by their folder.
_LIBRARIES = sys.stdlib_module_names - {"__main__"} | {"kkl_gym", "observers", "training"}
_LIBRARIES |= {"mpmath", "numba", "numpy", "sympy", "torch"}


def user_line(error: BaseException) -> str | None:
    """Return the last line of an exception's traceback that is not in a library, or None."""
    outside = [step for step in _steps(error) if not _of_library(step)]
    return line_of(outside[-1]) if outside else None


def steps_within(error: BaseException, code: CodeType | None) -> list[TracebackType]:
    """Return the last traceback entry in ``code`` and the later ones outside libraries; [] if none is in ``code``."""
    steps = _steps(error)
    at = [i for i, step in enumerate(steps) if step.tb_frame.f_code is code]
    return [steps[at[-1]], *(step for step in steps[at[-1] + 1 :] if not _of_library(step))] if at else []


def line_of(step: TracebackType) -> str:
    """Return file, number and text of a traceback entry's line."""
    text = text_of(step)
    return f"{path_of(step.tb_frame.f_code)}, line {step.tb_lineno}" + (f" (`{text}`)" if text else "")


def text_of(step: TracebackType) -> str:
    """Return the text of a traceback entry's line; empty if there is no source."""
    return linecache.getline(step.tb_frame.f_code.co_filename, step.tb_lineno).strip()


def path_of(code: CodeType) -> str:
    """Return the file of some code, relative to the current folder if it lies there."""
    path = Path(code.co_filename)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _steps(error: BaseException) -> list[TracebackType]:
    step, steps = error.__traceback__, list[TracebackType]()
    while step is not None:
        steps.append(step)
        step = step.tb_next
    return steps


def _of_library(step: TracebackType) -> bool:
    frame = step.tb_frame
    file = frame.f_code.co_filename
    package = frame.f_globals.get("__name__", "").partition(".")[0]
    # Code that a library generated has a file name in angle brackets.
    return package in _LIBRARIES or file.startswith("<") or "site-packages" in file or "dist-packages" in file
