"""Extensions of mkdocs for the site: pages from other folders, links out of ``docs/``, dark figures, formulas."""

import json
import posixpath
import re
import struct
from base64 import b64decode
from collections.abc import Mapping
from html import unescape
from pathlib import Path, PurePosixPath
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
BRANCH = "main"
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
EXECUTED = ROOT / "runs" / "notebooks"  # ``make docs`` writes executed notebooks here
# Files outside docs/ that are pages of the site, each with its place under docs/.
SHOWN: Mapping[str, str] = {
    "CONTRIBUTING.md": "development/contributing.md",
    "CHANGELOG.md": "development/changes.md",
    **{f"examples/notebooks/{path.name}": f"notebooks/{path.stem}.md" for path in NOTEBOOKS},
}
WIDE = 1.5  # ratio of width to height above which pictures scroll on phones
ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>~?")  # Sphinx roles in docstrings
FETCHED = re.compile(r'<(?:script|link|img)[^>]+(?:src|href)="?(https?://[^" >]+)')
# A block or span of code, to be left as it is, or the target of a link or an image.
LINK = re.compile(r"^```.*?^```|`[^`\n]*`|\]\(([^)\s]+)\)", re.DOTALL | re.MULTILINE)
# A block or span of code, to be left as it is, or an image and its file.
IMAGE = re.compile(r"^```.*?^```|`[^`\n]*`|(!\[[^\]]*\])\(([^)\s]+)\)", re.DOTALL | re.MULTILINE)

# The HTML of pymdownx.arithmatex for $inline$ and $$displayed$$ formulas.
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)

log = get_plugin_logger(__name__)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of files outside docs/, and the pictures of notebooks."""
    for source, page in SHOWN.items():
        executed = EXECUTED / Path(source).name
        text = (executed if executed.exists() else ROOT / source).read_text(encoding="utf-8")
        pictures: Mapping[str, bytes] = {}
        if source.endswith(".ipynb"):
            text, pictures = talk(json.loads(text), Path(source).stem)
        files.append(File.generated(config, page, content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"{posixpath.dirname(page)}/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert links for GitHub to links that also work on the site."""
    at = page.file.src_uri
    sources = {shown: source for source, shown in SHOWN.items()}
    links = relinked(markdown, sources.get(at, f"docs/{at}"), at, repository=(config.repo_url or "").rstrip("/"))
    return themed(links, ROOT / "docs" / posixpath.dirname(at))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Show formulas as MathML, and Sphinx's roles in docstrings as code, because Markdown has no roles."""
    return typeset(ROLE.sub("<code>", html))


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Warn if a page would load something from another host."""
    for address in FETCHED.findall(output):
        log.warning(f"{page.file.src_uri} asks another host for {address}")
    return output


def talk(notebook: Mapping[str, Any], name: str) -> tuple[str, dict[str, bytes]]:
    """The page of a notebook, executed or not: its text, its code, and the output of the code.

    Also returns its pictures, PNG files beside the page that are named after the notebook.
    """
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if output.get("name") == "stdout":
                parts.append("```text\n" + "".join(output["text"]).rstrip() + "\n```")
            elif "image/png" in output.get("data", {}):
                picture = f"{name}-{len(pictures)}.png"
                content = pictures[picture] = b64decode("".join(output["data"]["image/png"]))
                width, height = struct.unpack(">II", content[16:24])
                shape = "wide" if width > WIDE * height else "narrow"
                parts.append(f'<img alt="What this code draws" class="{shape}" loading="lazy" src="{picture}">')
    return "\n\n".join(parts) + "\n", pictures


def relinked(markdown: str, source: str, page: str, *, repository: str) -> str:
    """A page whose links out of docs/ lead to the repository, unless the site shows their target.

    The page is `source` in the repository, and `page` under docs/ on the site.
    """

    def rewrite(found: re.Match[str]) -> str:
        link = found[1]
        if link is None or link.startswith("#") or re.match(r"[a-z]+:", link):
            return found[0]
        name, mark, anchor = link.partition("#")
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), name))
        inside = SHOWN.get(target) or (target.removeprefix("docs/") if target.startswith("docs/") else None)
        if inside is not None and not (ROOT / target).is_dir():
            return f"]({posixpath.relpath(inside, posixpath.dirname(page) or '.')}{mark}{anchor})"
        if not (ROOT / target).exists():
            log.warning(f"{source} links to {link}, and there is no {target}")
        kind = "tree" if (ROOT / target).is_dir() else "blob"
        return f"]({repository}/{kind}/{BRANCH}/{target}{mark}{anchor})"

    return LINK.sub(rewrite, markdown)


def typeset(html: str) -> str:
    """A page with formulas as MathML, which browsers draw without a script."""

    def formula(found: re.Match[str]) -> str:
        tag, latex = found.groups()
        mathml = convert(unescape(latex.strip()), display="block" if tag == "div" else "inline")
        return f'<{tag} class="formula">{mathml}</{tag}>'

    return FORMULA.sub(formula, html)


def themed(markdown: str, folder: Path) -> str:
    """A page in which ``NAME-dark.png`` follows ``NAME.png`` wherever ``folder`` has the dark file.

    Browsers load and show the file that suits the background.
    """

    def twice(found: re.Match[str]) -> str:
        alt, name = found.groups()
        if name is None:
            return found[0]
        dark = str(PurePosixPath(name).with_stem(f"{PurePosixPath(name).stem}-dark"))
        if not (folder / dark).exists():
            return found[0]
        shown = ((name, "only-light"), (dark, "only-dark"))
        return "".join(f"{alt}({target}#{ground}){{ loading=lazy }}" for target, ground in shown)

    return IMAGE.sub(twice, markdown)
