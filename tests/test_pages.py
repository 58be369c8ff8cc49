"""Checks of the pages: code runs, commands, options and names exist, and links have targets."""

import ast
import importlib
import inspect
import re
import runpy
import shutil
import tomllib
import types
from pkgutil import resolve_name

import numpy as np
import pytest
from gymnasium.utils.play import PlayableGame, play
from pages import PAGES, ROOT, Page, name

from examples.research.__main__ import COMMANDS as OF_RESEARCH
from training.cli import COMMANDS, EXTRAS, read

RESEARCH = "python -m examples.research"
# Commands of other projects, which the tests do not check.
OF_OTHERS = {"cc", "cd", "cp", "printf", "sleep", "srun", "./van_der_pol"}


def own(page):
    blocks = [] if Page(page).elsewhere else Page(page).blocks
    return [block for block in blocks if block.language == "python"]


@pytest.fixture
def playground(tmp_path, monkeypatch):
    """A folder with the examples for blocks of code; training of agents and interactive play take a few steps only."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    from sb3_contrib import RecurrentPPO
    from stable_baselines3 import DQN, PPO, SAC

    def briefly(learn):
        def few_steps(agent, total_timesteps, *rest, **more):
            agent.n_epochs = 1  # off-policy agents ignore this attribute
            return learn(agent, 2, *rest, **more)

        return few_steps

    for agent in (DQN, PPO, RecurrentPPO, SAC):
        monkeypatch.setattr(agent, "learn", briefly(agent.learn))
    monkeypatch.setattr("gymnasium.utils.play.play", play_briefly)
    return tmp_path


def play_briefly(env, **options):
    """Press each key for a step."""
    inspect.signature(play).bind(env, **options)
    env.reset(seed=0)
    keys = PlayableGame(env).relevant_keys
    pressed = env.get_wrapper_attr("get_keys_to_action")()
    assert {key for one in pressed for key in one} == keys
    for action in (options["noop"], *pressed.values()):
        env.step(action)
        assert env.render().ndim == 3
    env.close()


def numbers(text):
    """All numbers in a text."""
    return [float(one) for one in re.findall(r"-?\d+(?:\.\d*)?(?:e[+-]?\d+)?", text)]


def run(blocks, page):
    """Run blocks in order in one namespace."""
    module = types.ModuleType("__main__")
    for block in blocks:
        for code in (block.comments.get("first", ""), block.small):
            try:
                exec(compile(code, f"<a block of {name(page)}>", "exec"), module.__dict__)
            except ModuleNotFoundError as error:
                if error.name in {one for modules in EXTRAS.values() for one in modules}:
                    pytest.skip(f"{error.name} is not installed")
                raise


@pytest.mark.parametrize("page", [page for page in PAGES if own(page)], ids=name)
def test_code_runs(page, playground, capsys):
    """Run all blocks of a page in one namespace; for blocks that train, only look up their names."""
    run([block for block in own(page) if not block.needs_training], page)
    printed = numbers(capsys.readouterr().out)
    for block in Page(page).blocks:
        if "printed" in block.comments:
            shown = numbers(block.text)
            starts = range(len(printed) - len(shown) + 1)
            furthest = [np.abs(np.subtract(printed[first:][: len(shown)], shown)).max() for first in starts]
            assert min(furthest, default=np.inf) <= float(block.comments["printed"]), f"{printed} was printed"
    for block in own(page):
        if block.needs_training:
            look_up(block)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if any(b.needs_training for b in own(page))], ids=name)
def test_code_that_trains_runs(page, playground):
    run(own(page), page)


def look_up(block):
    """Check that a block's imports, attributes of modules and keyword arguments exist, without running the block."""
    tree = ast.parse(block.text)
    known = {package: importlib.import_module(package) for package in ("kkl_gym", "observers", "training")}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            exec(compile(ast.Module([node], []), "<imports>", "exec"), known)

    def value(node):
        if isinstance(node, ast.Name):
            return known.get(node.id)
        if isinstance(node, ast.Attribute) and (inspect.ismodule(base := value(node.value)) or inspect.isclass(base)):
            return getattr(base, node.attr)
        return None

    for node in ast.walk(tree):
        value(node)
        if isinstance(node, ast.Call) and (called := value(node.func)) is not None:
            accepted = inspect.signature(called).parameters.values()
            if not any(one.kind is one.VAR_KEYWORD for one in accepted):
                given = {keyword.arg for keyword in node.keywords} - {None}
                assert given <= {one.name for one in accepted}, f"{name(block.page)}: {ast.unparse(node)}"


def test_pages_with_their_own_test_are_named_there():
    for page in PAGES:
        if test := Page(page).elsewhere:
            assert page.name in (ROOT / test).read_text(), f"{test} never names {name(page)}"


def test_commands_exist():
    """The parsers accept every command line; no command runs."""
    lines = {tuple(words): page for page in PAGES for words in Page(page).commands}
    makefile = (ROOT / "Makefile").read_text()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for words, page in lines.items():
        line, (command, *rest) = f"{name(page)}: {' '.join(words)}", words
        for path in re.findall(r"(?<![\w/])examples/\w+\.py", line):
            assert (ROOT / path).exists(), line
        research = line.partition(": ")[2].startswith(RESEARCH)
        if command == "kkl-gym" or research:
            try:
                read(rest[2:], prog=RESEARCH, commands=OF_RESEARCH) if research else read(rest)
            except SystemExit as end:
                pytest.fail(f"{line}\n{end}")
        elif command == "make":
            for word in rest:
                variable = word.partition("=")[0]
                target = rf"^{word}:" if variable == word else rf"\$\({variable}\)|\$\(if \$\({variable}\)"
                assert re.search(target, makefile, re.MULTILINE), line
        elif command == "pip":
            assert rest[0] == "install", line
            named = re.findall(r"(?:kkl-gym|\.)\[([\w,]+)\]", line)
            assert {extra for one in named for extra in one.split(",")} <= set(extras), line
        elif command == "python":
            assert rest[0] == "-m" or (ROOT / rest[0]).exists(), line
        else:
            assert command in OF_OTHERS, line


