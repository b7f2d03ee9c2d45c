"""Values of parameters that only the slow tier takes."""

from typing import Any

import pytest


def slow(*values: Any) -> list[Any]:
    """Return values of a test's parameter that only the slow tier takes."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]
