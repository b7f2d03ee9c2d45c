"""Pictures of an evaluation: frames with every instance judged, crops of wrong answers, the reliability diagram."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_erosion

from thor2_jax.files import atomic_write
from thor2_jax.recognition.overlay import COLORS, UNRECOGNIZED
from training.reports.plots import save_figure

__all__ = ["RIGHT", "WRONG", "draw_crop", "draw_judged", "draw_reliability"]

RIGHT, WRONG = COLORS[2], UNRECOGNIZED
"""Bluish green and vermilion of Okabe and Ito's palette: green and red that all eyes tell apart."""

_WIDTH = 960
"""Frames wider than that are drawn smaller, pixels."""

_CROP = 240
"""Longest side of a crop, pixels."""


def _save(picture: Image.Image, path: Path) -> None:
    with atomic_write(path) as temporary:
        picture.save(temporary, format="JPEG", quality=85)


def draw_judged(
    color: NDArray[np.uint8], labels: NDArray[Any], judged: Mapping[int, tuple[bool, str]], path: Path
) -> None:
    """Draw the outline and the text of every instance judged, green if right, red if wrong (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        labels: [H, W] integers.
        judged: label -> (right, text); labels without a pixel are passed over.
        path: of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    step = max(1, math.ceil(labels.shape[1] / _WIDTH))
    pixels, labels = color[::step, ::step].copy(), labels[::step, ::step]
    masks = {label: labels == label for label in judged}
    for label, mask in masks.items():
        inner = binary_erosion(mask, iterations=max(2, labels.shape[1] // 250))
        pixels[mask & ~inner] = RIGHT if judged[label][0] else WRONG
    picture = Image.fromarray(pixels)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(max(11, labels.shape[1] // 48))
    taken: list[tuple[float, float, float, float]] = []
    for label in sorted(masks, key=lambda label: judged[label][0]):  # the wrong ones choose their place first
        rows, across = np.nonzero(masks[label])
        if len(rows):
            right, text = judged[label]
            _, _, width, height = (side + 4 for side in draw.textbbox((0, 0), text, font))
            x = min(max(0, across.mean() - width / 2), max(0, labels.shape[1] - width))
            above, below = rows.min() - height - 2, rows.max() + 2
            tries = [y for k in range(4) for y in (above - k * height, below + k * height)]
            boxes = [(x, y, x + width, y + height) for y in tries if 0 <= y <= labels.shape[0] - height]
            free = [box for box in boxes if not any(_overlap(box, other) for other in taken)]
            box = (free or boxes or [(x, 0, x + width, height)])[0]
            taken.append(box)
            draw.rectangle(box, fill=RIGHT if right else WRONG)
            draw.text((box[0] + 2, box[1] + 1), text, "white", font)
    _save(picture, path)


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def draw_crop(color: NDArray[np.uint8], mask: NDArray[np.bool_], path: Path) -> None:
    """Cut an instance out with a margin around it, its outline in red (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        mask: [H, W] of the instance; not empty.
        path: of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    rows, across = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = 6 + max(np.ptp(rows), np.ptp(across)) // 8
    window = tuple(slice(max(0, int(s[0]) - margin), int(s[-1]) + margin + 1) for s in (rows, across))
    pixels, inside = color[window].copy(), mask[window]
    pixels[inside & ~binary_erosion(inside)] = WRONG
    picture = Image.fromarray(pixels)
    scale = _CROP / max(picture.size)
    _save(picture.resize((max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))), path)


def draw_reliability(bins: Mapping[str, list[Any]], name: str, path: Path) -> None:
    """Draw accuracy against confidence, and how many answers each bin has.

    Args:
        bins: "answers" and "accuracy" of each bin, None where there is no answer.
        name: of the joining, for instance "THOR2".
        path: of the picture (PNG).

    Raises:
        OSError: the file cannot be written.
    """
    count = np.array(bins["answers"])
    edges = np.linspace(0, 1, len(count) + 1)
    accuracy = np.array([np.nan if value is None else value for value in bins["accuracy"]])
    figure = Figure(figsize=(5.2, 5.5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    upper.bar(edges[:-1], accuracy, 1 / len(count), align="edge", color="#56b4e9", edgecolor="white")
    upper.plot([0, 1], [0, 1], color="#222222", linewidth=1, linestyle="--", label="confidence as good as it claims")
    upper.set(xlim=(0, 1), ylim=(0, 1), ylabel="share that is right")
    upper.legend(frameon=False, loc="upper left")
    lower.bar(edges[:-1], count, 1 / len(count), align="edge", color="#888888", edgecolor="white")
    lower.set(xlabel=f"confidence of {name}", ylabel="answers")
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)
