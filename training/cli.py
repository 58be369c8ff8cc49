"""The command line ``kkl-gym`` (or ``python -m training``): its table of commands and its error messages.

Importing this module loads nothing slow or optional: the module of a command is imported when the command is called.
"""

import _thread
import io
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Any, NoReturn

Commands = Mapping[str, tuple[str, str]]  # the module and the class of each command

COMMANDS: Commands = {
    "demo": ("training.commands.demo", "Demo"),
    "maps": ("training.commands.maps", "Maps"),
    "diagnose": ("training.commands.diagnose", "Diagnose"),
    "record": ("training.commands.record", "RecordCommand"),
    "train": ("training.commands.train", "Train"),
    "identify": ("training.commands.identify", "Identify"),
    "evaluate": ("training.commands.evaluate", "Evaluate"),
    "export": ("training.commands.export", "ExportCommand"),
    "agent": ("training.commands.agent", "AgentCommand"),
}

DESCRIPTION = """Learned KKL observers for Gymnasium environments.

A first look: kkl-gym demo. An observer for your own system: kkl-gym diagnose script.py, kkl-gym train script.py.
An observer for any environment: kkl-gym record ENV_ID, kkl-gym train NAME --data. kkl-gym COMMAND --help lists the
options of a command, and kkl-gym --version prints the version."""

# Hints after an interruption, by the first words of the command.
AFTER_INTERRUPTION = dict.fromkeys(
    [("train",), ("identify",), ("agent", "train")], "--resume continues from the last checkpoint, if there is one"
)
WIDE = 140  # columns of output to a file or pipe; 80 would cut tables
PROG = "kkl-gym"
MISUSED, INTERRUPTED = 2, 130  # exit statuses; the second is 128 + SIGINT

# Modules that extras of the package install, for the hint on a missing module.
EXTRAS = {
    "train": {
        *["filelock", "joblib", "pandas", "pydantic", "pytorch_optimizer", "rich", "scipy", "sympy", "torch", "tyro"]
    },
    "agents": {"sb3_contrib", "stable_baselines3", "yaml"},
    "plots": {"PIL", "matplotlib"},
    "parquet": {"pyarrow"},
    "envs": {"h5py", "minari"},
    "onnx": {"onnx", "onnxruntime", "onnxscript"},
}


class _Notes(logging.Handler):
    """Prints the library's log messages to the current stderr, which a progress bar may have redirected."""

    def emit(self, record: logging.LogRecord) -> None:
        print(record.getMessage(), file=sys.stderr)


