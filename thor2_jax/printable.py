"""Names of objects and files as text that terminals and pictures can show."""

from collections.abc import Callable

__all__ = ["escape_characters"]


def escape_characters(text: str, can_show: Callable[[str], bool] = str.isprintable) -> str:
    r"""Replace each character that cannot be shown by its escape, such as \u202e or \x1b.

    Args:
        text: any text.
        can_show: whether a character can be shown; by default control characters and those that change the direction
            of writing cannot.
    """
    return "".join(c if can_show(c) else c.encode("unicode_escape").decode() for c in text)
