"""What the augmentations share: settings, as numbers and ranges with limits of their values, and pixels of a view."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from training.rendering.view_sphere import RenderedView

__all__ = ["FRAME_PIXEL", "Range", "Settings", "limited", "pixel_width", "without"]

FRAME_PIXEL = 0.001
"""Width of a pixel of a real frame on the object, metres (f = 616 pixels at 0.6 m, 920 at 0.9 m, 1,067 at 1.1 m).
A pixel of a training view is 1.4 mm wide."""


def pixel_width(view: RenderedView) -> float:
    """Return the width of a pixel on the object, metres, at the mean depth; at least one pixel must have depth."""
    return float(view.depth.sum() / np.count_nonzero(view.depth)) / 1000 / view.intrinsics.fx


def without(view: RenderedView, pixels: NDArray[np.intp]) -> RenderedView:
    """Return the view without `pixels`, flat indices [n]."""
    color, depth = view.color.copy(), view.depth.copy()
    color.reshape(-1, 3)[pixels] = 0
    depth.reshape(-1)[pixels] = 0
    return dataclasses.replace(view, color=color, depth=depth)


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
