"""Pictures of recognized frames: the colour image with the outline of each instance and a label with its answer.

draw_overlay(frame, recognizer.recognize(frame), "overlay.png")
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from colornet.colors import LUMA
from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.printable import escape_characters

if TYPE_CHECKING:
    from thor2_jax.model.recognition import Recognition

__all__ = ["COLORS", "UNRECOGNIZED", "Annotation", "annotate", "answer_paints", "draw_instances", "draw_overlay"]

Paint = tuple[int, int, int]
"""An sRGB colour, 0 to 255."""

COLORS: tuple[Paint, ...] = ((86, 180, 233), (240, 228, 66), (0, 158, 115), (204, 121, 167), (0, 114, 178))
"""Colours of recognized instances, in turn: sky blue, yellow, bluish green, reddish purple and blue of the palette of
Okabe and Ito, which people with colour blindness can distinguish."""

UNRECOGNIZED: Paint = (213, 94, 0)
"""Colour of instances without a name: vermilion of the same palette, whose similar orange is not used."""

_SMALLEST_LETTERS = 8
"""Size of the smallest legible letters, pixels."""


class Annotation(NamedTuple):
    """Outline and label of an instance in a picture.

    Attributes:
        label: number of the instance in the label image.
        paint: colour of the outline and of the label's background.
        text: text of the label, in one or more lines; empty for no label.
    """

    label: int
    paint: Paint
    text: str


class _Box(NamedTuple):
    """A rectangle of pixels; `right` and `bottom` are not included."""

    left: int
    top: int
    right: int
    bottom: int


class _Lettering(NamedTuple):
    """A label's text, font and size; `start` is its position relative to the corner of a box of width x height."""

    text: str
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont
    size: int
    spacing: int
    start: tuple[float, float]
    width: int
    height: int


def draw_overlay(frame: RGBDFrame, answers: Sequence[Recognition], path: str | Path) -> None:
    """Draw the answers for a frame on its colour image, and write a PNG atomically.

    A label shows the number of the instance in the label image, the name or "unrecognized", the confidence, the
    classifier and whether the instance is occluded.

    Args:
        frame: a frame with labels.
        answers: answers for instances of the frame; instances without an answer are not drawn.
        path: path of the picture.

    Raises:
        InputError: the frame has no labels, or an answer is for a label that does not occur in them.
        OSError: the file cannot be written.
    """
    for answer in answers:
        if answer.label not in frame.instance_pixels:
            raise InputError(f"answers: label {answer.label} does not occur in labels")
    picture = annotate(frame, answers)
    with atomic_write(path) as temporary:
        picture.save(temporary, format="PNG")


def annotate(frame: RGBDFrame, answers: Sequence[Recognition]) -> Image.Image:
    """Return the picture that `draw_overlay` writes; the arguments are not checked."""
    annotations = [
        Annotation(answer.label, paint, _text(answer))
        for answer, paint in zip(answers, answer_paints(answers), strict=True)
    ]
    return draw_instances(frame.color, frame.label_image, annotations)


