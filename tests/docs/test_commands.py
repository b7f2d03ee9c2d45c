"""Every `thor2` command of the documentation is parsed by the command line, and every page is found from the first."""

import re
from pathlib import Path

import pytest
import typer
from doc_pages import PAGES, ROOT, shell_commands

from training.cli import app

PLACEHOLDER = "..."


def parse(words: list[str]) -> None:
    """Parse a command without running it; raises typer.TyperException or KeyError."""
    command = typer.main.get_command(app)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    given = [word for word in words if word != PLACEHOLDER]
    with command.make_context("thor2", given, resilient_parsing=PLACEHOLDER in words):
        pass


def test_commands_parse() -> None:
    parsed = 0
    for page in PAGES:
        for words in shell_commands(page):
            names = [number for number, word in enumerate(words) if word.rpartition("/")[2] == "thor2"]
            if names:
                try:
                    parse(words[names[0] + 1 :])
                except (KeyError, typer.TyperException) as error:
                    pytest.fail(f"{page}: {' '.join(words)}: {error!r}")
                parsed += 1
    assert parsed >= 60


def test_every_documented_command_is_run_by_a_test() -> None:
    """A test names it as a word of its own, as in `run_thor2("train", ...)`."""
    names = {words[1] for page in PAGES for words in shell_commands(page) if words[0].rpartition("/")[2] == "thor2"}
    paths = [path for path in (ROOT / "tests").rglob("*.py") if path.parent.name != "docs"]
    tests = "".join(path.read_text(encoding="utf-8") for path in paths)
    assert len(names) >= 12 and {name for name in names if f'"{name}",' not in tests} == set()


def test_every_page_is_in_the_navigation() -> None:
    listed = re.findall(r"- ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")} <= set(listed)


def test_every_page_is_two_links_from_the_landing_page() -> None:
    """Links in the text alone; the navigation comes on top."""
    docs = ROOT / "docs"

    def links(page: Path) -> set[Path]:
        text = page.read_text(encoding="utf-8") if page.suffix == ".md" and page.is_file() else ""
        return {(page.parent / link).resolve() for link in re.findall(r"\]\(([\w./-]+\.(?:md|ipynb))[)#]", text)}

    first = links(docs / "index.md")
    expected = {path for path in docs.rglob("*") if path.suffix in {".md", ".ipynb"} and path.stem != "index"}
    expected |= {
        docs / "reference" / "command-line.md",
        docs / "reference" / "http.md",
    }  # written when the site is built
    assert not expected - first.union(*map(links, first))
