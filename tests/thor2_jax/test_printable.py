"""Names of objects: which are refused, and lists of them in sentences."""

import pytest
from refusals import assert_refused

from thor2_jax.printable import check_name, first_names


def test_dots_stand_for_further_names_only() -> None:
    assert [first_names("abc"[:count], 2) for count in range(4)] == ["", "a", "a, b", "a, ..., c"]


@pytest.mark.parametrize("name", ["", " ", "a\nb", "x" * 201, 3, "mug\u200b", "\u3164", "\ud800"])
def test_names_are_texts_of_visible_characters(name: object) -> None:
    assert_refused("name is .*; expected a printable text", check_name, name)


def test_names_that_are_paths_or_no_names_are_reserved() -> None:
    for name in (".", "..", "a/./b", "a/../b", " Unknown", "unrecognized"):
        assert_refused("which is reserved", check_name, name)
    assert [check_name(name) for name in (" a..b ", "a/b", "unknown 2")] == ["a..b", "a/b", "unknown 2"]
