"""The command line as a whole: help, errors and interruptions."""

import runpy
import signal
import subprocess
import sys
import threading
import time
import tomllib
from importlib.metadata import packages_distributions, version
from pathlib import Path

import pytest

import training.cli
from kkl_gym import Lorenz, get_system
from observers.names import resolve
from training.cli import COMMANDS, EXTRAS, main, read

ROOT = Path(__file__).parents[3]
PAGE = runpy.run_path(str(ROOT / "docs" / "site" / "commands.py"))
RESUME = "; --resume continues from the last checkpoint, if there is one"

# Print all help, then report slow imports; the first help must work without optional packages.
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
    first = done.stdout.partition("usage: kkl-gym demo")[0]
    assert all(f" {name} " in first and f"usage: kkl-gym {name}" in done.stdout for name in COMMANDS)
    assert "List the maps that ship with the package." in first
    assert "None" not in done.stdout


def test_a_dozen_commands_with_at_most_seventy_options():
    parsers = {name: parser for name, parser, _ in PAGE["parsers"]("kkl-gym", COMMANDS)}
    commands = [name for name in parsers if not any(other.startswith(f"{name} ") for other in parsers)]
    options = {"/".join(one.option_strings) for parser in parsers.values() for one in PAGE["options"](parser)} - {""}
    assert len(commands) <= 12, commands
    assert len(options) <= 70, sorted(options)


def test_the_version_is_that_of_the_package(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"kkl-gym {version('kkl-gym')}\n"


def test_settings_of_a_file_give_way_to_single_ones(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("width = 64\npairs = [[-0.1, 0.7]]\nmeasurement_noise_max = [0.1, 0.3]\n")
    words = "width=32 --set eigenvalues=-1,-2 optimiser=adam arbitrary_zero=theta free-inverse=false cpu_seconds=null"
    command = read(["train", "lorenz", "--config", str(path), "--seed", "3", "--set", *words.split()])
    assert command.settings.read() == {
        "width": 32,
        "pairs": ((-0.1, 0.7),),
        "measurement_noise_max": (0.1, 0.3),
        "eigenvalues": (-1.0, -2.0),
        "optimiser": "adam",
        "arbitrary_zero": ("theta",),
        "free_inverse": False,
        "cpu_seconds": None,
        "seed": 3,
    }


@pytest.mark.parametrize("name", ["Lorenz", "LORENZ", "KKLLorenz-v0", "lorenz"])
def test_ids_and_capitals_are_names(name):
    assert get_system(name) == Lorenz()
    assert resolve(name) == resolve("lorenz")


def test_a_script_with_one_system_needs_no_class(tmp_path):
    text = (ROOT / "examples" / "own_system.py").read_text()
    one, two = tmp_path / "one.py", tmp_path / "two.py"
    one.write_text(text)
    two.write_text(f"{text}\n\nclass Other(Pendulum):\n    name = 'other'\n")
    assert get_system(str(one)).name == "pendulum"
    with pytest.raises(
        ValueError, match=r"two.py does not define exactly one class: name one, as in .*two.py:Class; it"
    ):
        get_system(str(two))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("demo lorenz --seed 1.5", "Error parsing --seed: invalid literal for int() with base 10: '1.5'"),
        ("train lorenz --set width",
         "Error parsing --set: 'width' is no setting: write NAME=VALUE, as in width=64"),
        ("evaluate lorenz --trajectorys 3", "Unrecognized options: --trajectorys, 3; did you mean --trajectories?"),
        ("trian lorenz", f"unknown command 'trian', did you mean 'train'?; there are {', '.join(COMMANDS)}"),
        ("agent", "Expected one of {train, evaluate, export, import}."),
    ],
)  # fmt: skip
def test_invalid_options_give_a_message_of_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments.split())
    assert end.value.code == 2
    assert capsys.readouterr().err == f"kkl-gym: {message}\n"


def test_a_closed_pipe_gives_no_error():
    command = f"{sys.executable} -m training maps | head -n 1"
    assert subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True).stderr == ""


def ends(arguments, instead, monkeypatch):
    """The exit status or message of a command, with a function in place of the import of its module."""
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
        ("mine", ""),
    ],
)
def test_the_extra_that_brings_a_missing_module_is_named(missing, hint, monkeypatch):
    error = ModuleNotFoundError(f"No module named {missing!r}", name=missing)
    assert ends(["maps"], raising(error), monkeypatch) == f"kkl-gym: No module named {missing!r}{hint}"


def test_missing_extras_are_named(monkeypatch):
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
        for module in modules - {"PIL"}:  # a dependency of matplotlib and of other packages
            assert {entry.lower().replace("_", "-") for entry in installed[module]} & names, module
    assert len(set().union(*EXTRAS.values())) == sum(map(len, EXTRAS.values()))


def swallowing(becomes):
    """Raise another exception, as SciPy does on an interruption during its imports."""

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
def test_an_interruption_that_a_callback_swallows_is_raised_again(monkeypatch, capsys):
    callback = type("Callback", (), {"__del__": lambda self: signal.raise_signal(signal.SIGINT)})

    def interrupted(name):
        callback()
        for _ in range(600):  # Python handles interruptions between bytecodes only
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
