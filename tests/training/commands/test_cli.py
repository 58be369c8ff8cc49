"""The command line as a whole: help, errors and interruptions."""

import signal
import subprocess
import sys
import threading
import time
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from types import SimpleNamespace

import pytest

import training.cli
from kkl_gym import Lorenz
from training.cli import COMMANDS, EXTRAS, main
from training.commands.settings import defaults
from training.config import setting_types
from training.presets import preset

ROOT = Path(__file__).parents[3]
RESUME = "; --resume goes on from the last checkpoint, if there is one"

# Help of everything, then of each command; what is not to be imported on the way, at first as it may be missing.
HELP = """
import sys
from training.cli import COMMANDS, main

def ask(*words):
    try:
        main([*words, "--help"])
    except SystemExit as end:
        assert not end.code

assert not {"tyro", "rich", "numpy"} & set(sys.modules)
ask()
print(*sorted({"torch", "pandas", "scipy", "numpy"} & set(sys.modules)), file=sys.stderr)
for words in (*([name] for name in COMMANDS), ["agent", "train"]):
    ask(*words)
slow = {"torch", "pandas", "matplotlib", "sympy", "stable_baselines3", "scipy.signal", "scipy.stats"}
print(*sorted(slow & set(sys.modules)), file=sys.stderr)
"""


def test_help_names_every_command_and_imports_nothing_that_takes_seconds():
    done = subprocess.run([sys.executable, "-c", HELP], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr.strip()) == (0, "")
    first = done.stdout.partition("usage: kkl-gym check")[0]
    assert all(f" {name} " in first and f"usage: kkl-gym {name}" in done.stdout for name in COMMANDS)
    assert "List the maps that ship with the package." in first
    assert "None" not in done.stdout


def test_help_says_what_the_presets_take(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", "").split())
    for setting, default in (
        ("width", "fast 20, paper 512; spinn: fast 128, paper 512; records: 96"),
        ("eigenvalues", "from the system, or from the records"),
        ("noise-free-share", "0.2 (van_der_pol 0.05); spinn: "),
        ("cpu-seconds", "none"),
    ):
        described = shown.partition(f" --{setting}")[2].partition("(default: ")[2]
        assert described.startswith(default), setting
    assert set(defaults()) == set(setting_types())
    for name in ("fast", "paper"):
        config = vars(preset(Lorenz(), "input-aware", name))
        assert all(str(config[setting]) in defaults()[setting] for setting in ("width", "depth", "batch", "activation"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("train lorenz --dt abc", "Error parsing --dt: could not convert string to float: 'abc'"),
        ("train lorenz --activation relu",
         "invalid choice 'relu' for argument '--activation'. Expected one of ('tanh', 'silu')."),
        ("evaluate lorenz --nope 3", "Unrecognized options: --nope, 3"),
        ("agent foo", "Unrecognized options: foo; Available subcommands: train, evaluate, export, import"),
        ("agent", "Expected one of {train, evaluate, export, import}."),
        ("train lorenz --pairs -1 2 -3",
         "Error parsing --pairs: Could not find valid parse for arguments: ['-1', '2', '-3']"),
        ("demo --duration", "Missing value for argument '--duration'. Expected 1 values."),
    ],
)  # fmt: skip
def test_options_that_cannot_be_read_are_said_in_one_line(arguments, said, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments.split())
    assert end.value.code == 2
    assert capsys.readouterr().err == f"kkl-gym: {said}\n"


def test_wrong_settings_are_said_in_a_line_each():
    with pytest.raises(SystemExit) as end:
        main(["train", "lorenz", "--dt", "0", "--batch", "65"])
    assert end.value.code == "kkl-gym: dt = 0.0: should be greater than 0\nbatch = 65: should be a multiple of 32"


def test_a_reader_who_has_seen_enough_gets_no_error():
    command = f"{sys.executable} -m training maps | head -n 1"
    assert subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True).stderr == ""


def ends(arguments, instead, monkeypatch):
    """The exit status of a command, or what is said, with a function in place of the import of its module."""
    monkeypatch.setattr(training.cli, "import_module", instead)
    with pytest.raises(SystemExit) as end:
        main(arguments)
    return end.value.code


