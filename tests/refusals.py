"""Calls that are refused."""

from collections.abc import Callable
from typing import Any

import pytest

from thor2_jax.errors import InputError


def assert_refused(match: str, call: Callable[..., object], /, *arguments: Any, **options: Any) -> None:
    """Assert that a call raises an InputError whose message matches a pattern."""
    with pytest.raises(InputError, match=match):
        call(*arguments, **options)