def main(
    arguments: list[str] | None = None,
    *,
    prog: str = PROG,
    commands: Commands = COMMANDS,
    after_interruption: Mapping[tuple[str, ...], str] = AFTER_INTERRUPTION,
) -> None:
    """Entry point of the ``kkl-gym`` command."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["--version"]:
        print(f"kkl-gym {version('kkl-gym')}")
        return
    notes = logging.getLogger("observers")
    notes.setLevel(logging.INFO)
    notes.handlers = [_Notes()]
    with _noticing_interruptions() as interrupted:
        try:
            from rich.console import Console

            read(arguments, prog=prog, commands=commands).run(
                Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else WIDE)
            )
        except BaseException as error:
            if interrupted or isinstance(error, KeyboardInterrupt):  # interrupted code may raise another error
                hints = [hint for words, hint in after_interruption.items() if tuple(arguments[: len(words)]) == words]
                _end(prog, "; ".join(["interrupted", *hints]), INTERRUPTED)
            if isinstance(error, ModuleNotFoundError):
                module = (error.name or "").partition(".")[0]
                extras = [f'pip install "kkl-gym[{extra}]"' for extra, modules in EXTRAS.items() if module in modules]
                sys.exit(": ".join([prog, str(error), *extras]))
            if isinstance(error, BrokenPipeError):  # the reader of the pipe, such as head, has closed it
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                sys.exit(1)
            if isinstance(error, ValueError | OSError | FloatingPointError):
                sys.exit(f"{prog}: {_message(error)}")
            raise


@contextmanager
def _noticing_interruptions() -> Iterator[list[int]]:
    """Yield a list that stays empty until the first interruption, which also raises KeyboardInterrupt."""
    noticed: list[int] = []

    def handler(number: int, frame: object) -> None:
        noticed.append(number)
        raise KeyboardInterrupt

    def unraisable(failed: "sys.UnraisableHookArgs") -> None:
        if isinstance(failed.exc_value, KeyboardInterrupt):  # an interruption in a callback is lost: repeat it
            threading.Timer(0.05, _thread.interrupt_main).start()
        else:
            hook(failed)

    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield noticed
        return
    before, hook = signal.signal(signal.SIGINT, handler), sys.unraisablehook
    sys.unraisablehook = unraisable
    try:
        yield noticed
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGINT, before)


def read(arguments: list[str], *, prog: str = PROG, commands: Commands = COMMANDS) -> Any:
    """Read a command line without running the command."""
    import tyro

    called = arguments[:1]
    if called and called[0] not in commands and not called[0].startswith("-"):
        from observers.names import suggestion  # imports numpy, which --help need not wait for

        close = suggestion(called[0], commands)
        _end(prog, f"unknown command {called[0]!r}{close}; there are {', '.join(commands)}", MISUSED)
    if called and called[0].startswith("--tyro"):  # shell completion needs all commands
        called = list(commands)
    classes = {name: (load if name in called else _described)(*behind) for name, behind in commands.items()}
    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            return tyro.extras.subcommand_cli_from_dict(
                classes,
                prog=prog,
                description=DESCRIPTION if commands is COMMANDS else None,
                args=arguments or ["--help"],
                config=(tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff),
            )
    except SystemExit as end:
        if end.code != MISUSED:
            raise
        _end(prog, _without_box(printed.getvalue()), MISUSED)


def _end(prog: str, message: str, code: int) -> NoReturn:
    print(f"{prog}: {message}", file=sys.stderr)
    sys.exit(code)


def _without_box(text: str) -> str:
    """Shorten tyro's message on invalid options to one line, without its frame, colours, title, help and reasons."""
    parts: list[list[str]] = [[]]
    for line in text.splitlines()[1:]:  # the first line is the title
        content = re.sub(r"\x1b\[[0-9;]*m", "", line).strip(" │╰╯")
        if content and set(content) <= set("─-"):
            parts.append([])
        else:
            parts[-1].append(content)
    kept = [" ".join(" ".join(part).split()).partition(" Got errors:")[0] for part in parts]
    similar = r"(?:Perhaps you meant|Arguments similar to \S+):.*?(--[\w-]+).*"  # followed by the option's help
    kept = [re.sub(similar, r"did you mean \1?", part) for part in kept]
    return "; ".join(part for part in kept if part and not part.startswith(("Argument helptext", "For full helptext")))


def load(module: str, name: str) -> Callable[..., Any]:
    """Import the class of a command."""
    command: Callable[..., Any] = getattr(import_module(module), name)
    return command


@cache
def _described(module: str, name: str) -> Callable[..., Any]:
    """Make a substitute for a command that is not called, with the summary that the command's source holds."""
    import ast  # not at the top, so that interruptions are handled before slow imports
    from importlib.util import find_spec
    from pathlib import Path

    spec = find_spec(module)
    assert spec is not None
    source = Path(str(spec.origin)).read_text(encoding="utf-8")
    classes = {node.name: node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)}

    def command() -> None: ...

    command.__doc__ = (ast.get_docstring(classes[name]) or "").partition("\n\n")[0]
    return command


def _message(error: Exception) -> str:
    """Return an error's message; for a ValidationError, ``name = value: requirement`` for each invalid setting."""
    from pydantic import ValidationError

    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if not isinstance(error, ValidationError):
        return str(error)
    lines = []
    for one in error.errors(include_url=False, include_context=False):
        name = ".".join(map(str, one["loc"]))
        text = one["msg"].removeprefix("Value error, ").removeprefix("Input ")
        lines.append(f"{name} = {one['input']!r}: {text}" if name else text)
    return "\n".join(lines)
