"""Messages that are too long or for missing packages, and reasons of exceptions."""

import pytest

from thor2_jax.errors import InputError, needs_extra, reason_of


def test_only_foreign_packages_need_an_extra() -> None:
    with pytest.raises(InputError, match="serve needs FastAPI.*fastapi"), needs_extra("serve", "FastAPI", "serve"):
        raise ModuleNotFoundError("No module named 'fastapi'", name="fastapi")
    with pytest.raises(ModuleNotFoundError), needs_extra("serve", "FastAPI", "serve"):
        raise ModuleNotFoundError("No module named 'thor2_jax.none'", name="thor2_jax.none")


def test_the_reason_of_an_error_of_the_system_names_its_file() -> None:
    assert reason_of(FileNotFoundError(2, "No such file", "a.png")) == "a.png: No such file"
    assert reason_of(OSError(28, "No space left")) == "No space left"
    assert reason_of(OSError(5, "two\nlines", "a\nb")) == "a b: two lines"
    assert reason_of(OSError("two\nlines")) == "two lines" and reason_of(ValueError()) == "ValueError"


def test_a_message_has_one_line_without_the_middle_of_a_long_one() -> None:
    assert str(InputError("the file a  b is\n  [[1 2]\n [3 4]]\n")) == "the file a  b is [[1 2] [3 4]]"
    assert str(InputError("a" * 500 + "b" * 500)) == "a" * 500 + "b" * 500
    assert str(InputError("a" * 600 + "b" * 600)) == f"{'a' * 500} ... {'b' * 500}"
