"""The same descriptor computed with common libraries, one cloud at a time, in float64.

View normalization uses Open3D's oriented box (PCA of the convex hull) and OpenCV's minimum-area rectangle. The rest is
computed by the same equations with NumPy loops over slices and strips, persim's PersistenceImager and NumPy matrices.
"""

import math

import cv2
import numpy as np
import open3d
from numpy.typing import NDArray
from persim import PersistenceImager

import colornet

__all__ = ["Peer"]

SIGMA_S, SIGMA_1, SIGMA_2 = 2.5, 0.1, 0.025
N_SLICES, N_STRIPS = 7, 31


class Peer:
    """The peer, which describes clouds one by one."""

    def __init__(self) -> None:
        cv2.setNumThreads(1)
        self.network = colornet.load_default()
        # persim's sigma is a variance.
        self.imager = PersistenceImager(
            birth_range=(-0.025, 0.775),
            pers_range=(-0.025, 0.775),
            pixel_size=SIGMA_2,
            kernel_params={"sigma": 0.00025},
        )

    def normalize(self, xyz: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the view-normalized points [n, 3], scaled units, of points [n, 3] in metres, camera at the origin."""
        points = xyz.astype(np.float64) * SIGMA_S
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        box = cloud.get_oriented_bounding_box()
        axes = box.R.T[np.argsort(-box.extent)]
        axes[2] = np.cross(axes[0], axes[1])
        turned = points @ axes.T
        for i, j in ((0, 1), (1, 2)):
            rectangle = cv2.minAreaRect(turned[:, [i, j]].astype(np.float32))
            angle = math.radians(rectangle[2])
            angle -= round(angle / (math.pi / 2)) * math.pi / 2
            c, s = math.cos(angle), math.sin(angle)
            u, v = turned[:, i].copy(), turned[:, j].copy()
            turned[:, i], turned[:, j] = c * u + s * v, c * v - s * u
        middle = (turned.min(axis=0) + turned.max(axis=0)) / 2
        if middle[2] < 0:  # the camera stays at the origin
            turned[:, 1:] *= -1
        if turned[:, 0].mean() > middle[0]:
            turned[:, :2] *= -1
        return turned - turned.min(axis=0)

    def describe(self, xyz: NDArray[np.float32], rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float64], ...]:
        """Return TOPS [7168] and TOPS2 [11942] of one cloud."""
        p = self.normalize(xyz)
        c, s = math.cos(math.pi / 4), math.sin(math.pi / 4)
        p = np.stack([c * p[:, 0] - s * p[:, 2], p[:, 1], s * p[:, 0] + c * p[:, 2]], axis=1)
        return self.describe_aligned(p - p.min(axis=0), rgb)

    def describe_aligned(self, p: NDArray[np.float64], rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float64], ...]:
        """Return TOPS [7168] and TOPS2 [11942] of one aligned cloud [n, 3] in scaled units."""
        weights = self.network.membership(rgb)
        level, strip = np.floor(p[:, 2] / SIGMA_1).astype(int), np.floor(p[:, 0] / SIGMA_2).astype(int)
        images, embeddings = np.zeros((N_SLICES, 32, 32)), np.zeros((N_SLICES, 22, N_STRIPS))
        for i in range(N_SLICES):
            here = level == i
            if not here.any():
                continue
            pairs, color = [], np.zeros((N_STRIPS, 22))
            for j in np.unique(strip[here]):
                if j >= N_STRIPS:
                    break
                inside = here & (strip == j)
                y = p[inside, 1]
                pairs.append((j * SIGMA_2, j * SIGMA_2 + y.max() - y.min()))
                color[j] = weights[inside].sum(axis=0)
            images[i] = self.imager.transform(np.array(pairs), skew=True)
            embeddings[i] = (color @ self.network.similarity).T
        blocks = np.concatenate([images.reshape(N_SLICES, -1), embeddings.reshape(N_SLICES, -1)], axis=1)
        return images.ravel(), blocks.ravel()
