"""Pictures of recognized instances: frames with correct and incorrect answers, and crops."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.files import atomic_write
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, Annotation, draw_instances

__all__ = ["CORRECT", "INCORRECT", "draw_crop", "draw_judged"]

CORRECT, INCORRECT = COLORS[2], UNRECOGNIZED
"""Bluish green and vermilion of the palette of Okabe and Ito, a green and a red that people with colour blindness can
distinguish."""

_LARGEST_WIDTH = 960
"""Pixels; wider frames are drawn smaller."""

_CROP_SIDE = 240
"""Longest side of a crop, pixels."""


def _save(picture: Image.Image, path: Path) -> None:
    with atomic_write(path) as temporary:
        picture.save(temporary, format="JPEG", quality=85, subsampling=0)


def draw_judged(
    color: NDArray[np.uint8], labels: NDArray[Any], judged: Mapping[int, tuple[bool, str]], path: Path
) -> None:
    """Draw the outline and the text of every judged instance, green if correct, red if incorrect (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        labels: [H, W] integers.
        judged: label -> (correct, text); labels without a pixel are skipped.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    step = max(1, math.ceil(labels.shape[1] / _LARGEST_WIDTH))
    color, labels = color[::step, ::step], labels[::step, ::step]
    # Incorrect answers first: they choose the places of their labels.
    annotations = [
        Annotation(label, CORRECT if correct else INCORRECT, text)
        for label, (correct, text) in sorted(judged.items(), key=lambda item: item[1][0])
        if (labels == label).any()
    ]
    _save(draw_instances(color, labels, annotations), path)


def draw_crop(color: NDArray[np.uint8], mask: NDArray[np.bool_], path: Path) -> None:
    """Draw an instance with its outline in red and a margin around it (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        mask: [H, W] bool, the pixels of the instance; not empty.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = 6 + max(np.ptp(rows), np.ptp(columns)) // 8
    window = tuple(slice(max(0, int(s[0]) - margin), int(s[-1]) + margin + 1) for s in (rows, columns))
    picture = draw_instances(color[window], mask[window].astype(np.uint8), [Annotation(1, INCORRECT, "")])
    scale = _CROP_SIDE / max(picture.size)
    _save(picture.resize((max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))), path)
