"""Ranges of the augmentations' settings and the check of their values."""

import dataclasses
import math
from typing import Any

from thor2_jax.errors import InputError

__all__ = ["Range", "check_fields"]

Range = tuple[float, float]
"""Smallest and largest value of a uniform distribution."""


def check_fields(record: Any, **limits: Range) -> None:
    """Check a dataclass of numbers and ranges; a field is a range if its default is.

    Args:
        record: the dataclass; messages name it in lower case.
        limits: smallest and largest allowed value of every field.

    Raises:
        InputError: A number is outside its limits, or a range is not two such numbers in ascending order.
    """
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        low, high = limits[field.name]
        is_range = isinstance(field.default, tuple)
        numbers = value if is_range else (value,)
        if (
            not isinstance(numbers, tuple)
            or len(numbers) != 1 + is_range
            or not all(isinstance(x, int | float) and math.isfinite(x) and low <= x <= high for x in numbers)
            or numbers[0] > numbers[-1]
        ):
            name = f"{type(record).__name__.lower()}.{field.name}"
            wanted = "a pair of ascending numbers" if is_range else "a number"
            raise InputError(f"{name} is {value!r}; it must be {wanted} from {low:g} to {high:g}")
