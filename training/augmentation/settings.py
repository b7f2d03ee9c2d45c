"""What the augmentations' settings share: ranges and the check of their values."""

import dataclasses
import math
from typing import Any

from thor2_jax.errors import InputError

__all__ = ["Range", "check_fields"]

Range = tuple[float, float]
"""Least and largest of values that are drawn uniformly."""


def check_fields(record: Any, **limits: Range) -> None:
    """Check a dataclass of numbers and ranges; a field is a range if its default is.

    Args:
        record: the dataclass, named in lower case in the message.
        limits: of every field, both allowed.

    Raises:
        InputError: a number outside its limits, or a range that is not two such numbers in order.
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
            wanted = "a pair of numbers in order" if is_range else "a number"
            raise InputError(f"{name} is {value!r}; it must be {wanted} from {low:g} to {high:g}")
