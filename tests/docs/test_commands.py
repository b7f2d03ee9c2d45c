"""Every `thor2` command of the documentation is parsed by the command line, and every page is in the navigation."""

import re
from pathlib import Path

import pytest
import typer
import yaml
from doc_pages import PAGES, ROOT, python_blocks, shell_commands

from training.cli import app

COMMAND = typer.main.get_command(app)
PLACEHOLDER = "..."
CHECKED = 60
"""Least number of commands that must be found, so that a change of the pages cannot switch this test off."""


def thor2_commands(page: str) -> list[list[str]]:
    """Return the arguments of each `thor2 ...` in the shell blocks of a page."""
    arguments = []
    for words in shell_commands(page):
        names = [number for number, word in enumerate(words) if word == "thor2" or word.endswith("/thor2")]
        if names:
            arguments.append(words[names[0] + 1 :])
    return arguments


COMMANDS = [(page, words) for page in PAGES for words in thor2_commands(page)]


def parse(words: list[str]) -> None:
    """Parse a command without running it; raises typer.TyperException."""
    command, path = COMMAND, ["thor2"]
    while hasattr(command, "commands"):
        assert words and words[0] in command.commands, f"{' '.join(path)} has no command {words[:1]}"
        path.append(words[0])
        command, words = command.commands[words[0]], words[1:]
    given = [word for word in words if word != PLACEHOLDER]
    with command.make_context(" ".join(path), given, resilient_parsing=PLACEHOLDER in words):
        pass


@pytest.mark.parametrize(("page", "words"), COMMANDS, ids=[f"{i}-{page}" for i, (page, _) in enumerate(COMMANDS)])
def test_command_parses(page: str, words: list[str]) -> None:
    parse(words)


def test_most_pages_have_commands() -> None:
    assert len(COMMANDS) >= CHECKED


@pytest.mark.parametrize("words", [["train", "--meshs", "m"], ["trains"], ["recognize"], ["evaluate", "frames"]])
def test_wrong_commands_do_not_parse(words: list[str]) -> None:
    with pytest.raises((AssertionError, typer.TyperException)):
        parse(words)


def test_python_blocks_compile() -> None:
    blocks = 0
    for page in PAGES:
        for block in python_blocks((ROOT / page).read_text(encoding="utf-8")):
            compile(block, page, "exec")
            blocks += 1
    assert blocks >= 15


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        assert re.search(rf"- {re.escape(page.relative_to(ROOT / 'docs').as_posix())}$", text, re.MULTILINE), page
    assert yaml.safe_load(text)["docs_dir"] == "docs"


def test_every_page_is_two_links_from_the_landing_page() -> None:
    """Links in the text alone; the navigation comes on top."""
    docs = ROOT / "docs"

    def links(page: Path) -> set[Path]:
        text = page.read_text(encoding="utf-8") if page.suffix == ".md" and page.is_file() else ""
        return {(page.parent / link).resolve() for link in re.findall(r"\]\(([\w./-]+\.(?:md|ipynb))[)#]", text)}

    first = links(docs / "index.md")
    reached = first.union(*map(links, first))
    expected = {path for path in docs.rglob("*") if path.suffix in {".md", ".ipynb"} and path.stem != "index"}
    assert not expected - reached
    assert {docs / "reference" / "command-line.md", docs / "reference" / "http.md"} <= reached
