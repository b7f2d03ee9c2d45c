"""The message for a package that is missing."""

import importlib

import pytest

from thor2_jax.errors import InputError, needs_extra


def test_a_missing_package_is_named_with_its_extra() -> None:
    with pytest.raises(InputError, match=r"^the index needs usearch \(No module named 'absent'\); run pip .*\[index\]"):
        with needs_extra("the index", "usearch", "index"):
            importlib.import_module("absent")


def test_a_failure_of_this_distribution_keeps_its_traceback() -> None:
    with pytest.raises(ModuleNotFoundError, match="thor2_jax"):
        with needs_extra("the index", "usearch", "index"):
            importlib.import_module("thor2_jax.absent")
