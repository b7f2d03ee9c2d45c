"""Checks of the label image: is it one?"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from training.diagnosis.findings import Diagnosis

__all__ = ["check_labels"]

MAX_INSTANCES = 150
"""Largest number of instances on a table."""

MAX_INSTANCE_SHARE = 0.6
"""Largest share of the image that one instance covers."""

MAX_THIN_SHARE = 0.34
"""Largest share of the instances that vanish if their border of one pixel is removed."""

MIN_THIN = 3
"""Least number of such instances that counts."""

MIN_PIECES, MIN_PIECE_SHARE = 3, 0.08
"""Pieces of the only instance of a frame, each with this share of its pixels, that show a mask of the foreground."""


def check_labels(diagnosis: Diagnosis, labels: NDArray[Any]) -> bool:
    """Check whether an image [H, W] of integers numbers instances; return whether nothing was found."""
    values, counts = np.unique(labels[labels != 0], return_counts=True)
    n_before = len(diagnosis.findings)
    advice = "Give an image in which 0 is background and each object has a number of its own; see docs/frames.md."
    if not len(values):
        diagnosis.add("labels-empty", "The label image has no instance: all of it is 0, which is background.", advice)
        return False
    # A pixel is inside if its eight neighbours have its label.
    inside = (ndimage.minimum_filter(labels, 3) == labels) & (ndimage.maximum_filter(labels, 3) == labels)
    thick = np.isin(values, labels[inside & (labels != 0)])
    n_thin = int((~thick).sum())
    largest = counts.max() / labels.size
    if len(values) > MAX_INSTANCES:
        diagnosis.add(
            "labels-many",
            f"The label image has {len(values)} different numbers: it looks like a photo, a depth image or noise.",
            advice,
        )
    elif n_thin >= MIN_THIN and n_thin > MAX_THIN_SHARE * len(values):
        diagnosis.add(
            "labels-thin",
            f"{n_thin} of the {len(values)} instances are nowhere three pixels wide, as in a label image that was "
            "resized or rotated with interpolation, or compressed with losses.",
            "Resize label images with nearest-neighbour interpolation and store them as PNG.",
        )
    elif largest > MAX_INSTANCE_SHARE:
        diagnosis.add(
            "labels-background",
            f"Instance {values[counts.argmax()]} covers {largest:.0%} of the image: the background seems to have a "
            "number.",
            "The background must be 0. " + advice,
        )
    elif len(values) == 1:
        pieces = np.bincount(ndimage.label(labels != 0, np.ones((3, 3)))[0].ravel())[1:]
        n_pieces = int((pieces > MIN_PIECE_SHARE * counts[0]).sum())
        if n_pieces >= MIN_PIECES:
            diagnosis.add(
                "labels-foreground",
                f"The only number, {values[0]}, covers {n_pieces} separate regions: this looks like a mask of the "
                "foreground, not of instances.",
                advice,
            )
    return len(diagnosis.findings) == n_before