def raising(error):
    def instead(name):
        raise error

    return instead


@pytest.mark.parametrize(
    ("missing", "hint"),
    [
        ("tyro", ': pip install "kkl-gym[train]"'),
        ("stable_baselines3.common", ': pip install "kkl-gym[agents]"'),
        ("PIL", ': pip install "kkl-gym[plots]"'),
        ("onnx", ': pip install "kkl-gym[onnx]"'),
        ("mine", ""),
    ],
)
def test_the_extra_that_brings_a_missing_module_is_named(missing, hint, monkeypatch):
    error = ModuleNotFoundError(f"No module named {missing!r}", name=missing)
    assert ends(["maps"], raising(error), monkeypatch) == f"kkl-gym: No module named {missing!r}{hint}"


def test_the_package_says_what_it_lacks(monkeypatch):
    assert all(callable(getattr(training, name)) for name in training.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        training.nothing  # noqa: B018
    monkeypatch.setattr(
        training, "import_module", raising(ModuleNotFoundError("No module named 'torch'", name="torch"))
    )
    with pytest.raises(ModuleNotFoundError, match=r'training.train needs pip install "kkl-gym\[train\]"'):
        training.train  # noqa: B018


def test_extras_are_those_of_the_package():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    installed = packages_distributions()
    for extra, modules in EXTRAS.items():
        names = {text.partition(">")[0].lower().replace("_", "-") for text in declared[extra]}
        for module in modules - {"PIL"}:  # which matplotlib brings, whatever else does
            assert {entry.lower().replace("_", "-") for entry in installed[module]} & names, module
    assert len(set().union(*EXTRAS.values())) == sum(map(len, EXTRAS.values()))


def swallowing(becomes):
    """Raise something else, as SciPy does if an interruption comes while its parts are imported."""

    def instead(name):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise becomes("something else") from None

    return instead


@pytest.mark.parametrize(
    ("arguments", "instead", "hint"),
    [
        ("train lorenz", raising(KeyboardInterrupt), RESUME),
        ("agent train lorenz", raising(KeyboardInterrupt), RESUME),
        ("agent evaluate lorenz", raising(KeyboardInterrupt), ""),
        *(("maps", swallowing(becomes), "") for becomes in (RecursionError, ImportError, SystemError, SystemExit)),
    ],
)
def test_interruptions_while_modules_are_imported(arguments, instead, hint, monkeypatch, capsys):
    handler = signal.getsignal(signal.SIGINT)
    assert ends(arguments.split(), instead, monkeypatch) == 130
    assert capsys.readouterr().err == f"kkl-gym: interrupted{hint}\n"
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.filterwarnings("error")
def test_an_interruption_that_a_callback_swallows_comes_again(monkeypatch, capsys):
    callback = type("Callback", (), {"__del__": lambda self: signal.raise_signal(signal.SIGINT)})

    def interrupted(name):
        callback()
        for _ in range(600):  # Python looks for interruptions between steps, not within one
            time.sleep(0.1)

    hook = sys.unraisablehook
    assert ends(["maps"], interrupted, monkeypatch) == 130
    assert capsys.readouterr().err == "kkl-gym: interrupted\n"
    assert sys.unraisablehook is hook


def test_commands_run_in_threads_too(capsys):
    thread = threading.Thread(target=main, args=(["maps"],))
    thread.start()
    thread.join()
    assert "van_der_pol" in capsys.readouterr().out


def test_figures_leave_the_users_matplotlib_alone():
    for path in (ROOT / "training").rglob("*.py"):
        assert path.name == "live.py" or "pyplot" not in path.read_text(), path  # which is for its window
        assert "matplotlib.use" not in path.read_text(), path


@pytest.mark.parametrize(("columns", "width"), [(None, 140), ("100", 100)])
def test_tables_in_files_are_not_cut_at_80_columns(columns, width, monkeypatch):
    widths = []
    command = SimpleNamespace(run=lambda console: widths.append(console.width))
    monkeypatch.setattr(training.cli, "read", lambda arguments, **options: command)
    monkeypatch.setenv("COLUMNS", columns) if columns else monkeypatch.delenv("COLUMNS", raising=False)
    main(["maps"])
    assert widths == [width]