def draw_instances(color: NDArray[np.uint8], labels: NDArray[Any], annotations: Sequence[Annotation]) -> Image.Image:
    """Return a colour image with the outlines and labels of instances.

    Letters and outlines grow with the picture. Labels lie inside it, without overlap while there is space; the labels
    of the first annotations are placed first. Letters shrink if a label is wider than the picture; a label that does
    not fit even in the smallest legible letters is left out.

    Args:
        color: [H, W, 3] uint8, sRGB.
        labels: [H, W] integers; 0 is background, every other number an instance.
        annotations: annotations of labels that occur in `labels`.
    """
    places = [ndimage.find_objects((labels == each.label).view(np.uint8))[0] for each in annotations]
    masks = [labels[place] == each.label for each, place in zip(annotations, places, strict=True)]
    diagonal = math.hypot(*labels.shape)
    thickness = max(1, round(diagonal / 350))
    # Letters grow more slowly than the picture, since large pictures are usually viewed enlarged.
    size = max(11, round(14 * (diagonal / 800) ** 0.75))
    pixels = color.copy()
    for mask, place, annotation in zip(masks, places, annotations, strict=True):
        _draw_outline(pixels[place], mask, annotation.paint, thickness)
    picture = Image.fromarray(pixels)
    draw = ImageDraw.Draw(picture)
    covered = np.pad(labels != 0, ((1, 0), (1, 0))).cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
    placed: list[tuple[_Box, _Lettering, Paint]] = []
    for mask, (rows, columns), annotation in zip(masks, places, annotations, strict=True):
        lettering = _fit(draw, annotation.text, size, picture.size) if annotation.text else None
        if lettering is not None:
            target = _Box(columns.start, rows.start, columns.stop, rows.stop)
            box = _place(lettering, target, [other for other, _, _ in placed], covered)
            placed.append((box, lettering, annotation.paint))
            instance = np.argwhere(mask) + (target.top, target.left)
            _draw_leader(draw, box, instance, annotation.paint, max(1, size // 7))
    for box, lettering, paint in placed:  # after all leaders, since these may cross a label
        draw.rectangle((box.left, box.top, box.right - 1, box.bottom - 1), fill=paint)
        start = box.left + lettering.start[0], box.top + lettering.start[1]
        draw.multiline_text(start, lettering.text, _ink(paint), lettering.font, spacing=lettering.spacing)
    return picture


def answer_paints(answers: Sequence[Recognition]) -> list[Paint]:
    """Return the colour of each answer: `COLORS` in turn, or `UNRECOGNIZED`."""
    colors = itertools.cycle(COLORS)
    return [UNRECOGNIZED if answer.name is None else next(colors) for answer in answers]


def _text(answer: Recognition) -> str:
    occluded = ["occluded"] if answer.occluded else []
    if answer.name is None:
        return "\n".join([f"{answer.label}: unrecognized", *occluded])
    sure = "" if answer.confidence is None else f" {answer.confidence:.2f}"
    surest = [] if answer.classifier is None else [answer.classifier.upper()]
    return f"{answer.label}: {answer.name}{sure}\n{', '.join(surest + occluded)}".rstrip()


def _draw_outline(pixels: NDArray[np.uint8], mask: NDArray[np.bool_], paint: Paint, thickness: int) -> None:
    """Draw a coloured line along the inner edge of the mask and a thin black or white one beside it."""
    within = ndimage.binary_erosion(mask, iterations=thickness)
    core = ndimage.binary_erosion(within, iterations=max(1, thickness // 3))
    pixels[mask & ~within] = paint
    pixels[within & ~core] = _ink(paint)


def _ink(paint: Paint) -> Paint:
    """Return black or white, whichever has more contrast with a colour."""
    return (0, 0, 0) if LUMA @ paint > 100 else (255, 255, 255)


def _fit(draw: ImageDraw.ImageDraw, text: str, size: int, space: tuple[int, int]) -> _Lettering | None:
    """Return the text in the largest letters, up to `size`, that fit into `space` (width, height); None if none do."""
    wide = not all(map(_can_draw, text))
    text = escape_characters(text, functools.partial(_can_draw, wide=wide))
    for letters in range(size, _SMALLEST_LETTERS - 1, -1):
        font, padding = _font(letters, wide), letters // 4
        left, top, right, bottom = draw.multiline_textbbox((0, 0), text, font, spacing=padding)
        width, height = math.ceil(right - left) + 2 * padding, math.ceil(bottom - top) + 2 * padding
        if width <= space[0] and height <= space[1]:
            return _Lettering(text, font, letters, padding, (padding - left, padding - top), width, height)
    return None


@functools.lru_cache(maxsize=32)
def _font(size: int, wide: bool) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's font or, with `wide`, matplotlib's font, which has many more characters."""
    if not wide:
        return ImageFont.load_default(size)
    import matplotlib  # importing it takes a tenth of a second

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


@functools.lru_cache(maxsize=4096)
def _can_draw(character: str, wide: bool = False) -> bool:
    """Return whether a font has a character; all missing characters are drawn as the same box."""

    def shape(text: str) -> bytes:
        return bytes(_font(_SMALLEST_LETTERS, wide).getmask(text))

    return character in " \n" or (character.isprintable() and shape(character) != shape("\U0010ffff"))


def _place(lettering: _Lettering, target: _Box, placed: Sequence[_Box], covered: NDArray[np.int32]) -> _Box:
    """Return the best box on a grid over the picture: it overlaps no label, is near its instance, hides few others."""
    rows, columns = covered.shape[0] - 1, covered.shape[1] - 1
    letters, width, height = lettering.size, lettering.width, lettering.height
    top, left = (
        np.unique(np.append(np.arange(0, last + 1, max(1, letters // 2)), last))
        for last in (rows - height, columns - width)
    )
    top = top[:, None]
    right, bottom = left + width, top + height
    gap_x = np.maximum(0, np.maximum(left - target.right, target.left - right))
    gap_y = np.maximum(0, np.maximum(top - target.bottom, target.top - bottom))
    off_centre = np.hypot(left + right - target.left - target.right, top + bottom - target.top - target.bottom)
    hidden = covered[bottom, right] - covered[top, right] - covered[bottom, left] + covered[top, left]
    # Costs are in letter heights: hiding an instance under a tenth of the label costs as much as 4 letters' distance.
    cost = np.hypot(gap_x, gap_y) / letters + off_centre / (10 * letters) + 40 * hidden / (width * height)
    for other in placed:
        shared_x = np.minimum(right, other.right + 2) - np.maximum(left, other.left - 2)
        shared_y = np.minimum(bottom, other.bottom + 2) - np.maximum(top, other.top - 2)
        # The factor exceeds the sum of all other costs, so labels overlap only if no free place exists.
        cost += 1000 * np.maximum(0, shared_x) * np.maximum(0, shared_y)
    i, j = np.unravel_index(np.argmin(cost), cost.shape)
    x, y = int(left[j]), int(top[i, 0])
    return _Box(x, y, x + width, y + height)


def _draw_leader(
    draw: ImageDraw.ImageDraw, box: _Box, instance: NDArray[np.intp], paint: Paint, thickness: int
) -> None:
    """Draw a line from a label that lies beside its instance to the nearest of the instance's pixels [n, 2]."""
    row, column = instance.T
    from_row, from_column = np.clip(row, box.top, box.bottom - 1), np.clip(column, box.left, box.right - 1)
    nearest = np.argmin((row - from_row) ** 2 + (column - from_column) ** 2)
    start = int(from_column[nearest]), int(from_row[nearest])
    end = int(column[nearest]), int(row[nearest])
    if start != end:
        draw.line((start, end), fill=paint, width=thickness)
