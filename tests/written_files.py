"""Files that commands write: the contents of a folder, leftovers of killed processes, files of users, HTML pages."""

import contextlib
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

from thor2_jax.files import temporary_directory


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder but locks, by relative paths."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@contextlib.contextmanager
def files_of_the_user(*paths: Path) -> Iterator[None]:
    """Write files as a user would, and assert at the end that they are there and unchanged."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a user's")
    yield
    assert {path.read_text() for path in paths} == {"a user's"}


def killed(directory: Path) -> Path:
    """Leave what a killed process leaves, and return its directory."""
    with temporary_directory(directory) as temporary:
        (temporary / "half").touch()
        shutil.copytree(temporary, directory / f"{temporary.name}2")
    return directory / f"{temporary.name}2"


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
