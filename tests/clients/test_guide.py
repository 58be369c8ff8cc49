"""The code in docs/guides/clients.md; a block runs only where the packages that it imports are installed."""

import re
from pathlib import Path

import pytest
from pages import Page

pytestmark = pytest.mark.clients
ROOT = Path(__file__).parent.parent.parent
OURS = {"kkl_gym", "observers", "training", *(path.stem for path in (ROOT / "examples").glob("*.py"))}
BLOCKS = [block for block in Page(ROOT / "docs" / "guides" / "clients.md").blocks if block.language == "python"]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: re.findall(r"(?:from|import) (\w+)", block.text)[-1])
def test_block(block, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    try:
        exec(compile(block.text, "<a block of clients.md>", "exec"), {"__name__": "__main__"})
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in OURS:
            raise
        pytest.skip(f"{error.name} is not installed")
