"""The pages of the documentation, and what is in their blocks of code."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md")))]


def thor2_commands(page: str) -> list[list[str]]:
    """Return the arguments of each `thor2` in the shell blocks of a page, without comments and redirections."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^ *```sh\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    parts = [part for block in blocks for part in re.split(r"&&|\||\n", block.replace("\\\n", " "))]
    commands = [shlex.split(part.partition(" >")[0], comments=True) for part in parts]
    return [words[k + 1 :] for words in commands for k, word in enumerate(words) if word.rpartition("/")[2] == "thor2"]
