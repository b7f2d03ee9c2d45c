"""The command line in this process: what it is given, prints and writes."""

import json
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unittest import mock

Command = Callable[..., str]
"""Type of the fixtures `printed` and `refused`, which run the command line."""


Recognize = Callable[..., list[dict[str, Any]]]
"""Type of the fixture `recognize`, which recognizes frames on the command line."""


def run_thor2(*arguments: object) -> int:
    """Run the command line in this process and return its exit status."""
    from training import cli

    with mock.patch.object(sys, "argv", ["thor2", *map(str, arguments)]):
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def frame_options(folder: Path, **changes: object) -> list[object]:
    """Return the options of `thor2 recognize` that name the files of a frame, with some changed."""
    files = {
        "color": folder / "color.png",
        "depth": folder / "depth.png",
        "labels": folder / "mask.png",
        "intrinsics": folder / "intrinsics.json",
    }
    return [part for name, value in {**files, **changes}.items() for part in (f"--{name}", value)]


def json_lines(text: str) -> list[dict[str, Any]]:
    """Return the values of a JSON Lines text."""
    return [json.loads(line) for line in text.splitlines()]


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder but locks, by relative paths."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


class ParsedPage(HTMLParser):
    """An HTML page: its texts, attributes of its pictures, its tags, and tags that are open at the end."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.tags: set[str] = set()
        self.open: list[str] = []
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "img":
            self.pictures.append(dict(attrs))
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)
