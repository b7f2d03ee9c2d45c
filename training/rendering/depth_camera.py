"""Noise and edges of a depth camera, for rendered scenes and augmented views."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["axial_deviation", "depth_edges"]


def axial_deviation(z: Any) -> Any:
    """Return the axial standard deviation of depth at distances z, both in metres.

    It is 1.2 mm + 1.9 mm (z / m - 0.4)^2 (Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D
    reconstruction and tracking", 3DIMPVT 2012).
    """
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


def depth_edges(depth: NDArray[np.floating], step: float) -> NDArray[np.bool_]:
    """Return the pixels whose depth differs from a neighbour's by more than `step`; missing depth counts as 0."""
    edge = np.zeros(depth.shape, bool)
    for here, beside in ((edge, depth), (edge.T, depth.T)):
        far = np.abs(np.diff(beside, axis=0)) > step
        here[1:] |= far
        here[:-1] |= far
    return edge
