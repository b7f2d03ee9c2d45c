"""A Hypothesis strategy for damaged files, to test that readers raise their own errors or return correct results.

@given(damaged(path.read_bytes()))
def test_reader(content):
    ...
"""

import re

import hypothesis.strategies as st
import numpy as np

from thor2_jax.testing.strategies import seeds

__all__ = ["damaged"]

_NUMBERS = [b"-1", b"0", b"1e400", b"nan", b"4294967296", b"9" * 30, b"null", b"[]", b'""', b"{}", b"true", b"1" * 5000]
"""Replacements of numbers in a text."""

_EXTREMES = [0, 1, 2**7, 2**8 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1]
"""Replacements of numbers in a binary header."""


def _place(content: bytearray, rng: np.random.Generator) -> int:
    """Draw a position; half of the positions are in the first bytes, where headers are."""
    return int(rng.integers(min(len(content), 128) if rng.random() < 0.5 else len(content)))


def _flip(content: bytearray, rng: np.random.Generator) -> bytearray:
    for _ in range(int(rng.integers(1, 9))):
        content[_place(content, rng)] ^= 1 << int(rng.integers(8))
    return content


def _cut(content: bytearray, rng: np.random.Generator) -> bytearray:
    return content[: int(rng.integers(len(content)))]


def _splice(content: bytearray, rng: np.random.Generator) -> bytearray:
    """Replace a piece of the file by another piece, insert a piece, or delete a piece."""
    source, target = _place(content, rng), _place(content, rng)
    length = int(rng.integers(1, 65))
    piece = content[source : source + length] if rng.random() < 0.7 else bytearray()
    return content[:target] + piece + content[target + length * int(rng.integers(2)) :]


def _extreme(content: bytearray, rng: np.random.Generator) -> bytearray:
    at, size = _place(content, rng), int(rng.choice([1, 2, 4]))
    value = int(rng.choice(_EXTREMES)) % 256**size
    content[at : at + size] = value.to_bytes(size, "big" if rng.random() < 0.5 else "little")
    return content


def _number(content: bytearray, rng: np.random.Generator) -> bytearray:
    """Replace a number in a text."""
    places = [match.span() for match in re.finditer(rb"\d[\d.]*", content)] or [(0, 0)]
    start, end = places[int(rng.integers(len(places)))]
    return content[:start] + _NUMBERS[int(rng.integers(len(_NUMBERS)))] + content[end:]


def _lines(content: bytearray, rng: np.random.Generator) -> bytearray:
    """Delete a line, or replace it by another one or by two copies of another one."""
    lines = content.split(b"\n")
    a, b = rng.integers(len(lines), size=2)
    lines[a : a + 1] = [lines[b]] * int(rng.integers(3))
    return bytearray(b"\n").join(lines)


_KINDS = _flip, _cut, _splice, _extreme, _number, _lines


def _damage(content: bytes, seed: int, times: int) -> bytes:
    rng, damaged_content = np.random.default_rng(seed), bytearray(content)
    for _ in range(times):
        if damaged_content:
            damaged_content = _KINDS[int(rng.integers(len(_KINDS)))](damaged_content, rng)
    return bytes(damaged_content)


def damaged(content: bytes, times: int = 3) -> st.SearchStrategy[bytes]:
    """Generate the bytes of a file after one or more damages.

    Damages flip bits, cut the end, move, delete or duplicate pieces and lines, and put extreme numbers into binary
    headers and texts.

    Args:
        content: bytes of a valid file.
        times: largest number of damages.
    """
    return st.builds(_damage, st.just(content), seeds(), st.integers(1, times))
