"""A picture of what was recognized: the photo, and on it every instance's outline and a label with the answer.

draw_overlay(frame.color, frame.labels, recognizer.recognize(frame), "overlay.png")
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from thor2_jax.errors import InputError
from thor2_jax.files import replacing

if TYPE_CHECKING:
    from thor2_jax.recognizer import Recognition

__all__ = ["COLORS", "UNRECOGNIZED", "draw_overlay"]

COLORS = ((86, 180, 233), (240, 228, 66), (0, 158, 115), (204, 121, 167), (230, 159, 0))
"""Of recognized instances, in turn: sky blue, yellow, bluish green, reddish purple, orange of Okabe and Ito."""

UNRECOGNIZED = (213, 94, 0)
"""Of the others: vermilion of the same palette, which the turn leaves out."""

_INK = (0, 0, 0)
"""Of letters and of the thin line along outlines: at least 5.7 to 1 in contrast to every colour above."""

_SMALLEST = 8
"""Size of the smallest letters that can be read, pixels."""


class _Box(NamedTuple):
    """Columns left to right and rows top to bottom, ends not included."""

    left: int
    top: int
    right: int
    bottom: int


class _Mask(NamedTuple):
    """An instance's mask, cut out with a margin of one pixel: `pixels[1, 1]` is the corner (left, top) of `box`."""

    box: _Box
    pixels: NDArray[np.bool_]


def draw_overlay(color: NDArray[np.uint8], labels: NDArray[Any], answers: Sequence[Recognition], path: str | Path) -> None:
    """Draw answers on the photo they are about; the PNG appears under its name whole or not at all.

    A label tells name, confidence, the classifier that decided, and "occluded" where it is; or "unrecognized". Letters and
    outlines grow with the picture. Labels lie inside it, clear of each other while there is room; letters shrink where a label
    is wider than the picture, and a label that does not fit even in the smallest legible letters is left out.

    Args:
        color: [H, W, 3] uint8, sRGB.
        labels: [H, W] integers; 0 is background, every other number an instance.
        answers: of instances in `labels`; instances without an answer are not drawn.
        path: of the picture.

    Raises:
        InputError: shapes or types that do not fit, or an answer about a label that does not occur in `labels`.
        OSError: the file cannot be written.
    """
    color, labels = np.asarray(color), np.asarray(labels)
    if color.ndim != 3 or color.shape[2] != 3 or 0 in color.shape:
        raise InputError(f"color has shape {color.shape}; expected [H, W, 3]")
    if color.dtype != np.uint8:
        raise InputError(f"color has type {color.dtype}; expected uint8")
    if labels.shape != color.shape[:2]:
        raise InputError(f"labels has shape {labels.shape}; color has {color.shape[:2]} (rows, columns)")
    if labels.dtype.kind not in "ui":
        raise InputError(f"labels has type {labels.dtype}; expected integers")
    masks = [_cut_out(labels, answer.label) for answer in answers]
    paints = _paints(answers)
    diagonal = math.hypot(*labels.shape)
    thickness = max(1, round(diagonal / 350))

    pixels = color.copy()
    for mask, paint in zip(masks, paints, strict=True):
        _outline(pixels, mask, paint, thickness)
    picture = Image.fromarray(pixels)
    _write_labels(picture, labels != 0, masks, paints, [_text(a) for a in answers], max(11, round(diagonal / 55)))
    with replacing(path) as temporary:
        picture.save(temporary, format="PNG")


def _paints(answers: Sequence[Recognition]) -> list[tuple[int, int, int]]:
    recognized = np.cumsum([answer.name is not None for answer in answers])
    return [
        UNRECOGNIZED if answer.name is None else COLORS[(int(count) - 1) % len(COLORS)]
        for answer, count in zip(answers, recognized, strict=True)
    ]


def _text(answer: Recognition) -> str:
    occluded = ["occluded"] if answer.occluded else []
    if answer.name is None:
        return "\n".join(["unrecognized", *occluded])
    sure = "" if answer.confidence is None else f" {answer.confidence:.2f}"
    decided = [] if answer.classifier is None else [answer.classifier.upper()]
    return f"{answer.name}{sure}\n{', '.join(decided + occluded)}".rstrip()


