"""The grid of sRGB colours from which the colour network is built (paper, section "Color network").

>>> import numpy as np
>>> grid_colors().shape
(140608, 3)
>>> grid_index(np.array([[0, 253, 2], [255, 255, 255]], np.uint8)).tolist()
[2652, 140607]
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["GRID_LEVELS", "GRID_SIZE", "GRID_STEP", "grid_colors", "grid_index"]

GRID_STEP = 5
"""Difference of neighbouring levels of a channel."""

GRID_LEVELS = 52
"""Number of levels of a channel: 0, 5, ..., 255."""

GRID_SIZE = GRID_LEVELS**3
"""Number of colours in the grid (140,608)."""


def grid_colors() -> NDArray[np.uint8]:
    """Return all sRGB colours whose channels are multiples of 5, the set X_rgb of the paper.

    Returns:
        [140608, 3] uint8; row k is the colour whose `grid_index` is k, so that blue varies fastest.
    """
    level = np.arange(GRID_LEVELS, dtype=np.uint8) * np.uint8(GRID_STEP)
    return np.stack(np.meshgrid(level, level, level, indexing="ij"), axis=-1).reshape(-1, 3)


def grid_index(rgb: ArrayLike) -> NDArray[np.int32]:
    """Return the row of the nearest grid colour, (ri * 52 + gi) * 52 + bi with ri = round(R / 5); ties cannot occur.

    Args:
        rgb: [..., 3] uint8, sRGB.

    Returns:
        [...] int32 in 0..140607.

    Raises:
        ValueError: `rgb` has another type, or its last axis is not 3.
    """
    rgb = np.asarray(rgb)
    if rgb.dtype != np.uint8 or rgb.ndim == 0 or rgb.shape[-1] != 3:
        raise ValueError(f"rgb is {rgb.dtype} {list(rgb.shape)}; expected uint8 [..., 3]")
    level = (rgb.astype(np.int32) + GRID_STEP // 2) // GRID_STEP
    return np.asarray((level[..., 0] * GRID_LEVELS + level[..., 1]) * GRID_LEVELS + level[..., 2])
