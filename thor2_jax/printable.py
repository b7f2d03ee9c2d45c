"""Names of objects, and their conversion to text that terminals and pictures can show."""

import re
import unicodedata
from collections.abc import Callable, Collection, Sequence

from thor2_jax.errors import InputError

__all__ = ["check_name", "escape_characters", "find_name", "first_names", "normal_name"]

_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)
"""Invisible characters that `str.isprintable` accepts."""

_RESERVED = ("unknown", "unrecognized")
"""Text that is shown for an object without a name."""


def normal_name(name: str) -> str:
    """Return a name in the Unicode form NFC, without blanks at its ends; names that look alike become equal."""
    return unicodedata.normalize("NFC", name).strip()


def check_name(name: object) -> str:
    """Return the `normal_name` of an object.

    Raises:
        InputError: the name is not a text, is empty or longer than 200 characters, has invisible characters, is
            reserved for objects without a name, or has a part "." or "..", which URLs and paths cannot contain.
    """
    # The time to normalize a text can grow with the square of its length.
    normal = normal_name(name) if isinstance(name, str) and len(name) <= 1000 else ""
    if not 1 <= len(normal) <= 200 or not normal.isprintable() or _INVISIBLE.search(normal):
        raise InputError(f"name is {name!a}; expected a printable text of 1 to 200 visible characters")
    if normal.casefold() in _RESERVED or not {".", ".."}.isdisjoint(normal.split("/")):
        raise InputError(f"name is {name!r}, which is reserved; choose another name")
    return normal


def find_name(name: str, known: Collection[str]) -> str | None:
    """Return the known name that equals `name` or looks like it; None if there is none.

    Runs and galleries of older versions can contain names that are not normalized.
    """
    if name in known:
        return name
    return next((each for each in known if isinstance(name, str) and normal_name(each) == normal_name(name)), None)


def first_names(names: Sequence[str], most: int = 6) -> str:
    """Return names as a list in a sentence; of more than `most`, the first ones, dots and the last one."""
    return ", ".join(names if len(names) <= most else [*names[: most - 1], "...", names[-1]])


def escape_characters(text: str, can_show: Callable[[str], bool] = str.isprintable) -> str:
    r"""Replace each character that cannot be shown by its escape, such as \u202e or \x1b.

    Args:
        text: any text.
        can_show: whether a character can be shown; by default control characters and those that change the direction
            of writing cannot.
    """
    return "".join(c if can_show(c) else c.encode("unicode_escape").decode() for c in text)
