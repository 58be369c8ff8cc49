"""Where in a user's code an exception comes from."""

import linecache
import sys
from pathlib import Path
from types import CodeType, TracebackType

# Wherever they are installed; other installed packages are known by their folder.
_LIBRARIES = sys.stdlib_module_names - {"__main__"} | {"kkl_gym", "observers", "training"}
_LIBRARIES |= {"mpmath", "numba", "numpy", "sympy", "torch"}


def user_line(error: BaseException) -> str | None:
    """The last line outside of libraries that an exception went through."""
    outside = [step for step in _steps(error) if not _of_library(step)]
    return line_of(outside[-1]) if outside else None


def steps_within(error: BaseException, code: CodeType | None) -> list[TracebackType]:
    """The steps of an exception's way through a function and what a user's code called there."""
    steps = _steps(error)
    at = [i for i, step in enumerate(steps) if step.tb_frame.f_code is code]
    return [steps[at[-1]], *(step for step in steps[at[-1] + 1 :] if not _of_library(step))] if at else []


def line_of(step: TracebackType) -> str:
    """File, number and text of the line of a step."""
    text = text_of(step)
    return f"{path_of(step.tb_frame.f_code)}, line {step.tb_lineno}" + (f" (`{text}`)" if text else "")


def text_of(step: TracebackType) -> str:
    """Text of the line of a step; empty where there is no source."""
    return linecache.getline(step.tb_frame.f_code.co_filename, step.tb_lineno).strip()


def path_of(code: CodeType) -> str:
    """The file that some code comes from, as a user would write it."""
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
    # A name in angle brackets is that of a function that a library wrote.
    return package in _LIBRARIES or file.startswith("<") or "site-packages" in file or "dist-packages" in file
