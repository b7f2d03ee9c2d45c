"""Conversion of matplotlib figures to PNG files, and of object names to text in figures."""

import functools
import io
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager, get_font

from thor2_jax.files import write_bytes
from thor2_jax.printable import escape_characters

__all__ = ["name_style", "plain_text", "png_bytes", "save_figure"]

_PNG: dict[str, Any] = {"format": "png", "dpi": 130, "bbox_inches": "tight"}
"""Format of pictures; "tight", since matplotlib's layouts may cut off a label beside axes of equal scales."""

_FONTS = ("DejaVu Sans", "Noto Sans CJK SC", "Noto Sans CJK JP", "WenQuanYi Zen Hei", "Arial Unicode MS", "Noto Emoji")
"""Fonts for names; missing ones are skipped, and the first one comes with matplotlib."""


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, atomically.

    Raises:
        OSError: the file cannot be written.
    """
    write_bytes(path, png_bytes(figure))


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as the content of a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, **_PNG)
    return stream.getvalue()


@functools.cache
def _installed_fonts() -> tuple[list[str], frozenset[int]]:
    """Return the installed fonts of _FONTS and the characters that they have."""
    files = {font.name: font.fname for font in fontManager.ttflist if font.name in _FONTS}
    characters = frozenset(code for file in files.values() for code in get_font(file).get_charmap())
    return [name for name in _FONTS if name in files], characters


def plain_text(name: str) -> str:
    """Return a name as text that matplotlib draws literally: no mathtext, and escapes for missing characters."""
    _, characters = _installed_fonts()
    shown = escape_characters(name, lambda c: c == "\n" or (c.isprintable() and ord(c) in characters))
    return shown.replace("$", r"\$")


def name_style() -> dict[str, Any]:
    """Return the properties of a text that holds names."""
    return {"fontfamily": _installed_fonts()[0]}
