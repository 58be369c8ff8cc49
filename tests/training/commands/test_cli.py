"""The command line as a whole: help, errors and interruptions."""

import errno
import signal
import subprocess
import sys
import threading
import time
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import training.cli
from kkl_gym import Lorenz
from training.cli import COMMANDS, EXTRAS, main
from training.commands.settings import defaults
from training.config import setting_types
from training.presets import preset

ROOT = Path(__file__).parents[3]


def python(code):
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)


def test_help_names_every_command_and_imports_none():
    done = python(
        "import sys\nfrom training.cli import main\n"
        "assert not {'tyro', 'rich', 'numpy'} & set(sys.modules)\n"  # nothing that may be missing or takes time
        "try:\n    main(['--help'])\nexcept SystemExit as end:\n    assert not end.code\n"
        "print(*sorted({'torch', 'pandas', 'scipy', 'numpy'} & set(sys.modules)), file=sys.stderr)"
    )
    assert done.returncode == 0
    assert done.stderr.strip() == ""
    for name in COMMANDS:
        assert f" {name} " in done.stdout
    assert "List the maps that ship with the package." in done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_of_its_own(name, capsys):
    with pytest.raises(SystemExit) as end:
        main([name, "--help"])
    assert not end.value.code
    shown = capsys.readouterr().out
    assert f"usage: kkl-gym {name}" in shown
    assert "None" not in shown


def test_help_of_no_command_imports_what_takes_seconds():
    done = python(
        "import sys\nfrom training.cli import COMMANDS, main\n"
        "for words in ([], *([name] for name in COMMANDS), *(['agent', name] for name in ('train', 'compare'))):\n"
        "    try:\n        main([*words, '--help'])\n    except SystemExit as end:\n        assert not end.code\n"
        "slow = {'torch', 'pandas', 'matplotlib', 'sympy', 'stable_baselines3', 'scipy.signal', 'scipy.stats'}\n"
        "print(*sorted(slow & set(sys.modules)), file=sys.stderr)"
    )
    assert done.returncode == 0
    assert done.stderr.strip() == ""


def test_help_says_what_the_presets_take(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", "").split())
    for setting, default in (
        ("width", "fast 128, paper 512"),
        ("depth", "fast 3, paper 4"),
        ("eigenvalues", "from the system"),
        ("dt", "from the system"),
        ("trajectories", "4000; spinn: fast 4000, paper 500"),
        ("inverse-steps", "fast 18000 (van_der_pol 24000), paper 244140; spinn: fast 18000, paper 244140"),
        ("adaptive", "no"),
        ("cpu-seconds", "none"),
    ):
        described = shown.partition(f" --{setting}")[2].partition("(default: ")[2]
        assert described.startswith(f"{default})"), setting
    assert set(defaults()) == set(setting_types())


def test_what_help_says_of_the_presets_is_what_they_take():
    texts = defaults()
    for name in ("fast", "paper"):
        config = vars(preset(Lorenz(), "input-aware", name))
        for setting in ("width", "depth", "batch", "activation", "optimiser", "samples"):
            assert str(config[setting]) in texts[setting]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("train lorenz --dt abc", "Error parsing --dt: could not convert string to float: 'abc'"),
        ("train lorenz --activation relu",
         "invalid choice 'relu' for argument '--activation'. Expected one of ('tanh', 'silu')."),
        ("evaluate lorenz --nope 3", "Unrecognized options: --nope, 3"),
        ("agent foo", "Unrecognized options: foo; Available subcommands: train, evaluate, compare, export, import"),
        ("agent", "Expected one of {train, evaluate, compare, export, import}."),
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


def test_flags_of_settings():
    assert "adaptive" in str(defaults())
    with pytest.raises(SystemExit) as end:
        main(["train", "lorenz", "--adaptive", "--no-solved-output-layer", "--no-transients"])
    assert end.value.code.startswith(
        "kkl-gym: adaptive = True, solved_output_layer = False, transients = False: settings"
    )


def test_a_reader_who_has_seen_enough_gets_no_error():
    done = subprocess.run(
        f"{sys.executable} -m training maps | head -n 1", shell=True, cwd=ROOT, capture_output=True, text=True
    )
    assert done.stderr == ""


def test_wrong_settings_are_said_in_a_line_each():
    with pytest.raises(SystemExit) as end:
        main(["train", "lorenz", "--dt", "0", "--batch", "65", "--no-monitor"])
    assert end.value.code == "kkl-gym: dt = 0.0: should be greater than 0\nbatch = 65: should be a multiple of 32"
    with pytest.raises(SystemExit) as end:
        main(["train", "lorenz", "--forward-steps", "5", "--no-monitor"])
    assert end.value.code.startswith("kkl-gym: pipeline 'input-aware' does not go with forward_steps = 5")
    assert "\n" not in end.value.code


@pytest.mark.parametrize(
    ("missing", "arguments", "extra"),
    [
        ("tyro", ["maps"], "train"),
        ("torch", ["train", "lorenz"], "train"),
        ("stable_baselines3", ["agent", "train", "lorenz"], "agents"),
        ("PIL", ["agent", "evaluate", "lorenz"], "plots"),
        ("matplotlib", ["demo", "--duration", "0.1"], "plots"),
        ("onnx", ["export", "lorenz-static", "--format", "onnx"], "onnx"),
    ],
)
def test_the_extra_that_brings_a_missing_module_is_named(missing, arguments, extra):
    done = python(f"import sys\nsys.modules[{missing!r}] = None\nfrom training.cli import main\nmain({arguments})")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("kkl-gym: ")
    assert missing in line
    assert line.endswith(f'pip install "kkl-gym[{extra}]"')


def test_extras_are_those_of_the_package():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]

    def of(extra):
        names = [text.partition(">")[0].lower().replace("_", "-") for text in declared[extra]]
        return {name for name in names if not name.startswith("kkl-gym")}

    for name, distributions in packages_distributions().items():
        its = {entry.lower().replace("_", "-") for entry in distributions}
        for extra, modules in EXTRAS.items():
            if name in modules and name != "PIL":  # which matplotlib brings, whatever else does
                assert its & of(extra), name
    modules = set().union(*EXTRAS.values())
    assert modules <= set(packages_distributions())
    assert len(modules) == sum(map(len, EXTRAS.values()))


