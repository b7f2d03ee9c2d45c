"""Settings of the augmentations: numbers and ranges with the limits of their values."""

import dataclasses
from typing import Any

from thor2_jax.errors import InputError

__all__ = ["Range", "Settings", "limited"]

Range = tuple[float, float]
"""Smallest and largest value of a uniform distribution."""


def limited(default: float | Range, low: float, high: float) -> Any:
    """Return a field of `Settings`, a number or a range, with its default and the limits of its values."""
    return dataclasses.field(default=default, metadata={"limits": (low, high)})


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an augmentation; all fields are `limited`.

    Raises:
        InputError: A number is outside its limits, or a range is not two such numbers in ascending order.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, (low, high) = getattr(self, field.name), field.metadata["limits"]
            is_range = isinstance(field.default, tuple)
            numbers = value if is_range else (value,)
            if (
                not isinstance(numbers, tuple)
                or len(numbers) != 1 + is_range
                or not all(isinstance(x, int | float) and low <= x <= high for x in numbers)
                or numbers[0] > numbers[-1]
            ):
                name = f"{type(self).__name__.lower()}.{field.name}"
                wanted = "a pair of ascending numbers" if is_range else "a number"
                raise InputError(f"{name} is {value!r}; it must be {wanted} from {low:g} to {high:g}")
