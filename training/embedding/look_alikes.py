"""Look-alikes: distractors with the shape of a class and other colours, which teach that a shape alone is no class.

A look-alike has the colours of some class, turned in hue. The point whose brightness has the rank r among the points of
a cloud gets the colour with the rank r in the other cloud, so that light and dark parts stay where they are.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.types import Cloud
from training.augmentation.illumination import LUMA

__all__ = ["look_alike", "painted"]

LEAST_TURN = np.pi / 3
"""Least turn of the hue, in radians."""


def _hue_turn(angle: float) -> NDArray[np.float64]:
    """Return the rotation [3, 3] of RGB colours about the grey axis."""
    axis = np.full(3, 3**-0.5)
    cross = np.cross(axis, np.eye(3)).T
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def painted(rgb: NDArray[np.uint8], colors: NDArray[np.uint8], angle: float) -> NDArray[np.uint8]:
    """Return colours [n, 3] for points of the colours `rgb` [n, 3].

    Args:
        rgb: colours that determine the ranks of the points.
        colors: [m, 3] new colours, by rank.
        angle: turn of the hue of the new colours, in radians.
    """
    rank = np.argsort(np.argsort(rgb @ LUMA, kind="stable"), kind="stable")
    by_rank = np.argsort(colors @ LUMA, kind="stable")
    chosen = colors[by_rank[rank * len(colors) // len(rgb)]]
    return (chosen @ _hue_turn(angle).T).clip(0, 255).astype(np.uint8)


def look_alike(clouds: Sequence[Cloud], colored: Sequence[Cloud], views: int, rng: np.random.Generator) -> list[Cloud]:
    """Return views of one look-alike.

    Args:
        clouds: views of the class whose shape it has.
        colored: views of the class whose colours it has, in another hue; it may be the same class.
        views: number of views.
        rng: chooses views and the turn of the hue.
    """
    angle = rng.uniform(LEAST_TURN, 2 * np.pi - LEAST_TURN)
    pairs = zip(rng.integers(len(clouds), size=views), rng.integers(len(colored), size=views), strict=True)
    return [(clouds[k][0], painted(clouds[k][1], colored[other][1], angle)) for k, other in pairs]