def test_a_module_of_ones_own_that_is_missing_gets_no_hint(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError("No module named 'mine'", name="mine")

    monkeypatch.setattr(training.cli, "import_module", missing)
    with pytest.raises(SystemExit) as end:
        main(["maps"])
    assert end.value.code == "kkl-gym: No module named 'mine'"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "lorenz"], "kkl-gym: interrupted; --resume goes on from the last checkpoint, if there is one"),
        (["benchmark"], "kkl-gym: interrupted; the same command goes on"),
        (["agent", "compare"], "kkl-gym: interrupted; the same command goes on"),
        (
            ["agent", "train", "lorenz"],
            "kkl-gym: interrupted; --resume goes on from the last checkpoint, if there is one",
        ),
        (["agent", "evaluate", "lorenz"], "kkl-gym: interrupted"),
        (["maps"], "kkl-gym: interrupted"),
    ],
)
def test_interruptions_while_modules_are_imported(arguments, said, monkeypatch, capsys):
    def interrupted(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(training.cli, "import_module", interrupted)
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 130
    assert capsys.readouterr().err == f"{said}\n"


@pytest.mark.parametrize(
    "becomes", [RecursionError, ImportError, ModuleNotFoundError, SystemError, ValueError, SystemExit]
)
def test_what_modules_make_of_an_interruption(becomes, monkeypatch, capsys):
    """SciPy makes a RecursionError of it, if it comes while its parts are imported."""
    handler = signal.getsignal(signal.SIGINT)

    def interrupted(name):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise becomes("something else") from None

    monkeypatch.setattr(training.cli, "import_module", interrupted)
    with pytest.raises(SystemExit) as end:
        main(["maps"])
    assert end.value.code == 130
    assert capsys.readouterr().err == "kkl-gym: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.filterwarnings("error")
def test_an_interruption_that_a_callback_swallows_comes_again(monkeypatch, capsys):
    class Callback:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def interrupted(name):
        Callback()
        for _ in range(600):  # Python looks for interruptions between steps, not within one
            time.sleep(0.1)

    hook = sys.unraisablehook
    monkeypatch.setattr(training.cli, "import_module", interrupted)
    with pytest.raises(SystemExit) as end:
        main(["maps"])
    assert end.value.code == 130
    assert capsys.readouterr().err == "kkl-gym: interrupted\n"
    assert sys.unraisablehook is hook


def test_commands_run_in_threads_too(capsys):
    thread = threading.Thread(target=main, args=(["maps"],))
    thread.start()
    thread.join()
    assert "van_der_pol" in capsys.readouterr().out


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device", "run/config.json"),
                                   PermissionError(errno.EACCES, "Permission denied", "run/config.json")])  # fmt: skip
def test_files_that_cannot_be_written_are_named_in_one_line(error, monkeypatch):
    def fail(name):
        raise error

    monkeypatch.setattr(training.cli, "import_module", fail)
    with pytest.raises(SystemExit) as end:
        main(["maps"])
    assert end.value.code == f"kkl-gym: run/config.json: {error.strerror}"


def test_the_package_says_what_it_lacks():
    done = python("import sys\nsys.modules['torch'] = None\nimport training\ntraining.train")
    assert done.stderr.splitlines()[-1].endswith('training.train needs pip install "kkl-gym[train]"')
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        training.nothing  # noqa: B018
    assert all(callable(getattr(training, name)) for name in training.__all__)


def test_figures_leave_the_users_matplotlib_alone():
    for folder in ("commands", "evaluation", "agents"):
        for path in (ROOT / "training" / folder).rglob("*.py"):
            if path.name != "live.py":  # a window is what pyplot is for
                assert "pyplot" not in path.read_text(), path
            assert "matplotlib.use" not in path.read_text(), path


@pytest.mark.parametrize(("columns", "width"), [(None, 140), ("100", 100)])
def test_tables_in_files_are_not_cut_at_80_columns(columns, width, monkeypatch, capsys):
    widths = []

    class Command:
        def run(self, console):
            widths.append(console.width)

    monkeypatch.setattr(training.cli, "read", lambda arguments: Command())
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    main(["speed"])
    assert widths == [width]