def _cut_out(labels: NDArray[Any], label: int) -> _Mask:
    mask = labels == label
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if label == 0 or not len(rows):
        raise InputError(f"answers: label {label} is no instance of labels")
    box = _Box(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    return _Mask(box, np.pad(mask[box.top : box.bottom, box.left : box.right], 1))


def _eroded(mask: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """The mask without its outermost `steps` layers of 4-neighbours; its margin must be empty."""
    for _ in range(steps):
        inner = np.zeros_like(mask)
        inner[1:-1, 1:-1] = mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
        mask = inner
    return mask


def _outline(pixels: NDArray[np.uint8], mask: _Mask, paint: tuple[int, int, int], thickness: int) -> None:
    """Draw inwards from the mask's edge, so that no outline hides a neighbour's: a coloured line, within it a thin dark one."""
    left, top, right, bottom = mask.box
    within = _eroded(mask.pixels, thickness)
    core = _eroded(within, max(1, thickness // 3))
    target = pixels[top:bottom, left:right]
    target[(mask.pixels & ~within)[1:-1, 1:-1]] = paint
    target[(within & ~core)[1:-1, 1:-1]] = _INK


def _write_labels(
    picture: Image.Image,
    instances: NDArray[np.bool_],
    masks: Sequence[_Mask],
    paints: Sequence[tuple[int, int, int]],
    texts: Sequence[str],
    size: int,
) -> None:
    draw = ImageDraw.Draw(picture)
    font_of = functools.cache(ImageFont.load_default)
    covered = np.pad(instances, ((1, 0), (1, 0))).cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
    placed: list[_Box] = []
    for mask, paint, text in zip(masks, paints, texts, strict=True):
        for letters in range(size, _SMALLEST - 1, -1):
            font, padding = font_of(letters), letters // 4
            x0, y0, x1, y1 = draw.multiline_textbbox((0, 0), text, font=font, spacing=padding)
            width, height = math.ceil(x1 - x0) + 2 * padding, math.ceil(y1 - y0) + 2 * padding
            if width <= picture.width and height <= picture.height:
                break
        else:
            continue
        box = _place(width, height, mask.box, placed, covered, letters)
        _leader(draw, box, mask, paint, max(1, letters // 7))
        draw.rectangle((box.left, box.top, box.right - 1, box.bottom - 1), fill=paint)
        draw.multiline_text(
            (box.left + padding - x0, box.top + padding - y0), text, fill=_INK, font=font, spacing=padding
        )
        placed.append(box)


def _place(
    width: int, height: int, target: _Box, placed: Sequence[_Box], covered: NDArray[np.int32], letters: int
) -> _Box:
    """The best place of a grid over the picture: clear of other labels, near its instance, on as few instances as can be."""
    rows, columns = covered.shape[0] - 1, covered.shape[1] - 1
    top, left = (
        np.unique(np.append(np.arange(0, room + 1, max(1, letters // 2)), room))
        for room in (rows - height, columns - width)
    )
    top = top[:, None]
    right, bottom = left + width, top + height
    gap_x = np.maximum(0, np.maximum(left - target.right, target.left - right))
    gap_y = np.maximum(0, np.maximum(top - target.bottom, target.top - bottom))
    off_centre = np.hypot(left + right - target.left - target.right, top + bottom - target.top - target.bottom)
    hidden = covered[bottom, right] - covered[top, right] - covered[bottom, left] + covered[top, left]
    cost = np.hypot(gap_x, gap_y) / (4 * letters) + off_centre / (40 * letters) + hidden / (width * height)
    for other in placed:
        shared_x = np.minimum(right, other.right + 2) - np.maximum(left, other.left - 2)
        shared_y = np.minimum(bottom, other.bottom + 2) - np.maximum(top, other.top - 2)
        # Far more than the rest can add up to: labels overlap only where every place does.
        cost += 1000 * np.maximum(0, shared_x) * np.maximum(0, shared_y)
    i, j = np.unravel_index(np.argmin(cost), cost.shape)
    x, y = int(left[j]), int(top[i, 0])
    return _Box(x, y, x + width, y + height)


def _leader(draw: ImageDraw.ImageDraw, box: _Box, mask: _Mask, paint: tuple[int, int, int], thickness: int) -> None:
    """A line from a label that lies beside its instance to the nearest pixel of it."""
    row, column = np.nonzero(mask.pixels)
    row, column = row + mask.box.top - 1, column + mask.box.left - 1
    from_row, from_column = np.clip(row, box.top, box.bottom - 1), np.clip(column, box.left, box.right - 1)
    nearest = np.argmin((row - from_row) ** 2 + (column - from_column) ** 2)
    start = int(from_column[nearest]), int(from_row[nearest])
    end = int(column[nearest]), int(row[nearest])
    if start != end:
        draw.line((start, end), fill=paint, width=thickness)
