"""Conversion to CIELAB, by colour-science, the HyAB colour difference, and luma.

Reproducing the reference values (golden files) exactly requires two D65 white points: that of colour-science for the
colours of the grid, and one with a fifth digit for the mean colours of regions. The difference matters for greys: since
the sRGB matrix is rounded, all greys have a chroma of up to 0.01 and the same hue, and the fifth digit moves this hue
from one interval of the cover to the next.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["GRID_WHITE", "LUMA", "MEAN_WHITE", "hyab", "to_lab"]

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
    import colour  # imported here, so that plots without a colour network need no colour-science

    xyz = colour.sRGB_to_XYZ(np.asarray(rgb, np.float64) / 255.0)
    return np.asarray(colour.XYZ_to_Lab(xyz, np.array(white)), np.float64)


def hyab(lab_1: NDArray[np.float64], lab_2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the HyAB difference |dL*| + sqrt(da*^2 + db*^2) of [..., 3] and [..., 3], broadcast: [...] float64."""
    difference = lab_1 - lab_2
    return np.asarray(np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2]))