def test_commands_in_sentences_exist():
    """In sentences, commands may lack required arguments, but must not have unknown options."""
    sections = runpy.run_path(str(ROOT / "docs" / "site" / "commands.py"))["sections"]
    written = "\n".join([*sections("kkl-gym", COMMANDS), *sections(RESEARCH, OF_RESEARCH)])
    parts = re.split(r"^##+ `(.*)`$", written, flags=re.MULTILINE)[1:]
    options = {words: set(re.findall(r"`(--[\w-]+)`", text)) for words, text in zip(parts[::2], parts[1::2])}
    for page in PAGES:
        for prog, shown in re.findall(rf"`(?:\w+=\w+ )?(kkl-gym|{RESEARCH})\s([^`]*)`", Page(page).prose):
            words = re.match(r"agent [a-z]+|[a-z][\w-]*|", shown)[0]
            if words:  # else a global option, or a placeholder for a command
                where = f"{name(page)}: {prog} {shown}"
                assert f"{prog} {words}" in options, where
                assert set(re.findall(r"(?<!\S)--[\w-]+", shown)) - {"--help"} <= options[f"{prog} {words}"], where


def exists(dotted):
    """Whether a dotted name is that of a module, of a definition in a module, or of a field of a class."""
    owner, _, field = dotted.rpartition(".")
    try:
        resolve_name(dotted)
    except ModuleNotFoundError:
        return False
    except AttributeError:
        return field in getattr(resolve_name(owner), "__annotations__", ())
    return True


def test_names_in_sentences_exist():
    """Names of files and folders, such as ``training/kalman.py:ExtendedKalmanFilter``, and dotted names."""
    ours = r"(?:examples|kkl_gym|observers|tests|training)"
    for page in (page for page in PAGES if not Page(page).elsewhere):
        shown = re.findall(r"`([^`\n]+)`", Page(page).prose)
        for path, _, inside in (one.partition(":") for one in shown if re.match(rf"{ours}/[\w/]*(/|\.py)(:|$)", one)):
            assert (ROOT / path).exists(), f"{name(page)}: {path}"
            dotted = ".".join([*path.removesuffix(".py").split("/"), inside])
            assert not inside or exists(dotted), f"{name(page)}: {path}:{inside}"
        for one in filter(None, (re.match(rf"{ours}(\.[A-Za-z_]\w*)+(?=$|\()", one) for one in shown)):
            assert exists(one[0]), f"{name(page)}: {one[0]}"


def test_targets_of_links_exist():
    for page in PAGES:
        text = re.sub(r"`[^`\n]*`", "", Page(page).prose)
        links = re.findall(r"\]\(([^)\s]+)\)|\b(?:href|src|srcset)=\"([^\"]+)\"", text)
        for link in filter(None, (one for both in links for one in both)):
            target, _, anchor = link.partition("#")
            found = page.parent / target if target else page
            if not re.match(r"[a-z]+:", link):
                assert found.exists(), f"{name(page)}: {link}"
                assert not anchor or found.suffix != ".md" or anchor in Page(found).anchors, f"{name(page)}: {link}"


ABBREVIATIONS = re.compile(r"\b(?:e\.g|i\.e|et al|al|cf|vs|sec|Sec|eq|Eq|fig|Fig|ch|no|[C-SU-WYZ])\.$")
ENDS = re.compile(r"(?<=[.!?])[)\"'*_”]*\s+")
NO_PROSE = {
    r"\A---\n.*?\n---\n|^( *)(```|~~~).*?^\1\2 *$|<!--.*?-->|\$\$.*?\$\$|\\\[.*?\\\]": "",
    r"`[^`]+`": "code",
    r"!\[[^\]]*\]\([^)]*\)(?:\{[^}]*\})?": "",
    r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\([^)]*\)": r"\1",
    r"<[^>\n]+>|^ *(?:\||#)[^\n]*$|^ *[-=]{3,} *$": "",
    r"^ *(?:[-*+]|\d+\.|!!!|\?\?\?) +": "\n\n",
}


def sentences(text):
    """Yield the sentences of paragraphs and list items."""
    for pattern, instead in NO_PROSE.items():
        text = re.sub(pattern, instead, text, flags=re.DOTALL | re.MULTILINE)
    for block in re.split(r"\n\s*\n", text):
        begun = ""
        for part in ENDS.split(" ".join(block.split())):
            begun = f"{begun} {part}".strip()
            if not ABBREVIATIONS.search(begun):
                yield begun
                begun = ""
        yield begun


def test_no_sentence_has_more_than_35_words():
    page = (
        "# Title\n\nOne [link](a.b), by Wu et al. 2023, e.g. `x. y`! Two.\n\n| table. |\n\n- An *item.* And\n  more\n"
    )
    found = ["One link, by Wu et al. 2023, e.g. code!", "Two.", "An *item.", "And more"]
    assert list(filter(None, sentences(page))) == found
    for page in PAGES:
        if page.name not in {"table.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"}:  # commands write table.md
            for sentence in sentences(Page(page).text):
                words = [word for word in sentence.split() if any(map(str.isalnum, word))]
                assert len(words) <= 35, f"{name(page)}: {sentence}"
