"""Colours: the grid from which the network is built (paper, section "Color network"), CIELAB, HyAB and luma.

>>> import numpy as np
>>> grid_colors().shape
(140608, 3)
>>> grid_index(np.array([[0, 253, 2], [255, 255, 255]], np.uint8)).tolist()
[2652, 140607]

Colours are converted to CIELAB by colour-science. Reproducing the reference values (golden files) exactly requires two
D65 white points: that of colour-science for the colours of the grid, and one with a fifth digit for the mean colours of
regions. The difference matters for greys: since the sRGB matrix is rounded, all greys have a chroma of up to 0.01 and
the same hue, and the fifth digit moves this hue from one interval of the cover to the next.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "GRID_LEVELS",
    "GRID_SIZE",
    "GRID_STEP",
    "GRID_WHITE",
    "LUMA",
    "MEAN_WHITE",
    "grid_colors",
    "grid_index",
    "hyab",
    "to_lab",
]

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


GRID_WHITE = (0.3127, 0.3290)
"""Chromaticity of D65 (2 degree observer) for the colours of the grid."""

MEAN_WHITE = (0.31271, 0.32902)
"""Chromaticity of D65 (2 degree observer) for mean colours."""

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Luma coefficients of red, green and blue (ITU-R BT.601)."""


def to_lab(rgb: NDArray[np.generic], white: tuple[float, float]) -> NDArray[np.float64]:
    """Convert sRGB colours to CIELAB.

    Args:
        rgb: [..., 3] sRGB in 0..255, of any real type (mean colours are not integers).
        white: chromaticity (x, y) of the reference white.

    Returns:
        [..., 3] float64: L* in 0..100, a*, b*.
    """
    with np.printoptions():  # colour-science changes how NumPy prints arrays when it is imported
        import colour  # imported here, so that plots without a colour network need no colour-science

    xyz = colour.sRGB_to_XYZ(np.asarray(rgb, np.float64) / 255.0)
    return np.asarray(colour.XYZ_to_Lab(xyz, np.array(white)), np.float64)


def hyab(lab_1: NDArray[np.float64], lab_2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the HyAB difference |dL*| + sqrt(da*^2 + db*^2) of [..., 3] and [..., 3], broadcast: [...] float64."""
    difference = lab_1 - lab_2
    return np.asarray(np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2]))
